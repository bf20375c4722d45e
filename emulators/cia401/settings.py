"""Settings of a CiA 401 I/O node and its channels.

Values under `plant` and `amplifier` apply to every channel. `channel.2.plant` has the values that
differ for channel 2, and so on.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, final

from motorhil.emulators.controller import SettingError
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.oscillator import Oscillator
from motorhil.emulators.settings.tables import (
    KeyPath,
    ObjectValue,
    duration_ns,
    eds_in,
    flag,
    initial_position_rad,
    memory_file_in,
    node_id_in,
    number,
    objects_of,
    oscillator_in,
    plant_of,
    refuse_unknown,
    table_in,
    whole,
)

OWN_EDS: Final = Path(__file__).parents[1] / "eds" / "motorhil_cia401.eds"
CHANNELS_MAX: Final = 4

KEYS: Final = (
    *(
        "node_id",
        "node_id_by_lss",
        "eds",
        "nonvolatile_memory",
        "channels",
        "plant",
        "amplifier",
        "channel",
    ),
    *("oscillator", "timing", "objects", "initial_position_rad"),
)
TIMING_KEYS: Final = ("boot_up_s", "sdo_reply_s")
CHANNEL_KEYS: Final = ("plant", "amplifier", "initial_position_rad")
GAIN_KEYS: Final = ("current_kp_v_a", "current_ki_v_a_s")
AMPLIFIER_KEYS: Final = ("current_per_volt_a_v", "enable_s", "tick_s", "current_steps", *GAIN_KEYS)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
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
@dataclass(frozen=True, slots=True, kw_only=True)
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
    refuse_unknown(table, KEYS, ())
    node_id = node_id_in(table)
    count = whole(table.get("channels", 1), ("channels",), 1, CHANNELS_MAX)
    several = table_in(table, "channel")
    names = tuple(str(place) for place in range(1, count + 1))
    refuse_unknown(several, names, ("channel",))
    timing = table_in(table, "timing")
    refuse_unknown(timing, TIMING_KEYS, ("timing",))
    return NodeSettings(
        node_id=node_id,
        eds=eds_in(table, folder, OWN_EDS),
        nonvolatile_memory=memory_file_in(table),
        node_id_by_lss=flag(table, "node_id_by_lss"),
        channels=tuple(_channel(table, several, name) for name in names),
        oscillator=oscillator_in(table, stream),
        boot_up_ns=duration_ns(timing, "boot_up_s", 0.3, ("timing",)),
        sdo_reply_ns=duration_ns(timing, "sdo_reply_s", 0.001, ("timing",)),
        objects=objects_of(table_in(table, "objects")),
    )


def _channel(
    table: Mapping[str, object], several: Mapping[str, object], name: str
) -> ChannelSettings:
    path = ("channel", name)
    own = table_in(several, name, ("channel",))
    refuse_unknown(own, CHANNEL_KEYS, path)
    common_plant = table_in(table, "plant")
    plant = plant_of(common_plant)
    own_plant = table_in(own, "plant", path)
    if own_plant:
        base = {} if "preset" in own_plant else common_plant
        plant = plant_of({**base, **own_plant}, (*path, "plant"))
    common = table_in(table, "amplifier")
    _amplifier(common, ("amplifier",), plant, 0.0)  # reports errors by their own key
    amplifier: Mapping[str, object] = {**common, **table_in(own, "amplifier", path)}
    from_own = "initial_position_rad" in own
    position_rad = initial_position_rad(own if from_own else table, plant, path if from_own else ())
    return _amplifier(amplifier, (*path, "amplifier"), plant, position_rad)


def _amplifier(
    table: Mapping[str, object], path: KeyPath, plant: MotorPlant, position_rad: float
) -> ChannelSettings:
    refuse_unknown(table, AMPLIFIER_KEYS, path)
    tick_ns = duration_ns(table, "tick_s", 0.000_25, path, 1e-6, 1.0)
    steps = whole(table.get("current_steps", 5), (*path, "current_steps"), 1, 1000)
    if tick_ns % steps or tick_ns < steps * 1000:
        message = f"{steps} steps do not divide {tick_ns} ns into whole ns of at least 1000 each"
        raise SettingError((*path, "current_steps"), message, "usual: 5")
    given = {key: number(table[key], (*path, key), 0, 1e12) for key in GAIN_KEYS if key in table}
    full_scale = plant.current_max_a / 10.0
    return ChannelSettings(
        plant=plant,
        gains=replace(ServoGains.tuned(plant, tick_ns, steps), **given),
        current_per_volt_a_v=number(
            table.get("current_per_volt_a_v", full_scale),
            (*path, "current_per_volt_a_v"),
            1e-6,
            1e6,
        ),
        enable_ns=duration_ns(table, "enable_s", 0.005, path),
        tick_ns=tick_ns,
        current_steps=steps,
        initial_position_rad=position_rad,
    )
