"""Property: a relative move is never made twice, whatever happens to frames.

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

    from harness.rig import Rig
    from harness.sharing.at_most_once import at_most_once
    from harness.sharing.relative_moves import mover_of

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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, final

from hypothesis import Phase, event, given, settings
from hypothesis import strategies as st

from emulators.media.can_frame import can_id_of
from emulators.media.faults import FaultKind, FaultRule
from harness.rig_faults import HOST
from harness.sharing.relative_moves import MadeMoreThanOnce, Mover, Plan, Reach, Step, judge

KINDS: Final = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE)
RULES_MAX: Final = 3
MOVES_MAX: Final = 3

_UNDER_WAY_NS: Final = 20_000_000
_STARTING_MS: Final = 60
_WHOLE_MS: Final = 2000
_MS: Final = 1_000_000


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
    heard: list[tuple[int, int]] = []
    moved_ns: list[int] = []
    with mover.make_rig(0) as rig:
        mover.ready(rig)
        begin = mover.truth(rig)

        def on_frame(_bus: str, time_ns: int, _sender: str, frame: bytes) -> None:
            heard.append((time_ns, can_id_of(frame)))
            if not moved_ns and abs(mover.truth(rig) - begin) > mover.tolerance:
                moved_ns.append(time_ns)

        rig.world.tap_frames(on_frame)
        mover.move(rig, way)
        rig.runtime.run_for(mover.settle_s)
        end = mover.truth(rig)
    if not moved_ns or abs(end - begin - way) > mover.tolerance:
        raise MadeMoreThanOnce(f"{mover.name}: undisturbed, from {begin:g} by {way:g} to {end:g}")
    until_ns = moved_ns[0] + _UNDER_WAY_NS
    starting = sum(1 for time_ns, _ in heard if time_ns <= until_ns)
    return Traffic(tuple(sorted({can_id for _, can_id in heard})), starting)


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
        begins_ms,
        st.none() | st.integers(1, _WHOLE_MS),
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
    from_ms: int,
    length_ms: int | None,
    probability: float,
    skip: int,
    limit: int | None,
    delay_ns: int,
) -> FaultRule:
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
