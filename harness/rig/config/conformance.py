"""The `[conformance]` table of a rig file: its facts about the bench.

The keys are declared here; `docs/reference/rig-file.md` lists them.
"""

from collections.abc import Mapping
from dataclasses import field
from enum import Enum
from types import MappingProxyType
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import Table
from motorhil.settings import (
    Declaration,
    Flag,
    Items,
    Key,
    KeyPath,
    Number,
    Schema,
    SettingError,
    TablesByKey,
    Text,
    flag,
    number,
    setting,
    table,
    text,
    whole,
)


@final
class Capability(Enum):
    """An optional capability that an adaptation claims; everything else is mandatory."""

    POSITION_SET_POINT = "position set-points"
    VELOCITY_SET_POINT = "velocity set-points"
    TORQUE_SET_POINT = "torque set-points"
    CURRENT_SET_POINT = "current set-points"
    POSITION_TRAJECTORY = "position trajectories"
    VELOCITY_TRAJECTORY = "velocity trajectories"
    TORQUE_TRAJECTORY = "torque trajectories"
    COMPLEX_POSITION = "complex position trajectories"
    COMPLEX_VELOCITY = "complex velocity trajectories"
    LIMITED_SET_POINT = "set-points with a velocity limit"
    LIMITED_JERK = "trajectories with a limit of jerk"
    MEASURED_TORQUE = "torque measurement"
    MEASURED_FOLLOWING_ERROR = "following error measurement"
    HOMING = "homing"
    LOW_LEVEL = "low-level access"
    FAULTS = "fault reports"
    DEAD_MAN = "stopping when the host is lost"
    COMMON_TRIGGER = "starting together by a common signal"

    @property
    def key(self) -> str:
        """The name of the capability in rig files."""
        return self.name.lower()

    @property
    def is_assumed(self) -> bool:
        """True if no motor can be asked for it: claimed unless the rig has it in `without`."""
        return self in (Capability.FAULTS, Capability.DEAD_MAN)


_BY_KEY: Final = {capability.key: capability for capability in Capability}
_LENGTH_MAX: Final = 1e6
_TIME_MAX_S: Final = 3600.0


@final
@frozen
class _AsTheDrive:
    """A value of a setting of a drive, which its own table checks."""

    def read(self, value: object, path: KeyPath) -> object:
        """Return the value."""
        return value

    def schema(self) -> Schema:
        """Return its JSON Schema: any value."""
        return {}

    def example(self) -> str:
        """Return nothing: it depends on the setting."""
        return ""


def _length(name: str, doc: str) -> Any:
    usual = {"plausible": (1e-10, 1e3), "plausible_m": (1e-12, 10.0)}
    name = f"{name}_{{u}}"
    return number(None, 1e-12, _LENGTH_MAX, "{u}", doc, name=name, example="0.001", **usual)


def _time(default_s: float | None, doc: str) -> Any:
    return number(default_s, 1e-9, _TIME_MAX_S, "s", doc, example="0.1", plausible=(1e-6, 60.0))


def _stimulus(doc: str) -> Any:
    return number(None, -_LENGTH_MAX, _LENGTH_MAX, "", doc, example="1.0")


