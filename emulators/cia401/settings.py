"""Settings of a CiA 401 I/O node and its channels.

Values under `plant` and `amplifier` apply to every channel. `channel.2.plant` has the values that
differ for channel 2, and so on.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, final

from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.settings.motor import SERVO_S, check_steps
from motorhil.emulators.settings.tables import (
    PLANT,
    POSITION_RAD,
    REPLY_S,
    CanopenTable,
    ObjectValue,
    OscillatorTable,
    TimingTable,
    check_position,
    ns,
    plant_of,
)
from motorhil.frozen import frozen
from motorhil.settings import (
    KeyPath,
    SettingError,
    TableOf,
    TablesByKey,
    declaration,
    number,
    read,
    refuse_unknown,
    setting,
    table,
    whole,
)

OWN_EDS: Final = Path(__file__).parents[1] / "eds" / "motorhil_cia401.eds"
CHANNELS_MAX: Final = 4


@final
@frozen(kw_only=True, slots=False)
class AmplifierTable:
    """An amplifier in current mode, and the counter of the encoder."""

    current_per_volt_a_v: float | None = number(
        None,
        1e-6,
        1e6,
        "A/V",
        "Current per input voltage; absent: 10 V for current_max_a.",
        plausible=(1e-3, 1e3),
    )
    enable_s: float = number(
        0.005, 0, 3600, "s", "From the enable input to ready.", plausible=REPLY_S
    )
    tick_s: float = number(
        0.000_25, 1e-6, 1.0, "s", "Sampling period of input and encoder.", plausible=SERVO_S
    )
    current_steps: int = whole(5, 1, 1000, "", "Current loop steps in each of these periods.")
    current_kp_v_a: float | None = number(None, 0, 1e12, "V/A", "Gain; absent: tuned.")
    current_ki_v_a_s: float | None = number(None, 0, 1e12, "V/(A·s)", "Gain; absent: tuned.")

    def channel(self, plant: MotorPlant, position_rad: float, path: KeyPath) -> "ChannelSettings":
        """Return a channel with this amplifier.

        Raises:
            SettingError: the steps do not divide the period.
        """
        tick_ns, steps = ns(self.tick_s), self.current_steps
        if tick_ns % steps or tick_ns < steps * 1000:
            message = f"{steps} steps do not divide {tick_ns} ns into whole ns of at least 1000"
            raise SettingError((*path, "current_steps"), f"{message} each", "usual: 5")
        gains = {"current_kp_v_a": self.current_kp_v_a, "current_ki_v_a_s": self.current_ki_v_a_s}
        own = {name: gain for name, gain in gains.items() if gain is not None}
        scale_a_v = self.current_per_volt_a_v
        return ChannelSettings(
            plant=plant,
            gains=replace(ServoGains.tuned(plant, tick_ns, steps), **own),
            current_per_volt_a_v=plant.current_max_a / 10.0 if scale_a_v is None else scale_a_v,
            enable_ns=ns(self.enable_s),
            tick_ns=tick_ns,
            current_steps=steps,
            initial_position_rad=position_rad,
        )


_AMPLIFIER: Final = declaration(AmplifierTable)


@final
@frozen(kw_only=True, slots=False)
class ChannelTable:
    """Settings of one channel that differ from those of the node."""

    plant: Mapping[str, Any] = table(PLANT, "The channel's plant.")
    amplifier: Mapping[str, Any] = table(_AMPLIFIER, "The channel's amplifier.")
    initial_position_rad: float | None = number(
        None,
        -1e9,
        1e9,
        "rad",
        "Position of the channel's output at power-on.",
        plausible=POSITION_RAD,
    )


@final
@frozen(kw_only=True, slots=False)
class NodeTable(CanopenTable):
    """A CiA 401 I/O node with torque amplifiers, motors and encoder counters."""

    channels: int = whole(1, 1, CHANNELS_MAX, "", "Number of amplifiers, motors and counters.")
    plant: Mapping[str, Any] = table(PLANT, "The plant of every channel.")
    amplifier: Mapping[str, Any] = table(_AMPLIFIER, "The amplifier of every channel.")
    channel: Mapping[str, ChannelTable] = setting(
        {}, TablesByKey(TableOf(ChannelTable)), "Settings of single channels, by number."
    )
    oscillator: OscillatorTable = table(OscillatorTable, "The clock of the node.")
    timing: TimingTable = table(TimingTable, "Delays of the node.")
    initial_position_rad: float = number(
        0.0, -1e9, 1e9, "rad", "Position of the output at power-on.", plausible=POSITION_RAD
    )

    def channel_settings(self) -> tuple["ChannelSettings", ...]:
        """Return the settings of all channels.

        Raises:
            SettingError: values do not go together, or a channel does not exist.
        """
        names = tuple(str(place) for place in range(1, self.channels + 1))
        refuse_unknown(self.channel, names, ("channel",))
        return tuple(self._channel(name) for name in names)

    def _channel(self, name: str) -> "ChannelSettings":
        path = ("channel", name)
        own = self.channel.get(name, ChannelTable())
        plant = plant_of(self.plant)
        if own.plant:
            base = {} if "preset" in own.plant else self.plant
            plant = plant_of({**base, **own.plant}, (*path, "plant"))
        position_rad = own.initial_position_rad
        if position_rad is None:
            check_position(self.initial_position_rad, plant)
            position_rad = self.initial_position_rad
        else:
            check_position(position_rad, plant, path)
        AmplifierTable(**self.amplifier).channel(plant, 0.0, ("amplifier",))  # by its own keys
        amplifier = AmplifierTable(**{**self.amplifier, **own.amplifier})
        settings = amplifier.channel(plant, position_rad, (*path, "amplifier"))
        is_own = "coupling_stiffness_n_m_rad" in own.plant
        where = (*path, "plant") if is_own else ("plant",)
        check_steps(plant, settings.tick_ns, settings.current_steps, where)
        return settings


@final
@frozen(kw_only=True)
class ChannelSettings:
    """One channel: an amplifier in current mode, its motor, and the motor's encoder.

    Attributes:
        plant: the motor, with its encoder; `supply_v` and `current_max_a` are the amplifier's.
        gains: of the amplifier's current loop; the others are not used.
        current_per_volt_a_v: current demanded per volt at the amplifier's input.
        enable_ns: from the enable input to *ready*.
        tick_ns, current_steps: period in which the amplifier samples its input and the encoder is
            counted, and steps of the current loop in each period.
        initial_position_rad: at the output, at power-on.
    """

    plant: MotorPlant
    gains: ServoGains
    current_per_volt_a_v: float
    enable_ns: int
    tick_ns: int
    current_steps: int
    initial_position_rad: float


@final
@frozen(kw_only=True)
class NodeSettings:
    """One I/O node of a rig.

    Attributes:
        node_id: 1..127.
        node_id_by_lss: it has no node-ID until LSS assigns one.
        eds: the file of its object dictionary.
        channels: 1 to 4 of them.
        oscillator: its own clock; all other times here, the amplifiers' too, are measured by it.
        boot_up_ns: from power-on to the boot-up message.
        sdo_reply_ns: from an SDO request to its response.
        objects: power-on values that replace those of the file.
    """

    node_id: int
    eds: Path
    nonvolatile_memory: str | None
    node_id_by_lss: bool
    channels: tuple[ChannelSettings, ...]
    oscillator: Oscillator
    boot_up_ns: int
    sdo_reply_ns: int
    objects: tuple[ObjectValue, ...]


def read_settings(table: Mapping[str, object], folder: Path, stream: str = "") -> NodeSettings:
    """Read the settings from a rig's table; `folder` holds relative paths, `stream` draws.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    own = read(NodeTable, table)
    return NodeSettings(
        node_id=own.node_id,
        eds=own.eds_path(folder, OWN_EDS),
        nonvolatile_memory=own.nonvolatile_memory,
        node_id_by_lss=own.node_id_by_lss,
        channels=own.channel_settings(),
        oscillator=own.oscillator.oscillator(stream),
        boot_up_ns=ns(own.timing.boot_up_s),
        sdo_reply_ns=ns(own.timing.sdo_reply_s),
        objects=own.object_values(),
    )
