"""Measured skew within its prediction: random groups, and cases near the bounds.

Predictions use declared traffic, which a test node really sends. Measurements use the bus record
and the plants' true states (tests/support/motors/skew_rigs.py).
"""

from dataclasses import replace
from pathlib import Path
from random import Random

import can
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.bus import open_bus, release_bus
from motorhil.motorapi.api.bus_traffic import traffic_on
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.runtime.wall import WallRuntime
from motorhil.motorapi.synchronization.bus_load import CanTraffic, declare_traffic
from motorhil.motorapi.synchronization.quality import SyncLevel
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import HEAD, drive
from tests.support.motors.skew_rigs import Outcome, run
from tests.support.motors.skew_scenarios import Choices, Member, Message, Scenario, drawn
from tests.support.repetition import examples

ROUNDING_NS = 2  # two times, each rounded to a whole nanosecond


def ratios(outcome: Outcome) -> dict[str, float | None]:
    """Return measured over predicted; None: no bound, or no measurement."""
    told = outcome.predicted
    pairs = {
        "command": (told.command_skew_s, outcome.command_ns, told.no_command_bound),
        "start": (told.start_skew_s, outcome.start_ns, told.no_start_bound),
        "end": (told.end_skew_s, outcome.end_ns, told.no_end_bound),
    }
    found: dict[str, float | None] = {}
    for name, (bound_s, measured_ns, reason) in pairs.items():
        assert (bound_s is None) == bool(reason), f"{name}: a bound, or a reason why there is none"
        if bound_s is None or measured_ns is None:
            found[name] = None
            continue
        assert measured_ns <= bound_s * 1e9 + ROUNDING_NS, (
            f"{name} skew {measured_ns} ns, and at most {bound_s * 1e9:.0f} ns were predicted"
        )
        found[name] = measured_ns / (bound_s * 1e9) if bound_s else 1.0
    return found


def _reached(ratio: float | None) -> str:
    if ratio is None:
        return "no bound"
    return "all of the bound" if ratio >= 1.0 else f"{int(ratio * 4) * 25} % or more of the bound"


@settings(max_examples=examples(12), deadline=None)
@given(st.data())
def test_random_groups_do_not_exceed_the_prediction(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
):
    scenario = drawn(Choices(lambda low, high: data.draw(st.integers(low, high))))
    outcome = run(scenario, tmp_path_factory.getbasetemp() / "skew.toml")
    for name, ratio in ratios(outcome).items():
        event(f"{name} skew: {_reached(ratio)}")
    if outcome.told_command_s is not None and outcome.predicted.command_skew_s is not None:
        assert outcome.told_command_s <= outcome.predicted.command_skew_s + 2e-9


def test_random_groups_have_bounds_and_reach_half_of_them(tmp_path: Path):
    """Check the premise of the property above: most scenarios have bounds, and come near them."""
    found: list[dict[str, float | None]] = []
    for seed in (0, 2, 4, 9, 11):
        scenario = drawn(Choices(Random(seed).randint))
        found.append(ratios(run(scenario, tmp_path / "skew.toml")))
    command = [one["command"] for one in found]
    assert command.count(None) <= 1
    assert max(one for one in command if one is not None) > 0.5


# --- near the bounds: each term of a prediction is needed ----------------------------------------


ALONE = Member("alone", 0, 0.1)
LATCHED = Member("latched", 0, 0.1)


def eager(*can_ids: int, period_us: int = 20_000) -> tuple[Message, ...]:
    """Return messages that are all sent at once when the first motor is started."""
    return tuple(Message(0, can_id, False, 8, period_us, 0, 0, True) for can_id in can_ids)


def ran(tmp_path: Path, *members: Member, messages=(), bitrates=(1_000_000,)) -> Outcome:
    scenario = Scenario(members, tuple(messages), bitrates, inhibit_ms=20.0, heartbeat=False)
    outcome = run(scenario, tmp_path / "skew.toml")
    assert outcome.sent or not messages
    return outcome


def test_one_sync_latches_all_and_the_next_tick_starts_all(tmp_path: Path):
    early, late = replace(LATCHED, phase_s=0.0), replace(LATCHED, phase_s=0.000_95)
    outcome = ran(tmp_path, early, late)
    found = ratios(outcome)
    assert outcome.command_ns == 0
    assert outcome.predicted.command_skew_s == 0.0
    assert outcome.predicted.start_skew_s == 0.001  # a profile tick, and no more
    assert found["start"] is not None
    assert outcome.start_ns in (50_000, 950_000)


def test_higher_priority_traffic_delays_the_second_start(tmp_path: Path):
    found = ratios(ran(tmp_path, ALONE, ALONE, messages=eager(*range(0x100, 0x118))))
    assert found["command"] is not None
    assert found["command"] > 0.8


def test_drive_that_answers_late_delays_the_next_one(tmp_path: Path):
    live = Member("live", 0, 0.1, reply_s=0.02)
    found = ratios(ran(tmp_path, *[live] * 4))
    assert found["command"] is not None
    assert found["command"] > 0.6  # three answers are awaited; the bound includes the last one, too


