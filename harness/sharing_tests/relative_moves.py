"""Relative moves under faults: a move is never made twice.

"One radian further" is a command that must not be repeated blindly. If its reply is lost, the host
cannot know whether the motor received it. A host that sends it again may move two radians. Whatever
is lost, delayed or repeated on the bus during a move, in either direction, must satisfy:

- Reported done: the motor is further by exactly the distance.
- Reported failed, by an error of `motorapi`: the motor is anywhere between its start and the
  distance, and was never further.
- Late frames (answers, commands) do not move it any more once it has come to rest.
- Any raised exception is an error of `motorapi`, and not one of the adaptation's own code.

The judgement uses the truth in the emulated controller, never the adaptation's reports. To run it
on your own adaptation, write a rig with your motor, and describe how it moves:

    from motorhil import Rig
    from motorhil.harness.sharing_tests.relative_moves import at_most_once, mover_of

    def opened(seed):
        return Rig.open("wheel.toml", seed=seed)

    def position(rig):  # of the truth
        return rig.controllers["wheel"].snapshot()["position_rad"]

    test_a_move_is_made_at_most_once = at_most_once(mover_of("wheel", opened, position))

`at_most_once` is a Hypothesis test. A plan of moves and faults that breaks the property is shrunk
and printed, and can be given to `judge` again. `single_faults` are the plans with exactly one
fault, at each frame in turn from the start of a move until it is under way. A property that is
never tested holds as well. Check the `Reach` of either, and require the cases that you need, such
as moves that failed although the motor had made them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Final, final

from hypothesis import Phase, event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import can_id_of
from motorhil.harness.rig.config.faults import HOST
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import MotorError, PluginError

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi.motor import Motor

DELAYS_NS: Final = (500_000, 5_000_000, 50_000_000, 150_000_000, 400_000_000)

_SAMPLE_S: Final = 0.002
_MOVE_TIMEOUT_S: Final = 10.0
_REST_S: Final = 0.05
_RPDOS: Final = range(0x200, 0x580)  # commands from hosts to controllers (CiA 301)
KINDS: Final = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE)
RULES_MAX: Final = 3
MOVES_MAX: Final = 3
_STARTED_NS: Final = 20_000_000
_STARTING_MS: Final = 60
_WHOLE_MS: Final = 2000
_MS: Final = 1_000_000


class MadeMoreThanOnce(AssertionError):  # noqa: N818 -- it says what happened, as a verdict does
    """A motor that went further than commanded, or elsewhere; the message names the plan."""


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Mover:
    """The subject of the judgement: how a motor of a rig makes a relative move.

    Attributes:
        name: its name in messages.
        make_rig: opens a rig with this seed, without faults of its own.
        ready: connects and enables the motor, still undisturbed.
        move: makes one relative move of either sign, and returns when the motor has reported it
            done; raises the motor's errors.
        truth: returns the true position [U] from a controller's snapshot.
        distance_max: maximum length of a move [U].
        tolerance: maximum distance from the target after a completed move [U].
        overshoot: maximum distance outside the path during a move [U].
        coast: additional distance after a failed move without braking [U]; only longer violations
            are found.
        delays_ns: possible delays of frames [ns]. A loop closed over the bus cannot work with late
            samples; such a motor needs short delays.
        settle_s: time after a move until the motor is at rest and no frame is pending [s].
    """

    name: str
    make_rig: "Callable[[int], Rig]"
    ready: "Callable[[Rig], None]"
    move: "Callable[[Rig, float], None]"
    truth: "Callable[[Rig], float]"
    distance_max: float = 1.0
    tolerance: float = 2e-3
    overshoot: float = 2e-3
    coast: float = 0.0
    delays_ns: tuple[int, ...] = DELAYS_NS
    settle_s: float = 1.5


def mover_of(
    motor: str,
    make_rig: "Callable[[int], Rig]",
    truth: "Callable[[Rig], float]",
    *,
    distance_max: float = 1.0,
    tolerance: float = 2e-3,
    overshoot: float = 2e-3,
) -> Mover:
    """Return a mover that gives relative position set-points to one motor of the rig."""

    def ready(rig: "Rig") -> None:
        rig.motors[motor].enable()

    def move(rig: "Rig", distance: float) -> None:
        chosen: Motor = rig.motors[motor]
        chosen.set_control_mode(ControlMode.SETPOINT)
        chosen.set_setpoint(distance, relative=True)
        chosen.start()
        chosen.wait_until_done(_MOVE_TIMEOUT_S)

    return Mover(
        name=motor,
        make_rig=make_rig,
        ready=ready,
        move=move,
        truth=truth,
        distance_max=distance_max,
        tolerance=tolerance,
        overshoot=overshoot,
    )


@final
@dataclass(frozen=True, slots=True)
class Step:
    """One move, and the faults from its start on.

    Attributes:
        distance: length of the move [U].
        rules: for every bus of the rig; their times count from the start of the move. A rule
            without an end also applies to later moves.
    """

    distance: float
    rules: tuple[FaultRule, ...] = ()


@final
@dataclass(frozen=True, slots=True)
class Plan:
    """Consecutive moves in a run with this seed."""

    seed: int
    steps: tuple[Step, ...]


@final
class Ending(Enum):
    """The result of one move, by its report and by the truth."""

    DONE = "done"
    FAILED_NOT_MADE = "failed, not moved"
    FAILED_PARTLY_MADE = "failed, partly moved"
    FAILED_MADE = "failed, although completely moved"


@final
@dataclass(slots=True)
class Reach:
    """Counters of the tested cases, since an untested property holds as well.

    Attributes:
        endings: moves by result.
        hit: moves with a fault, by result.
        errors: errors raised by moves, by class.
        fired: faults by kind.
        repeated: identical frames of the host in succession with one RPDO's identifier.
    """

    endings: dict[Ending, int] = field(default_factory=dict)
    hit: dict[Ending, int] = field(default_factory=dict)
    errors: dict[str, int] = field(default_factory=dict)
    fired: dict[FaultKind, int] = field(default_factory=dict)
    repeated: int = 0

    def add(self, other: "Reach") -> None:
        """Add the counters of another one."""
        for mine, theirs in ((self.endings, other.endings), (self.hit, other.hit)):
            for ending, count in theirs.items():
                mine[ending] = mine.get(ending, 0) + count
        for error, count in other.errors.items():
            self.errors[error] = self.errors.get(error, 0) + count
        for kind, count in other.fired.items():
            self.fired[kind] = self.fired.get(kind, 0) + count
        self.repeated += other.repeated

    def __str__(self) -> str:
        endings = "; ".join(
            f"{count} {ending.value} ({self.hit.get(ending, 0)} of them hit)"
            for ending, count in self.endings.items()
        )
        fired = ", ".join(f"{count} {kind.value}" for kind, count in self.fired.items())
        errors = ", ".join(f"{count} {name}" for name, count in self.errors.items())
        return (
            f"moves: {endings or 'none'}. Faults: {fired or 'none'}. Errors: {errors or 'none'}."
            f" Frames repeated by the host: {self.repeated}"
        )


def judge(mover: Mover, plan: Plan) -> Reach:
    """Make the moves of the plan and observe them throughout.

    Raises:
        MadeMoreThanOnce: the motor was at a position that no single move can reach, or is not at
            the target of a move reported as done.
        PluginError: the adaptation itself failed.
    """
    reach = Reach()
    with mover.make_rig(plan.seed) as rig:
        mover.ready(rig)
        repeats = _Repeats(rig)
        injected: list[FaultRule] = []
        for place, step in enumerate(plan.steps):
            injected += _inject(rig, step.rules, place)
            _judge_move(mover, rig, step.distance, plan, reach)
        reach.repeated = repeats.count
        fired = rig.faults.fired()
        for rule in injected:
            if fired[rule.name]:
                reach.fired[rule.kind] = reach.fired.get(rule.kind, 0) + fired[rule.name]
    return reach


def _inject(rig: "Rig", rules: Sequence[FaultRule], step: int) -> list[FaultRule]:
    """Inject the rules from now on, with unique names."""
    now_ns = rig.runtime.now_ns()
    injected = [
        replace(
            rule,
            name=f"{step}.{number} {rule.kind.value}",
            from_ns=rule.from_ns + now_ns,
            until_ns=None if rule.until_ns is None else rule.until_ns + now_ns,
        )
        for number, rule in enumerate(rules)
    ]
    for bus in rig.world.bus_names():
        for rule in injected:
            rig.faults.inject(bus, rule)
    return injected


@final
class _Displacement:
    """The range of a motor's positions since the start."""

    def __init__(self, mover: Mover, rig: "Rig") -> None:
        self._mover = mover
        self._rig = rig
        self.begin = mover.truth(rig)
        self.lowest = self.highest = self.now = self.begin
        self._timer = rig.runtime.every(_SAMPLE_S, self.sample)

    def sample(self) -> None:
        """Take the present position into account."""
        self.now = self._mover.truth(self._rig)
        self.lowest = min(self.lowest, self.now)
        self.highest = max(self.highest, self.now)

    def end(self) -> None:
        """Stop observing."""
        self.sample()
        self._timer.cancel()


