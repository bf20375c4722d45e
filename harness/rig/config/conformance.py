"""The `[conformance]` table of a rig file: its facts about the bench.

    [conformance]
    motors = ["left", "right"]          # under test; default: the first group, or all of one kind
    window_rad = 0.001                  # largest distance from the target at rest
    following_rad = 0.0005              # largest distance from the trajectory
    latency_s = [0.0, 0.001]            # from the reported start to the start of motion
    time_tolerance_s = 0.05             # tolerance of the reported time of any end
    dead_man_s = 0.5                    # within which a drive must notice that the host is lost
    brake_s = 1.0                       # and the time to rest after that, from any motion
    lost_s = 0.5                        # within which a host reports that a drive is lost
    long_move_rad = 1.0                 # a move that takes about a second
    deadline_s = 30.0                   # for one clause, in wall time; on a real bench 120
    fault_stimulus = "fault"            # stimulus that causes a controller fault
    fault_code = 0x2310                 # and the error code of that fault
    fault_value = 1.0                   # value of the stimulus, if this is not the code
    fault_over_value = 0.0              # its value a moment later, so that the cause is gone
    seeking_method = 17                 # a homing method that seeks a switch and finds none
    claims = ["homing"]                 # capabilities that the motor cannot claim itself

    [conformance.without]               # capabilities that are not claimed, and why
    homing = "no switches on this bench"

A linear motor uses m in place of rad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType
from typing import Final, final

from motorhil.harness.rig.config.toml import Table


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


CONFORMANCE_KEYS: Final = (
    "motors",
    *(f"{name}_{unit}" for name in ("window", "following", "long_move") for unit in ("rad", "m")),
    "latency_s",
    "time_tolerance_s",
    "dead_man_s",
    "brake_s",
    "lost_s",
    "deadline_s",
    "fault_stimulus",
    "fault_code",
    "fault_value",
    "fault_over_value",
    "seeking_method",
    "claims",
    "without",
)


_BY_KEY: Final = {capability.key: capability for capability in Capability}


_LENGTH_MAX: Final = 1e6


_TIME_MAX_S: Final = 3600.0


@final
@dataclass(frozen=True, slots=True)
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
        deadline_s: the deadline for one clause [s of wall time].
        fault_stimulus: the stimulus that causes a controller fault.
        fault_code: the error code that the drive then reports.
        fault_value: the value of the stimulus; None: the code.
        fault_over_value: its value a moment later; None: not needed, the cause is gone by then.
        seeking_method: a homing method that runs until it is ended; None: none is known.
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
    deadline_s: float = 30.0
    fault_stimulus: str = "fault"
    fault_code: int = 0x2310
    fault_value: float | None = None
    fault_over_value: float | None = None
    seeking_method: int | None = None
    claims: tuple[Capability, ...] = ()
    claimed_at: Mapping[Capability, str] = field(default_factory=lambda: MappingProxyType({}))
    without: Mapping[Capability, str] = field(default_factory=lambda: MappingProxyType({}))


NOTHING_DECLARED: Final = Facts()


def read_facts(table: Table, motors: tuple[str, ...]) -> Facts:
    """Read a rig's `[conformance]` table; `motors` are the names of the rig's motors.

    Raises:
        RigError: the first error in the table.
    """
    table.refuse_unknown(CONFORMANCE_KEYS)
    usual = NOTHING_DECLARED
    named = table.texts("motors", (), example='["left"]')
    for place, name in enumerate(named):
        if name not in motors:
            raise table.source.no_such((*table.path, "motors", place), name, motors, "motor")
        if name in named[:place]:
            path = (*table.path, "motors", place)
            raise table.source.error(path, f'"{name}" is listed twice', "name each motor once")
    unit = _unit(table)
    claimed = _claimed(table)
    return Facts(
        motors=named,
        unit=unit,
        window=_length(table, "window", unit, usual.window),
        following=_length(table, "following", unit, usual.following),
        long_move=_long_move(table, unit),
        latency_s=_latency(table, usual.latency_s),
        time_tolerance_s=_time(table, "time_tolerance_s", usual.time_tolerance_s),
        dead_man_s=_time(table, "dead_man_s", usual.dead_man_s),
        brake_s=_time(table, "brake_s", 1.0) if table.has("brake_s") else None,
        lost_s=_time(table, "lost_s", usual.lost_s),
        deadline_s=_time(table, "deadline_s", usual.deadline_s),
        fault_stimulus=table.text("fault_stimulus", usual.fault_stimulus),
        fault_code=table.integer("fault_code", usual.fault_code, low=1, high=0xFFFF_FFFF),
        fault_value=_value(table, "fault_value"),
        fault_over_value=_value(table, "fault_over_value"),
        seeking_method=table.integer("seeking_method", 0, low=-128, high=127)
        if table.has("seeking_method")
        else None,
        claims=tuple(claimed),
        claimed_at=MappingProxyType(claimed),
        without=_without(table.table("without"), claimed),
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


def _length(table: Table, name: str, unit: str, default: float) -> float:
    key = f"{name}_{unit or 'rad'}"
    return table.number(key, default, low=1e-12, high=_LENGTH_MAX, unit=unit, example="0.001")


def _long_move(table: Table, unit: str) -> float | None:
    return _length(table, "long_move", unit, 1.0) if table.has(f"long_move_{unit}") else None


def _value(table: Table, key: str) -> float | None:
    if not table.has(key):
        return None
    return table.number(key, 0.0, low=-_LENGTH_MAX, high=_LENGTH_MAX, example="1.0")


def _time(table: Table, key: str, default: float) -> float:
    return table.number(key, default, low=1e-9, high=_TIME_MAX_S, unit="s", example="0.1")


def _latency(table: Table, default: tuple[float, float]) -> tuple[float, float]:
    if not table.has("latency_s"):
        return default
    value = table.values["latency_s"]
    numbers = isinstance(value, list) and [
        float(one) for one in value if isinstance(one, int | float) and not isinstance(one, bool)
    ]
    if not numbers or len(numbers) != 2 or not -_TIME_MAX_S <= numbers[0] <= numbers[1] <= 10.0:
        raise table.error(
            "latency_s",
            "is not a list of two times [s], minimum first",
            "write latency_s = [0.0, 0.001]",
        )
    return numbers[0], numbers[1]


def _capability(table: Table, name: str, path: tuple[str | int, ...]) -> Capability:
    if name not in _BY_KEY:
        raise table.source.no_such(path, name, list(_BY_KEY), "capability")
    return _BY_KEY[name]


def _claimed(table: Table) -> dict[Capability, str]:
    """Return the capabilities that the rig claims, with their places in its file."""
    claimed = {}
    for place, name in enumerate(table.texts("claims", (), example='["homing"]')):
        path = (*table.path, "claims", place)
        at = f"{table.source.path}:{table.source.line(path)}"
        claimed[_capability(table, name, path)] = at
    return claimed


def _without(table: Table, claimed: Mapping[Capability, str]) -> Mapping[Capability, str]:
    table.refuse_unknown(tuple(_BY_KEY))
    reasons = {}
    for name in table.values:
        reason = table.text(name, example='"no switches on this bench"')
        if not reason.strip():
            raise table.error(name, "has an empty reason", "state the reason")
        if _BY_KEY[name] in claimed:
            raise table.error(name, f"is claimed at {claimed[_BY_KEY[name]]}", "remove one of them")
        reasons[_BY_KEY[name]] = reason
    return MappingProxyType(reasons)