@final
@frozen(kw_only=True, slots=False)
class ConformanceTable:
    """Facts about the motors under test, for `motorhil conform`."""

    motors: tuple[str, ...] = setting(
        (),
        Items(Text(), shown='["left"]'),
        "The motors under test; absent: all of the adaptation in question, else the first group.",
    )
    window: float | None = _length("window", "Largest distance from the target at rest.")
    following: float | None = _length("following", "Largest distance from the trajectory.")
    long_move: float | None = _length("long_move", "A move that takes about a second.")
    latency_s: tuple[float, ...] = setting(
        (0.0, 0.02),
        Items(
            Number(-_TIME_MAX_S, 10.0, "s", plausible=(1e-6, 5.0)),
            least=2,
            most=2,
            unique=False,
            shown="[0.0, 0.001]",
        ),
        "From the reported start to the start of motion, minimum and maximum [s].",
    )
    time_tolerance_s: float = _time(0.1, "Tolerance of the reported time of any end.")
    dead_man_s: float = _time(1.0, "Within which a drive notices that its host is lost.")
    brake_s: float | None = _time(None, "Time to rest after that; absent: from the model.")
    lost_s: float = _time(1.0, "Within which a host reports that a drive is lost.")
    borne_s: float | None = _time(
        None, "Silence of a drive in a motion that its host bears; absent: not known."
    )
    repeats_stops: bool = flag(
        False, "A stop comes to rest although one of its frames is lost; false: not known."
    )
    deadline_s: float = _time(30.0, "Deadline of one clause, in wall time.")
    fault_stimulus: str = text("fault", "Stimulus that causes a controller fault.")
    fault_code: int = whole(0x2310, 1, 0xFFFF_FFFF, "", "Error code of that fault.")
    fault_value: float | None = _stimulus("Value of the stimulus; absent: the code.")
    fault_over_value: float | None = _stimulus("Its value a moment later; absent: not needed.")
    fault_texts: Mapping[str, str] = setting(
        {},
        TablesByKey(
            Text(shown='"current"'),
            r"[0-9A-Fa-f]{1,8}h",
            "is not an error code",
            'write it in hex, as "2310h"',
        ),
        "Words in the text of a fault, by error code, which the stimulus causes.",
    )
    seeking_method: int | None = whole(
        None, -128, 127, "", "Homing method that runs until it is ended; absent: none is known."
    )
    homing_fails: Mapping[str, object] = setting(
        {},
        TablesByKey(_AsTheDrive()),
        "Settings of the emulated drive with which that method fails; absent: none is known.",
    )
    home_offset_is_opposite: bool = flag(
        False, "At home the drive's position is +607Ch (as with KEB's F6), not -607Ch."
    )
    unfit: tuple[Mapping[str, object], ...] = setting(
        (),
        Items(TablesByKey(_AsTheDrive()), shown="[{ firmware_major = 5 }]"),
        "Settings of the emulated drive, each with which the adaptation must refuse it.",
    )
    unfit_texts: tuple[str, ...] = setting(
        (),
        Items(Text(), unique=False, shown='["firmware 5"]'),
        "Words in the refusal of each of them, in their order.",
    )
    absolute_encoder: bool | None = setting(
        None,
        Flag(),
        "Whether the position is that of the model from power-on, without homing;"
        " absent: not known.",
    )
    slow: Mapping[str, object] = setting(
        {},
        TablesByKey(_AsTheDrive()),
        "Settings of the emulated drive with which it is not enabled in time; absent: none known.",
    )
    claims: tuple[str, ...] = setting(
        (),
        Items(Text(tuple(_BY_KEY), "capability"), shown='["homing"]'),
        "Capabilities that the motor must have, or cannot claim itself.",
    )
    without: Mapping[str, str] = table(
        Declaration(
            "without",
            "Capabilities that are not claimed, and why.",
            {
                key: Key(Text(shown='"no switches on this bench"'), f"Why not {one.value}.")
                for key, one in _BY_KEY.items()
            },
            dict.fromkeys(_BY_KEY),
        ),
        "Capabilities that are not claimed, and why.",
    )

    def __post_init__(self) -> None:
        """Refuse times in the wrong order, and reasons without words (SettingError)."""
        if self.latency_s[0] > self.latency_s[1]:
            message = "is not a list of two times [s], minimum first"
            raise SettingError(("latency_s",), message, "write latency_s = [0.0, 0.001]")
        for name, reason in self.without.items():
            if not reason.strip():
                raise SettingError(("without", name), "has an empty reason", "state the reason")