def _judge_move(mover: Mover, rig: "Rig", distance: float, plan: Plan, reach: Reach) -> None:
    before = sum(rig.faults.fired().values())
    way = _Displacement(mover, rig)
    error: MotorError | None = None
    try:
        mover.move(rig, distance)
    except PluginError:
        raise
    except MotorError as raised:
        error = raised
        reach.errors[type(error).__name__] = reach.errors.get(type(error).__name__, 0) + 1
    was_hit = sum(rig.faults.fired().values()) > before
    rig.runtime.run_for(mover.settle_s)
    way.sample()
    at_rest = way.now
    rig.runtime.run_for(_REST_S)
    way.end()
    what = "was reported done" if error is None else f"failed ({type(error).__name__}: {error})"
    verdict = _verdict(mover, way, distance, is_done=error is None, at_rest=at_rest)
    if verdict:
        text = f"{mover.name}: a move by {distance:g} from {way.begin:g} {what}; {verdict}"
        raise MadeMoreThanOnce(f"{text}\n  {plan}")
    ending = _ending(mover, way, distance, is_done=error is None)
    reach.endings[ending] = reach.endings.get(ending, 0) + 1
    if was_hit:
        reach.hit[ending] = reach.hit.get(ending, 0) + 1


def _verdict(
    mover: Mover, way: _Displacement, distance: float, *, is_done: bool, at_rest: float
) -> str:
    """Return the violation as text, or an empty text."""
    low, high = sorted((way.begin, way.begin + distance))
    outside = mover.overshoot if is_done else mover.overshoot + mover.coast
    low, high = low - outside, high + outside
    if way.highest > high:
        return f"it was at {way.highest:g}, beyond {high:g}"
    if way.lowest < low:
        return f"it was at {way.lowest:g}, beyond {low:g}"
    if abs(way.now - at_rest) > mover.tolerance:
        return f"it still moves {mover.settle_s:g} s later, at {way.now:g}"
    if is_done and abs(way.now - way.begin - distance) > mover.tolerance:
        return f"it is at {way.now:g}"
    return ""


