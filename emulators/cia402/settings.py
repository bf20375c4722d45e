"""Settings of a CiA 402 drive in a rig, checked key by key.

A wrong key or value is a `SettingError` that names the keys and the expected value. The reader of
the file adds file and line.

The table `switches` has the positions of switches in the plant. Quirks are named deviations of real
drives from the standards, with their sources. A rig enables them by name, with the parameters
stated here or with its own:

  quirks = ["single_set_point_only"]
  quirks = { slow_sdo = { mean_s = 0.02 }, single_set_point_only = true }

All are off by default. They are added when the drive is built, around the parts that they change. A
drive without quirks is the same object as without this module.
"""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Any, ClassVar, Final, final

from motorhil.emulators.firmware.digital_inputs import (
    FAR,
    HOME_SWITCH,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    STIMULI,
    TOUCH_PROBE_1,
    TOUCH_PROBE_2,
    Switch,
)
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.dc_motor import PI, MotorPlant
from motorhil.emulators.plant.oscillator import IDEAL, Oscillator
from motorhil.emulators.plant.presets import PRESETS
from motorhil.emulators.settings.motor import MotorTable
from motorhil.emulators.settings.protection import (
    DEFAULT_PROTECTION,
    ProtectionSettings,
    ProtectionTable,
    protection_of,
)
from motorhil.emulators.settings.tables import (
    DEFAULT_PRESET,
    POSITION_RAD,
    REPLY_S,
    CanopenTable,
    ObjectValue,
    TimingTable,
    ns,
)
from motorhil.frozen import frozen
from motorhil.settings import (
    Declaration,
    Items,
    Key,
    KeyPath,
    Number,
    Rule,
    Schema,
    SettingError,
    Text,
    flag,
    given,
    kind_of,
    number,
    read,
    setting,
    shown,
    table,
    whole,
)

# Active from one output position up to another; without the key, to the end of travel.
_RANGES: Final = (
    ("home_from_rad", "home_to_rad", HOME_SWITCH),
    ("touch_probe_1_from_rad", "touch_probe_1_to_rad", TOUCH_PROBE_1),
    ("touch_probe_2_from_rad", "touch_probe_2_to_rad", TOUCH_PROBE_2),
)
_NAMES: Final = {bit: name for name, bit in STIMULI.items()}
_PATH: Final = ("switches",)


def _position(doc: str) -> Any:
    return number(None, -1e9, 1e9, "rad", doc, plausible=POSITION_RAD)


