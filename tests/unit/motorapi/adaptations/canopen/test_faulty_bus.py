"""Motions on a bus that loses, delays and repeats frames.

Each motion ends at its target, or with an error.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import MotorError, PluginError
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.drive_rigs import HEAD, drive

TOLERANCE_RAD = 2e-3  # the drive's position window is 10 increments of 21,008 per rad
CONNECTED_NS = 600_000_000  # well after the bring-up of the drives

RULES = st.lists(
    st.builds(
        lambda kind, probability, delay_ns, late: FaultRule(
            kind.value,
            kind,
            probability=probability,
            delay_ns=delay_ns if kind is FaultKind.DELAY else 0,
            from_ns=CONNECTED_NS if late else 0,
        ),
        st.sampled_from([FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE]),
        st.sampled_from([0.005, 0.02, 0.1]),
        st.sampled_from([500_000, 5_000_000, 50_000_000, 400_000_000]),
        st.booleans(),
    ),
    unique_by=lambda rule: rule.kind,
    max_size=3,
)
DISTANCES = st.lists(st.floats(-1.0, 1.0).map(lambda x: round(x, 3)), min_size=1, max_size=3)


def rig_with(rules: list[FaultRule], seed: int, *drives: str) -> Rig:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(HEAD.replace("seed = 1", f"seed = {seed}") + "".join(drives))
        rig = Rig.open(path)
    for rule in rules:
        rig.faults.inject("can0", rule)
    return rig


@settings(max_examples=20)
@given(RULES, DISTANCES, st.integers(0, 1000))
def test_move_reported_as_done_is_at_its_target(
    rules: list[FaultRule], distances: list[float], seed: int
):
    with rig_with(rules, seed, drive("left", 1)) as rig:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        for distance in distances:
            motor.set_trajectory(TrapezoidalTrajectory(distance))
            begun = rig.controllers["left"].snapshot()["demand_inc"]
            try:
                motor.start()
                motor.wait_until_done(10)
            except PluginError:
                raise
            except MotorError as error:
                event(type(error).__name__)
                moved_inc = abs(rig.controllers["left"].snapshot()["demand_inc"] - begun)
                assert moved_inc <= abs(distance) * 21_009 + 1  # never twice
                return
            event("reached")
            target = motor._reader.held[1]
            assert abs(rig.controllers["left"].snapshot()["position_rad"] - target) < TOLERANCE_RAD


@settings(max_examples=25)
@given(st.integers(0, 30_000), st.sampled_from(list(ControlVariable)[:2]), st.booleans())
def test_stop_during_group_start_leaves_no_motion_pending(
    delay_us: int, variable: ControlVariable, whole: bool
):
    with rig_with([], 1, drive("left", 1), drive("right", 2)) as rig:
        group = MotorGroup(rig.motors["left"], rig.motors["right"])
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT, variable)
        group.for_each(Motor.set_setpoint, 2.0)
        group.for_each(Motor.position)  # units are read: from here on starting is only arming
        stop = group.stop if whole else group[0].stop
        rig.world.queue.alarm(lambda now_ns: stop()).set(rig.runtime.now_ns() + delay_us * 1000)
        try:
            group.start()
            event("stopped after the start")
            rig.runtime.run_for(0.05)
            group.stop()
        except MotorError as error:
            event(type(error).__name__)  # then there is nothing to stop
        rig.runtime.run_for(0.3)
        group[0].hardware.node.bus.sync.send()  # anything still armed would start now
        rig.runtime.run_for(0.05)
        before = [rig.controllers[name].snapshot()["position_inc"] for name in ("left", "right")]
        rig.runtime.run_for(0.1)
        after = [rig.controllers[name].snapshot()["position_inc"] for name in ("left", "right")]
        assert after == before