@final
@frozen
class Facts:
    """The facts that a bench declares; U is rad or m.

    Attributes:
        motors: names of the motors under test; if empty, the opener of the bench chooses.
        unit: the unit of the declared lengths, "rad" or "m"; "" if none was declared.
        window: the largest distance from the target at rest [U].
        following: the largest distance from the demand of a trajectory at any instant [U].
        long_move: a distance that takes about a second [U]; None: derived from the motor's model.
        latency_s: from the reported start to the start of motion, minimum and maximum [s].
        time_tolerance_s: the tolerance of reported times of ends [s].
        dead_man_s: within which a drive notices that its host is lost, and begins to brake [s].
        brake_s: the time to rest after that, from any motion [s]; None: derived from the model.
        lost_s: within which a host reports that a drive has stopped answering [s].
        borne_s: the silence of a drive in a motion that its host bears [s]; None: not known.
        repeats_stops: True if the host repeats a stop that the drive has not obeyed.
        deadline_s: the deadline for one clause [s of wall time].
        fault_stimulus: the stimulus that causes a controller fault.
        fault_code: the error code that the drive then reports.
        fault_value: the value of the stimulus; None: the code.
        fault_over_value: its value a moment later; None: not needed, the cause is gone by then.
        fault_texts: words in the text of a fault, by error code, that the same stimulus causes.
        seeking_method: a homing method that runs until it is ended; None: none is known.
        homing_fails: settings of the emulated drive with which that method fails; or none.
        home_offset_is_opposite: True if home is at +607Ch, against CiA 402-2.
        unfit: settings of the emulated drive, each with which the adaptation must refuse it.
        unfit_texts: words in the refusal of each of them, in their order; fewer: not known.
        absolute_encoder: whether the motor is referenced without homing; None: not known.
        slow: settings of the emulated drive with which it is not enabled in time; or none.
        claims: the capabilities claimed by the rig.
        claimed_at: where the rig claims them, "file:line".
        without: the capabilities that are not claimed, and why.
    """

    motors: tuple[str, ...] = ()
    unit: str = ""
    window: float = 0.005
    following: float = 0.02
    long_move: float | None = None
    latency_s: tuple[float, float] = (0.0, 0.02)
    time_tolerance_s: float = 0.1
    dead_man_s: float = 1.0
    brake_s: float | None = None
    lost_s: float = 1.0
    borne_s: float | None = None
    repeats_stops: bool = False
    deadline_s: float = 30.0
    fault_stimulus: str = "fault"
    fault_code: int = 0x2310
    fault_value: float | None = None
    fault_over_value: float | None = None
    fault_texts: Mapping[int, str] = field(default_factory=lambda: MappingProxyType({}))
    seeking_method: int | None = None
    homing_fails: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    home_offset_is_opposite: bool = False
    unfit: tuple[Mapping[str, object], ...] = ()
    unfit_texts: tuple[str, ...] = ()
    absolute_encoder: bool | None = None
    slow: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))
    claims: tuple[Capability, ...] = ()
    claimed_at: Mapping[Capability, str] = field(default_factory=lambda: MappingProxyType({}))
    without: Mapping[Capability, str] = field(default_factory=lambda: MappingProxyType({}))


NOTHING_DECLARED: Final = Facts()


def read_facts(table: Table, motors: tuple[str, ...]) -> Facts:
    """Read a rig's `[conformance]` table; `motors` are the names of the rig's motors.

    Raises:
        RigError: the first error in the table.
    """
    usual, unit = NOTHING_DECLARED, _unit(table)
    own = table.read(ConformanceTable, unit=unit)
    for place, name in enumerate(own.motors):
        table.require("motors", name, motors, "motor", place)
    at = f"{table.source.path}:"
    claimed = {
        _BY_KEY[name]: f"{at}{table.source.line((*table.path, 'claims', place))}"
        for place, name in enumerate(own.claims)
    }
    for name in own.without:
        if _BY_KEY[name] in claimed:
            problem = f"is claimed at {claimed[_BY_KEY[name]]}"
            raise table.table("without").error(name, problem, "remove one of them")
    return Facts(
        motors=own.motors,
        unit=unit,
        window=usual.window if own.window is None else own.window,
        following=usual.following if own.following is None else own.following,
        long_move=own.long_move,
        latency_s=(own.latency_s[0], own.latency_s[1]),
        time_tolerance_s=own.time_tolerance_s,
        dead_man_s=own.dead_man_s,
        brake_s=own.brake_s,
        lost_s=own.lost_s,
        borne_s=own.borne_s,
        repeats_stops=own.repeats_stops,
        deadline_s=own.deadline_s,
        fault_stimulus=own.fault_stimulus,
        fault_code=own.fault_code,
        fault_value=own.fault_value,
        fault_over_value=own.fault_over_value,
        fault_texts=MappingProxyType(
            {int(code[:-1], 16): text for code, text in own.fault_texts.items()}
        ),
        seeking_method=own.seeking_method,
        homing_fails=own.homing_fails,
        home_offset_is_opposite=own.home_offset_is_opposite,
        unfit=own.unfit,
        unfit_texts=own.unfit_texts,
        absolute_encoder=own.absolute_encoder,
        slow=own.slow,
        claims=tuple(claimed),
        claimed_at=MappingProxyType(claimed),
        without=MappingProxyType({_BY_KEY[name]: why for name, why in own.without.items()}),
    )


def _unit(table: Table) -> str:
    """Return the unit of the table's lengths; all lengths have the same unit."""
    found = {
        unit: f"{name}_{unit}"
        for name in ("window", "following", "long_move")
        for unit in ("rad", "m")
        if table.has(f"{name}_{unit}")
    }
    if len(found) == 2:
        raise table.error(found["m"], f"is in m, {found['rad']} in rad", "a motor has one unit")
    return next(iter(found), "")