def _ending(mover: Mover, way: _Displacement, distance: float, *, is_done: bool) -> Ending:
    if is_done:
        return Ending.DONE
    if abs(way.now - way.begin) <= mover.tolerance:
        return Ending.FAILED_NOT_MADE
    if abs(way.now - way.begin - distance) <= mover.tolerance:
        return Ending.FAILED_MADE
    return Ending.FAILED_PARTLY_MADE


@final
class _Repeats:
    """Counter of identical frames of the host in succession with one RPDO's identifier."""

    def __init__(self, rig: "Rig") -> None:
        self.count = 0
        self._last: dict[tuple[str, int], bytes] = {}
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, _time_ns: int, sender: str, frame: bytes) -> None:
        can_id = can_id_of(frame)
        if not sender.startswith(HOST) or can_id not in _RPDOS:
            return
        if self._last.get((bus, can_id)) == frame:
            self.count += 1
        self._last[bus, can_id] = frame


@final
@dataclass(frozen=True, slots=True)
class Traffic:
    """The frames on the buses during one undisturbed move.

    Attributes:
        identifiers: identifiers of all frames, sorted.
        starting: number of frames from the call until the motor is under way.
    """

    identifiers: tuple[int, ...]
    starting: int


def traffic_of(mover: Mover, distance: float | None = None) -> Traffic:
    """Record the traffic of a move of `distance` [U]; None: half of the longest one.

    Raises:
        MadeMoreThanOnce: the motor did not move as reported.
    """
    way = mover.distance_max / 2.0 if distance is None else distance
    frames: list[tuple[int, int]] = []
    moved_ns: list[int] = []
    with mover.make_rig(0) as rig:
        mover.ready(rig)
        begin = mover.truth(rig)

        def on_frame(_bus: str, time_ns: int, _sender: str, frame: bytes) -> None:
            frames.append((time_ns, can_id_of(frame)))
            if not moved_ns and abs(mover.truth(rig) - begin) > mover.tolerance:
                moved_ns.append(time_ns)

        rig.world.tap_frames(on_frame)
        mover.move(rig, way)
        rig.runtime.run_for(mover.settle_s)
        end = mover.truth(rig)
    if not moved_ns or abs(end - begin - way) > mover.tolerance:
        raise MadeMoreThanOnce(f"{mover.name}: undisturbed, from {begin:g} by {way:g} to {end:g}")
    until_ns = moved_ns[0] + _STARTED_NS
    starting = sum(1 for time_ns, _ in frames if time_ns <= until_ns)
    return Traffic(tuple(sorted({can_id for _, can_id in frames})), starting)


