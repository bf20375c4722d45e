"""What a rig declares of itself for conformance: its `[conformance]` table.

    [conformance]
    motors = ["left", "right"]          # under test; default: the first group, or all of one kind
    window_rad = 0.001                  # how far from its target a motor may come to rest
    following_rad = 0.0005              # how far from its trajectory it may be
    latency_s = [0.0, 0.001]            # from the start as told to the start of motion
    time_tolerance_s = 0.05             # how much earlier or later anything may be told to be over
    dead_man_s = 0.5                    # within which a drive must have noticed that the host died
    brake_s = 1.0                       # and how long until it is at rest then, whatever it did
    lost_s = 0.5                        # within which a host tells that a drive is lost
    long_move_rad = 1.0                 # a move that takes about a second
    deadline_s = 30.0                   # for one clause, of the wall's time; on a real bench 120
    fault_stimulus = "fault"            # what makes the controller fail, and the code it then has
    fault_code = 0x2310
    fault_value = 1.0                   # what the stimulus is given, if that is not the code
    fault_over_value = 0.0              # and what after a moment, so that the cause is gone
    seeking_method = 17                 # a homing that seeks a switch, and finds none on the bench
    claims = ["homing"]                 # what is claimed though the motor itself cannot tell

    [conformance.without]               # what is not claimed, and why
    homing = "no switches on this bench"

A linear motor has m where a rotary one has rad.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, final

from harness.conformance.capability import Capability
from harness.settings import Table

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
    """What a bench says of itself; U is rad or m.

    Attributes:
        motors: names of those under test; empty: whoever opens the bench chooses.
        unit: of the lengths below as they were declared: "rad", "m"; "" if none was.
        window: how far from its target a motor may come to rest [U].
        following: how far from what a trajectory demands a motor may be at any instant [U].
        long_move: a distance that takes about a second [U]; None: made from the motor's model.
        latency_s: from the start that is told to the start of motion, least and most [s].
        time_tolerance_s: how much earlier or later things may be told to be over [s].
        dead_man_s: within which a drive notices that its host is lost, and begins to brake [s].
        brake_s: within which it then is at rest, whatever it did [s]; None: made from the model.
        lost_s: within which a host tells that a drive does not answer any more [s].
        deadline_s: for one clause [s of the wall's time].
        fault_stimulus: the stimulus that makes a controller fail.
        fault_code: the code that the drive then tells.
        fault_value: what the stimulus is given; None: the code.
        fault_over_value: what it is given after a moment; None: nothing, its cause is gone then.
        seeking_method: of homing, that goes on until it is ended; None: none is known.
        claims: what is claimed by the rig.
        claimed_at: where it claims that, "file:line".
        without: what is not claimed, and why.
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
    """What a rig's `[conformance]` table says; `motors` are those of the rig.

    Raises:
        RigError: the first thing wrong in it.
    """
    table.refuse_unknown(CONFORMANCE_KEYS)
    usual = NOTHING_DECLARED
    named = table.texts("motors", (), example='["left"]')
    for place, name in enumerate(named):
        if name not in motors:
            raise table.source.no_such((*table.path, "motors", place), name, motors, "motor")
        if name in named[:place]:
            path = (*table.path, "motors", place)
            raise table.source.error(path, f'"{name}" is there already', "name each motor once")
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
    """In which the table's lengths are; all in one."""
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
            "latency_s", "is not two times [s], the least first", "write latency_s = [0.0, 0.001]"
        )
    return numbers[0], numbers[1]


def _capability(table: Table, name: str, path: tuple[str | int, ...]) -> Capability:
    if name not in _BY_KEY:
        raise table.source.no_such(path, name, list(_BY_KEY), "capability")
    return _BY_KEY[name]


def _claimed(table: Table) -> dict[Capability, str]:
    """What the rig claims, and where in its file."""
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
            raise table.error(name, "gives no reason", "say why: it is printed")
        if _BY_KEY[name] in claimed:
            raise table.error(name, f"is claimed at {claimed[_BY_KEY[name]]}", "say one of both")
        reasons[_BY_KEY[name]] = reason
    return MappingProxyType(reasons)
