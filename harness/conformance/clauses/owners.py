"""L3: several owners of one motor, in sequences chosen by Hypothesis."""

from types import SimpleNamespace
from typing import Any, Final

from harness.conformance.bench import RigProtocol
from harness.conformance.capability import Ability, Capability
from harness.conformance.clause import Level, NotApplicable, Violated, clause
from harness.conformance.motions import long_move, reached, shortest_s

_EXAMPLES: Final = 8
_STEPS: Final = 15


@clause(
    "SHARE-11",
    Level.L3,
    needs={Capability.POSITION_TRAJECTORY},
    bench={Ability.SEVERAL_USERS, Ability.AFRESH},
    source="harness.sharing.machine: the history of every motor is that of one owner at a time",
)
def whatever_its_users_do_one_has_it_at_a_time(bench: RigProtocol) -> None:
    """Whatever users start, reserve, stop, take over, or die of, one has the motor at a time."""
    from hypothesis import HealthCheck, Phase, seed, settings
    from hypothesis.errors import HypothesisException

    from harness.sharing.history import SharingViolated
    from harness.sharing.machine import ownership_machine
    from harness.sharing.stage import Course

    if not hasattr(bench.runtime, "end"):
        raise NotApplicable("users cannot be killed in wall time")
    way = 0.05 * long_move(bench)
    quick_s = max(0.3, 2.0 * shortest_s(bench.motor, 3.0 * way))
    facts = bench.facts
    course = Course(way, quick_s, 2.0 * facts.window, facts.time_tolerance_s)
    machine: Any = ownership_machine(lambda: _rig_of(bench), course)
    machine.TestCase.settings = settings(
        deadline=None,
        max_examples=_EXAMPLES,
        stateful_step_count=_STEPS,
        phases=[Phase.generate],
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    seed(bench.seed)(machine)
    try:
        machine.TestCase().runTest()
    except (SharingViolated, HypothesisException) as error:
        raise Violated(f"{error}") from error
    moved = sum(count for name, count in machine.reach.items() if name.startswith("start: done"))
    reached(moved > 0, "a completed start of one of several users")


def _rig_of(bench: RigProtocol) -> Any:
    """Return the bench, switched on again, as a rig for the state machine."""
    bench.afresh()
    motor, other = bench.motor, bench.another_user_of(bench.motor)
    motors = {motor.name: motor, other.name: other}
    return SimpleNamespace(runtime=bench.runtime, motors=motors, close=lambda: None)
