"""Two joints with moteus controllers take poses; after a loss of power they find their place."""

from contextlib import suppress

from motorhil.harness.swarm.properties import always, sometimes
from motorhil.motorapi import ControlMode, DeviceFault, LinkError, Motor, MotorError
from tests.system.swarm.defects import correct, defect
from tests.system.swarm.defects.truth import Truth

RIG = "joint.toml"
POSES = ((0.5, -0.5), (1.0, 0.3), (0.2, 0.0))
NEAR_RAD = 0.05


class Joint:
    """A pose counts only with a reference; after a failure the pose is tried once more."""

    def __init__(self, rig):
        self.rig, self.runtime = rig, rig.runtime
        self.truth = Truth(rig)
        self.group = rig.groups["both"]
        self.names = ["left", "right"]
        self.joints = [rig.motors[name] for name in self.names]

    def run(self):
        """Take all poses, or give up; then nothing moves."""
        try:
            self.begin()
            for pose in POSES:
                self.take(pose)
                self.runtime.run_for(0.1)
        except MotorError:
            sometimes(True, "the poses are given up")
            self.rest()
        self.runtime.run_for(0.8)
        self.truth.require_rest(self.names, "the joints rest after their poses")

    def begin(self):
        """Set the reference where the joints are mounted."""
        for joint in self.joints:
            joint.home(35)
        self.group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)

    def take(self, pose):
        """Take a pose; try once more after a loss."""
        for is_last in (False, True):
            try:
                self.go(pose)
                break
            except (DeviceFault, LinkError):
                self.rest()
                if is_last:
                    raise
                self.recover()
        for name, target in zip(self.names, pose, strict=True):
            off = abs(self.truth.position(name) - target)
            always(off < NEAR_RAD, "a joint is in its pose")

    def go(self, pose):
        """Move all joints, and wait for them."""
        for joint, target in zip(self.joints, pose, strict=True):
            self.require_reference(joint)
            joint.set_setpoint(target)
        self.group.start()
        self.group.wait_until_done(timeout_s=2.0)

    def require_reference(self, joint):
        """Require that the joint knows where it is."""
        if not joint.is_referenced():
            raise LinkError(link=joint.name, reason="has lost its reference; set it by hand")

    def recover(self):
        """Make the joints ready again."""
        sometimes(True, "a pose is tried again")
        self.runtime.run_for(1.0)
        for joint in self.joints:
            joint.reset_fault()
            joint.enable()

    def rest(self):
        """Stop all joints, as far as they hear."""
        for joint in self.joints:
            with suppress(MotorError):
                joint.stop()
                joint.wait_until_done(timeout_s=1.0)


joint = correct(RIG)(Joint)


# --- defects -------------------------------------------------------------------------------------


@defect(RIG, "always | a joint is in its pose")
class TrustsThePositionAfterAPowerLoss(Joint):
    """The reference is set once; after a loss of power the position is taken as it is."""

    def require_reference(self, joint):
        pass


@defect(RIG, "always | a joint is in its pose")
class TakesTheHereForHome(Joint):
    """A joint without a reference gets one where it stands."""

    def require_reference(self, joint):
        if not joint.is_referenced():
            joint.home(35)