@final
@frozen(kw_only=True, slots=False)
class SwitchesTable:
    """Digital inputs along the output, by positions of the plant."""

    negative_limit_rad: float | None = _position("Negative limit switch: active below.")
    positive_limit_rad: float | None = _position("Positive limit switch: active from here on.")
    home_from_rad: float | None = _position("Home switch: active from here on; absent: all below.")
    home_to_rad: float | None = _position("Home switch: active up to here; absent: all above.")
    touch_probe_1_from_rad: float | None = _position("Input of touch probe 1: active from here on.")
    touch_probe_1_to_rad: float | None = _position("Input of touch probe 1: active up to here.")
    touch_probe_2_from_rad: float | None = _position("Input of touch probe 2: active from here on.")
    touch_probe_2_to_rad: float | None = _position("Input of touch probe 2: active up to here.")
    index_rad: float = number(
        0.0, -2.0 * PI, 2.0 * PI, "rad", "Motor angle of the encoder's index pulse, once a turn."
    )
    index_pulse: bool = flag(True, "The encoder has an index pulse.")

    RULES: ClassVar = (
        Rule(
            "index_pulse",
            (False,),
            refused=("index_rad",),
            message="the encoder has no index pulse",
            remedy="take one of them out",
        ),
    )

    def switches(self, plant: MotorPlant) -> tuple[Switch, ...]:
        """Return the switches, in increments.

        Edges lie at the nearest change of the encoder's count, at most half an increment away.

        Raises:
            SettingError: a range is empty, or does not fit 32 bits.
        """
        inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
        negative = self._count("negative_limit_rad", inc_rad, -FAR)
        positive = self._count("positive_limit_rad", inc_rad, FAR)
        if negative >= positive:
            message = f"{self.positive_limit_rad} rad is not above the negative limit switch"
            remedy = "the negative one is active below its position, the positive one above"
            raise SettingError((*_PATH, "positive_limit_rad"), message, remedy)
        switches: list[Switch] = []
        if negative > -FAR:
            switches.append(Switch(NEGATIVE_LIMIT, -FAR, negative))
        if positive < FAR:
            switches.append(Switch(POSITIVE_LIMIT, positive, FAR))
        for low_key, high_key, bit in _RANGES:
            low = self._count(low_key, inc_rad, -FAR)
            high = self._count(high_key, inc_rad, FAR)
            if low >= high:
                message = f"{getattr(self, high_key)} rad is not above {low_key}"
                remedy = f"at least an increment of {1.0 / inc_rad:.3g} rad"
                raise SettingError((*_PATH, high_key), message, remedy)
            if (low, high) != (-FAR, FAR):
                switches.append(Switch(bit, low, high))
        return tuple(switches)

    def _count(self, key: str, inc_rad: float, absent: int) -> int:
        place_rad = getattr(self, key)
        if place_rad is None:
            return absent
        place = place_rad * inc_rad
        if abs(place) >= 1 << 31:
            message = f"{place:.0f} increments do not fit 32 bits"
            remedy = f"at most {(1 << 31) / inc_rad:g} rad either way"
            raise SettingError((*_PATH, key), message, remedy)
        return int((place + 0.5) // 1.0)

    def index_count(self, plant: MotorPlant) -> int | None:
        """Return the count of the index pulse within a turn; None: there is none."""
        turn = plant.encoder_increments_rev
        count = int((self.index_rad * turn / (2.0 * PI) + 0.5) // 1.0) % turn
        return count if self.index_pulse else None


def out_of_reach(switches: tuple[Switch, ...], plant: MotorPlant) -> list[str]:
    """Return warnings about switches beyond the end stops, one line each.

    Such a switch is not necessarily an error of the rig: a limit switch can be mounted wrongly.
    """
    inc_rad = plant.encoder_increments_rev * plant.gear_ratio / (2.0 * PI)
    low_rad, high_rad = plant.extras.stop_low_rad, plant.extras.stop_high_rad
    way = f"the ends of the way, {low_rad:g}..{high_rad:g} rad"
    return [
        f"switch {_NAMES[one.bit]} is beyond {way}: it stays off unless a stimulus says otherwise"
        for one in switches
        if one.low > high_rad * inc_rad or one.high <= low_rad * inc_rad
    ]


Quirks = Mapping[str, Mapping[str, float]]
"""The enabled quirks, each with all its parameters."""


@final
@frozen
class Quirk:
    """One row of the catalogue.

    Attributes:
        name: the name in a rig.
        what: the behaviour of the drive.
        seen: the source.
        parameters: names with their units, and their default values.
    """

    name: str
    what: str
    seen: str
    parameters: Mapping[str, float]


CATALOGUE: Final = (
    Quirk(
        "inverted_set_point_acknowledge",
        "pp: statusword bit 12 is 1 from enabling on and 0 while a set-point is acknowledged",
        "canopen-python/canopen issue 678",
        {},
    ),
    Quirk(
        "single_set_point_only",
        "pp: a set-point without change immediately (controlword bit 5) is not executed",
        "Synapticon's documentation of profile position: single set-point only",
        {},
    ),
    Quirk(
        "edge_only_bits",
        "pp: controlword bit 5 left at 1 since the previous set-point: the next one is ignored",
        "nasa-jpl/jsd issue 103 (Elmo Gold)",
        {},
    ),
    Quirk(
        "stale_target_reached",
        "pp: target reached of the previous motion stays set for a while after a new set-point",
        "delmic/odemis pull request 1846 (Trinamic)",
        {"for_s": 0.01},
    ),
    Quirk(
        "halt_holds_mode",
        "6060h is ignored while controlword bit 8 (halt) is 1",
        "ros-industrial/ros2_canopen issue 234 (Engel HBI)",
        {},
    ),
    Quirk(
        "stray_emcy",
        "EMCY is sent as node 1's, on 081h, whatever the node-ID",
        "ros-industrial/ros2_canopen issue 214, recorded (Roboteq, node 12)",
        {},
    ),
    Quirk(
        "misplaced_error_register",
        "EMCY carries the error register in its fourth byte, behind a 0",
        "CANopenNode/CANopenNode issue 402",
        {},
    ),
    Quirk(
        "slow_sdo",
        "SDO responses are delayed by mean_s, give or take spread_s",
        "ros-industrial/ros2_canopen issue 194: some 10 ms after a master's timeout of 20 ms",
        {"mean_s": 0.02, "spread_s": 0.01},
    ),
    Quirk(
        "deaf_after_boot_up",
        "SDO requests are not answered for a while after the boot-up message",
        "canopen-python/canopen issue 401 (Nanotec CL4-E)",
        {"for_s": 2.0},
    ),
    Quirk(
        "late_boot_up",
        "the boot-up message is delayed by by_s",
        "ros-industrial/ros2_canopen issue 370: masters that wait too briefly for it",
        {"by_s": 5.0},
    ),
    Quirk(
        "heartbeat_jitter",
        "each heartbeat is delayed by up to max_s",
        "a recorded machine: node 63h, period 1.4 s, heartbeats 1.402 to 1.495 s apart",
        {"max_s": 0.095},
    ),
    Quirk(
        "size_not_indicated",
        "expedited SDO uploads say 42h: always four bytes, without a length",
        "users' recordings of Elmo drives; canopen-python/canopen pull request 395: two devices",
        {},
    ),
    Quirk(
        "stale_sdo_bytes",
        "unused bytes of an expedited SDO response are those of the response before",
        "CANopenNode/CANopenNode issue 345",
        {},
    ),
    Quirk(
        "statusword_bits",
        "these bits of 6041h are always 1; 10, 12 and 13 only outside operation enabled and quick"
        " stop active",
        "a user's recording of a Schunk module: 92xxh, thus bits 15 and 12 (9000h)",
        {"bits": 0x9000},
    ),
    Quirk(
        "target_reached_in_fault",
        "statusword bit 10 is 1 in fault",
        "ros-industrial/ros2_canopen issue 298, recorded (vendor 331h): 0638h; Trinamic TMCM",
        {},
    ),
    Quirk(
        "emcy_vendor_bytes",
        "EMCY of an error has these manufacturer-specific bytes, the lowest in its fourth byte",
        "ros-industrial/ros2_canopen issue 298, recorded (vendor 331h): 01 52 80 00 00 00 70 08",
        {"value": 0x08_7000_0000},
    ),
    Quirk(
        "emcy_after_boot_up",
        "EMCY 0000h follows every boot-up message, also after reset communication",
        "users' recordings of drives after reset communication",
        {},
    ),
    Quirk(
        "emcy_on_overrun",
        "frames beyond `frames` in within_s are lost; the first loss sends EMCY 8110h",
        "CANopenNode/CANopenNode issue 553: 8110h, register 10h, fourth byte 14h",
        {"frames": 8, "within_s": 0.001},
    ),
)
# The limits of parameters that are no times: the statusword's bits 8, 10 and 12 to 15; five bytes.
_STATUSWORD_BITS: Final = 0xF500
_WHOLE: Final = {"bits": _STATUSWORD_BITS, "value": (1 << 40) - 1, "frames": 1_000}


@final
@frozen
class _OnOff:
    """True, false, or a table of parameters."""

    parameters: Declaration

    def read(self, value: object, path: KeyPath) -> object:
        if isinstance(value, bool):
            return {} if value else None
        if not isinstance(value, Mapping):
            message = f"must be true, false or a table, but is {kind_of(value)} ({shown(value)})"
            names = ", ".join(self.parameters.keys) or "nothing"
            raise SettingError(path, message, f"true, or a table of: {names}")
        return given(self.parameters, value, path)

    def schema(self) -> Schema:
        return {"oneOf": [{"type": "boolean"}, {"$ref": self.parameters}]}

    def example(self) -> str:
        return "true"


def _switched(quirk: Quirk) -> Key:
    keys = {
        key: Key(Number(0, _WHOLE[key], "", is_whole=True), "")
        if key in _WHOLE
        else Key(Number(0, 3600.0, "s"), "")
        for key in quirk.parameters
    }
    own = Declaration(f"quirk_{quirk.name}", f"Parameters: {quirk.what}.", keys, quirk.parameters)
    return Key(_OnOff(own), f"{quirk.what[0].upper()}{quirk.what[1:]}.")


_BY_NAME: Final = {quirk.name: quirk for quirk in CATALOGUE}
QUIRKS: Final = Declaration(
    "quirks",
    "Quirks by name; true, or a table with parameters.",
    {quirk.name: _switched(quirk) for quirk in CATALOGUE},
    dict.fromkeys(_BY_NAME),
)


@final
class _Quirks:
    """A list of quirks by name, or a table of them with their parameters."""

    _NAMES: Final = Items(Text(tuple(_BY_NAME), "quirk"), shown=f'["{CATALOGUE[0].name}"]')

    def read(self, value: object, path: KeyPath) -> Quirks:
        if isinstance(value, Mapping):
            asked = given(QUIRKS, value, path)
        else:
            asked = {name: {} for name in self._NAMES.read(value, path)}
        return {
            name: {**_BY_NAME[name].parameters, **own}
            for name, own in asked.items()
            if own is not None
        }

    def schema(self) -> Schema:
        return {"oneOf": [self._NAMES.schema(), {"$ref": QUIRKS}]}

    def example(self) -> str:
        return self._NAMES.example()


def told(quirks: Quirks) -> list[str]:
    """Describe the enabled quirks, one line each, for the record."""
    lines = []
    for name, values in quirks.items():
        given = shown_parameters(values)
        lines.append(f"quirk {name}" + (f" ({given})" if given else ""))
    return lines


def shown_parameters(values: Mapping[str, float]) -> str:
    """Return the parameters of a quirk as a rig states them; bits and bytes in hexadecimal."""
    return ", ".join(
        f"{key} = 0x{int(value):X}" if key in ("bits", "value") else f"{key} = {value:g}"
        for key, value in values.items()
    )


def boot_up_later_ns(quirks: Quirks) -> int:
    """Return the delay of the boot-up message [ns]."""
    return parameter_ns(quirks, "late_boot_up", "by_s")


def parameter_ns(quirks: Quirks, name: str, key: str) -> int:
    """Return a parameter of a quirk [ns]; 0 if the quirk is off."""
    return ns(quirks.get(name, {}).get(key, 0.0))


def parameter(quirks: Quirks, name: str, key: str) -> int:
    """Return a whole parameter of a quirk; 0 if the quirk is off."""
    return int(quirks.get(name, {}).get(key, 0))


OWN_EDS: Final = Path(__file__).parents[1] / "eds" / "motorhil_cia402.eds"

# Values of 6060h; the bit of a mode in 6502h is one less. Source: CiA 402-2, modes of operation.
MODES: Final[dict[str, int]] = {
    **{"pp": 1, "vl": 2, "pv": 3, "tq": 4, "hm": 6},
    **{"ip": 7, "csp": 8, "csv": 9, "cst": 10},
}
EMULATED_MODES: Final[dict[str, int]] = {
    name: MODES[name] for name in ("pp", "pv", "tq", "hm", "ip", "csp", "csv", "cst")
}

SYNC_LOST_PERIODS: Final = 0
SYNC_LOST_CODE: Final = 0xFF64


@final
@frozen(kw_only=True, slots=False)
class DriveTimingTable(TimingTable):
    """Delays of a drive."""

    enable_s: float = number(
        0.02, 0, 3600, "s", "From switched on to operation enabled.", plausible=REPLY_S
    )


def _unit(per: str) -> Any:
    return number(None, 1e-12, 1e12, "", f"Increments{per} that 1 means in the drive's objects.")


@final
@frozen(kw_only=True, slots=False)
class UnitsTable:
    """Units of the drive's objects, where the EDS does not say, or says otherwise."""

    position_unit_inc: float | None = _unit("")
    velocity_unit_inc_s: float | None = _unit(" per second")
    acceleration_unit_inc_s2: float | None = _unit(" per second squared")


@final
@frozen(kw_only=True, slots=False)
class CyclicTable:
    """Reaction of the cyclic modes to missing SYNC, if 60C2h states its period."""

    sync_lost_periods: int = whole(
        SYNC_LOST_PERIODS, 0, 1000, "", "Periods without SYNC that are a fault; 0: no fault."
    )
    sync_lost_code: int = whole(SYNC_LOST_CODE, 1, 0xFFFF, "", "Error code of that fault.")

    RULES: ClassVar = (
        Rule(
            "sync_lost_periods",
            (0,),
            refused=("sync_lost_code",),
            message="has no effect without sync_lost_periods",
            remedy="add sync_lost_periods = 5",
        ),
    )


@final
@frozen(kw_only=True, slots=False)
class DriveTable(CanopenTable, MotorTable):
    """A CiA 402 drive."""

    timing: DriveTimingTable = table(DriveTimingTable, "Delays of the drive.")
    units: UnitsTable = table(UnitsTable, "Units of the drive's objects.")
    supported_modes: tuple[str, ...] | None = setting(
        None,
        Items(Text(tuple(EMULATED_MODES), "mode"), least=1, shown='["pp", "pv"]'),
        "Modes of operation; absent: those of the EDS, else all emulated ones.",
    )
    protection: ProtectionTable = table(ProtectionTable, "When the drive disables itself.")
    quirks: Quirks = setting(
        {}, _Quirks(), "Deviations from the standards; see `motorhil list quirks`."
    )
    cyclic: CyclicTable = table(CyclicTable, "Reaction to missing SYNC.")
    switches: SwitchesTable = table(SwitchesTable, "Digital inputs along the output.")


@final
@frozen(kw_only=True)
class DriveSettings:
    """One drive of a rig; every setting except the node-ID has a default.

    Attributes:
        node_id: 1..127.
        node_id_by_lss: True if the node-ID is unset until LSS assigns it.
        eds: the EDS of the object dictionary.
        nonvolatile_memory: file of the non-volatile memory, as named in the rig; None: the contents
            last as long as the rig.
        plant, gains: the motor and its servo.
        tick_ns, current_steps: servo period, and current loop steps per period.
        oscillator: the drive's own clock; all other times are by this clock.
        boot_up_ns: power-on to boot-up message.
        sdo_reply_ns: SDO request to response.
        enable_ns: time of the power stage from switched on to operation enabled.
        position_unit_inc, velocity_unit_inc_s, acceleration_unit_inc_s2: size of one unit in the
            objects; None: according to the EDS, else one increment (per second, squared).
        objects: power-on values that replace those of the EDS.
        supported_modes: names; None: according to the EDS, else all emulated modes.
        initial_position_rad: at the output, at power-on.
        protection: thresholds and reactions of the protective functions.
        quirks: deviations from the standards.
        sync_lost_periods: interpolation periods (60C2h) without SYNC that are a fault in a cyclic
            mode; 0: never (many hosts stop SYNC between two streams).
        sync_lost_code: error code of that fault; FF64h is Kollmorgen's (MKD and P7000, "Sync not
            received").
        switches: digital inputs along the output, in encoder increments.
        index_count: position of the index pulse within a turn; None: the encoder has none.
    """

    node_id: int
    eds: Path = OWN_EDS
    nonvolatile_memory: str | None = None
    node_id_by_lss: bool = False
    plant: MotorPlant = PRESETS[DEFAULT_PRESET]
    gains: ServoGains
    tick_ns: int = 1_000_000
    current_steps: int = 10
    oscillator: Oscillator = IDEAL
    boot_up_ns: int = 300_000_000
    sdo_reply_ns: int = 1_000_000
    enable_ns: int = 20_000_000
    position_unit_inc: float | None = None
    velocity_unit_inc_s: float | None = None
    acceleration_unit_inc_s2: float | None = None
    objects: tuple[ObjectValue, ...] = ()
    supported_modes: tuple[str, ...] | None = None
    initial_position_rad: float = 0.0
    protection: ProtectionSettings = DEFAULT_PROTECTION
    quirks: Quirks = field(default_factory=dict)
    sync_lost_periods: int = SYNC_LOST_PERIODS
    sync_lost_code: int = SYNC_LOST_CODE
    switches: tuple[Switch, ...] = ()
    index_count: int | None = 0


def read_settings(table: Mapping[str, object], folder: Path, stream: str = "") -> DriveSettings:
    """Read the settings of a rig's table.

    Args:
        table: the table.
        folder: relative paths start here.
        stream: the random stream of the clock.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    own = read(DriveTable, table)
    motor = own.motor(stream)
    return DriveSettings(
        node_id=own.node_id,
        eds=own.eds_path(folder, OWN_EDS),
        nonvolatile_memory=own.nonvolatile_memory,
        node_id_by_lss=own.node_id_by_lss,
        plant=motor.plant,
        gains=motor.gains,
        tick_ns=motor.tick_ns,
        current_steps=motor.current_steps,
        oscillator=motor.oscillator,
        boot_up_ns=ns(own.timing.boot_up_s) + boot_up_later_ns(own.quirks),
        sdo_reply_ns=ns(own.timing.sdo_reply_s),
        enable_ns=ns(own.timing.enable_s),
        position_unit_inc=own.units.position_unit_inc,
        velocity_unit_inc_s=own.units.velocity_unit_inc_s,
        acceleration_unit_inc_s2=own.units.acceleration_unit_inc_s2,
        objects=own.object_values(),
        supported_modes=own.supported_modes,
        initial_position_rad=motor.initial_position_rad,
        protection=protection_of(own.protection, motor.plant),
        quirks=own.quirks,
        sync_lost_periods=own.cyclic.sync_lost_periods,
        sync_lost_code=own.cyclic.sync_lost_code,
        switches=own.switches.switches(motor.plant),
        index_count=own.switches.index_count(motor.plant),
    )