def single_faults(mover: Mover) -> list[Plan]:
    """Return plans of two moves, forth and back, with one fault at each frame of a start."""
    traffic = traffic_of(mover)
    distance = mover.distance_max / 2.0
    delays_ns = mover.delays_ns[len(mover.delays_ns) // 2 :: 2]
    plans: list[Plan] = []
    for place in range(traffic.starting):
        rules = [
            FaultRule("drop", FaultKind.DROP, skip=place, limit=1),
            FaultRule("duplicate", FaultKind.DUPLICATE, skip=place, limit=1),
            *(
                FaultRule("delay", FaultKind.DELAY, skip=place, limit=1, delay_ns=delay_ns)
                for delay_ns in delays_ns
            ),
        ]
        plans += [Plan(1, (Step(distance, (rule,)), Step(-distance))) for rule in rules]
    return plans


def plans(mover: Mover) -> st.SearchStrategy[Plan]:
    """Return a strategy of plans whose faults affect all frames or those of one identifier."""
    return st.deferred(lambda: _plans(mover, traffic_of(mover)))


def _plans(mover: Mover, traffic: Traffic) -> st.SearchStrategy[Plan]:
    begins_ms = st.just(0) | st.integers(0, _STARTING_MS) | st.integers(0, _WHOLE_MS)
    rule = st.builds(
        _rule,
        st.sampled_from(KINDS),
        st.sampled_from([None, *traffic.identifiers]),
        st.sampled_from([None, HOST]),
        st.tuples(begins_ms, st.none() | st.integers(1, _WHOLE_MS)),
        st.sampled_from([1.0, 0.5, 0.1, 0.02]),
        st.integers(0, 5) | st.integers(0, traffic.starting),
        st.sampled_from([1, 2, 5, None]),
        st.sampled_from(mover.delays_ns),
    )
    most = mover.distance_max
    distance = st.floats(-most, most).map(lambda x: round(x, 3))
    step = st.builds(Step, distance, st.lists(rule, max_size=RULES_MAX).map(tuple))
    steps = st.lists(step, min_size=1, max_size=MOVES_MAX).map(tuple)
    return st.builds(Plan, st.integers(0, 1000), steps)


def _rule(
    kind: FaultKind,
    identifier: int | None,
    sender: str | None,
    period_ms: tuple[int, int | None],
    probability: float,
    skip: int,
    limit: int | None,
    delay_ns: int,
) -> FaultRule:
    from_ms, length_ms = period_ms
    from_ns = from_ms * _MS
    return FaultRule(
        kind.value,
        kind,
        identifier=identifier,
        sender=sender,
        from_ns=from_ns,
        until_ns=None if length_ms is None else from_ns + length_ms * _MS,
        probability=probability,
        skip=skip,
        limit=limit,
        delay_ns=delay_ns if kind is FaultKind.DELAY else 0,
    )


def at_most_once(
    mover: Mover, *, examples: int = 50, reach: Reach | None = None, shrink: bool = True
) -> Callable[[], None]:
    """Return the property as a Hypothesis test without arguments, for pytest or a direct call.

    Args:
        mover: the move to judge.
        examples: number of plans.
        reach: the reached cases are added to it.
        shrink: search for the smallest failing plan, which may take minutes.
    """
    phases = [phase for phase in Phase if shrink or phase not in (Phase.shrink, Phase.explain)]

    @settings(max_examples=examples, deadline=None, phases=phases)
    @given(plans(mover))
    def test(plan: Plan) -> None:
        found = judge(mover, plan)
        for ending in found.endings:
            event(ending.value)
        if reach is not None:
            reach.add(found)

    return test