def test_second_bus_begins_a_sync_later(tmp_path: Path):
    there = replace(LATCHED, bus=1)
    messages = [replace(one, bus=1) for one in eager(*range(0x010, 0x016))]
    outcome = ran(tmp_path, LATCHED, there, messages=messages, bitrates=(1_000_000, 125_000))
    found = ratios(outcome)
    assert outcome.predicted.level is SyncLevel.SEQUENTIAL
    assert found["command"] is not None


def test_different_clocks_separate_the_ends_as_predicted(tmp_path: Path):
    fast, slow = replace(LATCHED, ppm=9_500.0), replace(LATCHED, ppm=-9_500.0)
    found = ratios(ran(tmp_path, fast, slow))
    assert found["end"] is not None
    assert found["end"] > 0.7


def test_stream_and_set_point_are_a_period_apart(tmp_path: Path):
    outcome = ran(tmp_path, Member("streamed", 0, 0.1), LATCHED)
    found = ratios(outcome)
    assert outcome.command_ns == 5_000_000
    assert found["command"] is not None
    assert found["command"] > 0.7
    assert "streamed set-points is not predicted" in outcome.predicted.no_end_bound


# --- where there is no bound ---------------------------------------------------------------------


def group_of(rig: Rig, variable: ControlVariable = ControlVariable.POSITION) -> MotorGroup:
    group = MotorGroup(rig.motors["a"], rig.motors["b"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY, variable)
    group.set_trajectory(TrapezoidalTrajectory(0.1), TrapezoidalTrajectory(0.1))
    return group


def rig_of(tmp_path: Path, motor: str = "", controller: str = "", head: str = HEAD) -> Rig:
    path = tmp_path / "rig.toml"
    both = (drive(name, number, controller, motor) for number, name in enumerate("ab", 1))
    path.write_text(head + "".join(both))
    return Rig.open(path)


ALL_TOLD = "servo_period_ms = 1\noscillator_ppm = 50\nsdo_reply_ms = 1.1"
SEQUENTIAL = 'objects = { "1005h" = 0x81 }'


def test_undeclared_traffic_has_no_bound_until_declared(tmp_path: Path):
    with rig_of(tmp_path, ALL_TOLD, SEQUENTIAL) as rig:
        group = group_of(rig)
        told = group.sync_capability()
        assert told.command_skew_s is told.start_skew_s is told.end_skew_s is None
        reason = "a: the other traffic on can0 is not declared (declare_traffic)"
        assert told.no_command_bound == told.no_start_bound == told.no_end_bound == reason
        with pytest.raises(UsageError):
            group.start(max_skew_s=1.0)
        declare_traffic(rig.bus("can0"), CanTraffic(1_000_000))
        told = group.sync_capability()
        assert told.command_skew_s is not None
        assert (told.no_command_bound, told.no_start_bound, told.no_end_bound) == ("", "", "")
        declare_traffic(rig.bus("can0"), None)
        assert group.sync_capability().command_skew_s is None


@pytest.mark.parametrize(
    ("motor", "start", "end"),
    [
        (
            "oscillator_ppm = 50",
            "a: its profile tick is not known (servo_period_ms)",
            "a: its profile tick is not known (servo_period_ms)",
        ),
        ("servo_period_ms = 1", "", "a: the accuracy of its clock is not known (oscillator_ppm)"),
    ],
)
def test_unspecified_drive_has_no_bound(tmp_path: Path, motor: str, start: str, end: str):
    with rig_of(tmp_path, motor) as rig:
        told = group_of(rig).sync_capability()
        assert told.command_skew_s == 0.0  # one SYNC, independent of other traffic
        assert (told.no_start_bound, told.no_end_bound) == (start, end)


def test_handshake_requires_the_answer_time_of_the_drive(tmp_path: Path):
    motor = "servo_period_ms = 1\noscillator_ppm = 50"
    head = f"{HEAD}message = []\n"
    with rig_of(tmp_path, motor, SEQUENTIAL, head) as rig:
        told = group_of(rig, ControlVariable.VELOCITY).sync_capability()
        assert told.no_command_bound == (
            "a: the drive's SDO response time is not known (sdo_reply_ms)"
        )


def test_event_driven_pdo_without_inhibit_time_has_no_bound(tmp_path: Path):
    motor = f"{ALL_TOLD}\nstatus_inhibit_ms = 0"
    with rig_of(tmp_path, motor, SEQUENTIAL, f"{HEAD}message = []\n") as rig:
        told = group_of(rig).sync_capability()
        assert told.no_command_bound == (
            "a: the traffic on can0 has no bound: TPDO 181h of node 1 has no inhibit time"
        )


def test_wall_time_has_no_bound_despite_a_declaration():
    with can.Bus(interface="virtual", channel="skew", receive_own_messages=True) as bus:
        declare_traffic(bus, CanTraffic(1_000_000))
        bus_end = open_bus(bus, WallRuntime())
        traffic, why = traffic_on(bus_end.link)
        release_bus(bus_end)
    assert traffic is None
    assert why == "on the wall clock the delays of this program have no bound"


def test_declare_traffic_with_invalid_values_raises():
    with (
        can.Bus(interface="virtual", channel="skew") as bus,
        pytest.raises(UsageError, match="is not a CanTraffic"),
    ):
        declare_traffic(bus, "nothing")  # type: ignore[arg-type]
