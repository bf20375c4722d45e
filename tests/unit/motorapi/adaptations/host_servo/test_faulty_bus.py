"""Central servo on a bus that loses, delays and repeats frames.

The servo keeps control of its motor, or releases it.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import event, example, given, settings
from hypothesis import strategies as st

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import MotorError, PluginError
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import HEAD
from tests.support.motors.software_rigs import INC_PER_RAD, inc, one
from tests.support.repetition import examples

SETTLED_INC = 10 + 100  # the window, and the motion since then
OVERSHOOT_INC = 0.1 * INC_PER_RAD

RULES = st.lists(
    st.builds(
        lambda kind, probability, delay_ns, late: FaultRule(
            kind.value,
            kind,
            probability=probability,
            delay_ns=delay_ns if kind is FaultKind.DELAY else 0,
            from_ns=600_000_000 if late else 0,
        ),
        st.sampled_from([FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE]),
        st.sampled_from([0.005, 0.02, 0.1, 0.3]),
        st.sampled_from([500_000, 1_500_000]),  # one cycle; on CAN no count overtakes another
        st.booleans(),
    ),
    unique_by=lambda rule: rule.kind,
    max_size=3,
)
DISTANCES = st.lists(st.floats(-0.6, 0.6).map(lambda x: round(x, 3)), min_size=1, max_size=2)


def test_count_cut_to_two_bytes_is_no_position(tmp_path):
    """A count of 35,888 was read as -29,648 after one bit of the answer's length had turned."""
    path = tmp_path / "rig.toml"
    path.write_text(HEAD + one())
    with Rig.open(path) as rig:
        left = rig.motors["left"]
        left.set_control_mode(ControlMode.TRAJECTORY)
        left.set_trajectory(TrapezoidalTrajectory(1.7))
        left.start()
        left.wait_until_done(10)
        left.disable()
        rig.runtime.run_for(0.2)
        assert inc(rig) > 0x7FFF
        answer = FaultRule("cut", FaultKind.CORRUPT, 0x581, flip=b"\x08")
        rig.faults.inject("can0", answer)
        with pytest.raises(ProtocolViolation, match="2 bytes"):
            left.position()


@settings(max_examples=examples(6), deadline=None)
@given(RULES, DISTANCES, st.integers(0, 1000))
@example([FaultRule("drop", FaultKind.DROP, probability=0.1)], [0.4, -0.4], 1)
def test_move_reported_as_done_is_at_its_target(
    rules: list[FaultRule], distances: list[float], seed: int
):
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(HEAD.replace("seed = 1", f"seed = {seed}") + one(motor="misses_max = 20"))
        rig = Rig.open(path)
    with rig:
        for rule in rules:
            rig.faults.inject("can0", rule)
        left = rig.motors["left"]
        left.set_control_mode(ControlMode.TRAJECTORY)
        for distance in distances:
            left.set_trajectory(TrapezoidalTrajectory(distance))
            begun = inc(rig)
            furthest = [begun, begun]

            def look(furthest: list[float] = furthest) -> None:
                furthest[:] = [min(furthest[0], inc(rig)), max(furthest[1], inc(rig))]

            looking = rig.runtime.every(0.002, look)
            try:
                left.start()
                left.wait_until_done(10)
                ends = "done"
            except PluginError:
                raise
            except MotorError as error:
                ends = type(error).__name__
            looking.cancel()
            event(ends)
            low, high = sorted((begun, begun + distance * INC_PER_RAD))
            assert furthest[0] >= low - OVERSHOOT_INC
            assert furthest[1] <= high + OVERSHOOT_INC
            if ends != "done":
                return
            assert abs(inc(rig) - begun - distance * INC_PER_RAD) <= SETTLED_INC


def test_property_scenario_has_faults_and_finished_motions():
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(HEAD + one(motor="misses_max = 20"))
        rig = Rig.open(path)
    with rig:
        left = rig.motors["left"]
        left.enable()
        rig.faults.inject("can0", FaultRule("drop", FaultKind.DROP, probability=0.1))
        left.set_control_mode(ControlMode.TRAJECTORY)
        left.set_trajectory(TrapezoidalTrajectory(0.5))
        left.start()
        left.wait_until_done(5)
        assert left.cycles.counts_missed > 20
        assert rig.faults.fired()["drop"] > 50
