"""Mistakes in commands: set-points, trajectories, starts."""

from dataclasses import replace
from math import ceil, inf, remainder, tau

from motorhil.motorapi.adaptations.cia402 import controlword as drive_control
from motorhil.motorapi.adaptations.cia402 import motion as drive_motions
from motorhil.motorapi.adaptations.cia402.csp import StreamedMotion
from motorhil.motorapi.adaptations.cia402.motion import DriveMotions
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.cia402.profile import TorqueUnit
from motorhil.motorapi.adaptations.host_servo.motor import SoftwareMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.adaptations.ideal.profiles import Led
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.api import polled_hardware
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.planning import functions
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.conformance.mutants import motions_changed, mutant, replaced

POSITION, VELOCITY = ControlVariable.POSITION, ControlVariable.VELOCITY
TORQUE, CURRENT = ControlVariable.TORQUE, ControlVariable.CURRENT


def is_setpoint(motion, variable):
    return motion.mode is ControlMode.SETPOINT and motion.variable is variable


def is_trajectory(motion, variable):
    return motion.mode is ControlMode.TRAJECTORY and motion.variable is variable


@mutant("ideal", "SET-01")
def set_point_taken_as_distance():
    """An absolute position is taken as a distance."""

    def wrong(motor, motion):
        absolute = is_setpoint(motion, POSITION) and not motor.logical.command.relative
        return replace(motion, target=motion.start + motion.target) if absolute else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "SET-02")
def same_distance_is_not_sent_again():
    """A distance equal to the previous one is not sent."""
    before = {}

    def wrong(motor, motion):
        command = motor.logical.command
        relative = isinstance(command, Setpoint) and command.relative
        value = command.value if relative else None
        known, before[motor] = before.get(motor), value
        return replace(motion, target=motion.start) if relative and known == value else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("leadshine", "SET-03")
def a_velocity_ends_by_itself():
    """A velocity set-point must be repeated within a second, or the drive stops."""

    def watched(fire):
        def fired(self):
            fire(self)
            started_ns = self.hardware.progress.started_ns

            def over():
                timer.cancel()
                if self.hardware.progress.started_ns == started_ns:
                    self.hardware.post_stop(quick=False)

            motion = self.armed_motion
            if is_setpoint(motion, VELOCITY):
                timer = self.runtime.every(1.0, over)

        return fired

    def noted(motor, motion):
        motor.armed_motion = motion
        return motion

    with replaced(PolledMotor, "fire", watched), motions_changed(PolledMotor, noted):
        yield


@mutant("cia402", "SET-04")
def half_the_torque():
    """A torque is sent in thousandths of the peak torque, which is twice the rated torque."""

    def halved(profile_of):
        def of(motion, unit):
            if is_setpoint(motion, TORQUE):
                motion = replace(motion, target=0.5 * motion.target)
            return profile_of(motion, unit)

        return of

    with replaced(drive_motions, "torque_profile_of", halved):
        yield


@mutant("leadshine", "SET-05")
def speeds_are_rounded_up():
    """A speed between two steps of the drive is rounded up."""
    with replaced(polled_hardware, "floor", lambda floor: ceil):
        yield


@mutant("cia402", "SET-05")
def limit_of_velocity_ignored_in_set_points():
    """A set-point's own velocity limit is ignored."""

    def wrong(motor, motion):
        limited = is_setpoint(motion, POSITION)
        return replace(motion, velocity=motor.model.velocity_max) if limited else motion

    with motions_changed(Cia402Motor, wrong):
        yield


@mutant("cia402", "SET-06")
def setting_switches_on():
    """The drive is enabled when a set-point is set, for a quick start."""

    def eager(check):
        def checked(self, variable, command):
            check(self, variable, command)
            if isinstance(command, Setpoint) and not command.limits:
                self._connect()
                self._enable()

        return checked

    with replaced(Cia402Motor, "_check_command", eager):
        yield


@mutant("software", "SET-07")
def currents_have_no_sign():
    """A current is sent without its sign."""

    def wrong(motor, motion):
        return replace(motion, target=abs(motion.target)) if motion.variable is CURRENT else motion

    with motions_changed(SoftwareMotor, wrong):
        yield


@mutant("ideal", "SET-08")
def as_fast_as_it_can():
    """A set-point without limits uses the speed of the hardware, not of the model."""

    def wrong(motor, motion):
        free = is_setpoint(motion, POSITION) and motor.logical.command.limits is None
        return replace(motion, velocity=2.0 * motion.velocity) if free else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("software", "SET-09")
def distances_count_from_the_last_target():
    """A distance that replaces a set-point in motion counts from the target of that one."""

    def wrong(read):
        def wronged(self):
            run = self.logical.physical.run
            before = None if run is None else run.motion
            moves = before is not None and is_setpoint(before, POSITION)
            return before.target if moves and not self._is_done() else read(self)

        return wronged

    with replaced(SoftwareMotor, "_read_reference", wrong):
        yield


@mutant("ideal", "TRAJ-01")
def absolute_taken_as_distance():
    """The final value of an absolute trajectory is taken as a distance."""

    def wrong(motor, motion):
        asked = motion.trajectory
        absolute = isinstance(asked, TrapezoidalTrajectory) and not asked.is_relative
        return replace(motion, target=motion.start + asked.final) if absolute else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "TRAJ-02")
def duration_ignored():
    """A trajectory goes as fast as the model allows, whatever time it was given."""

    def wrong(motor, motion):
        asked = motion.trajectory
        timed = isinstance(asked, TrapezoidalTrajectory) and asked.duration_s is not None
        if not timed or motion.variable is not POSITION:
            return motion
        return replace(motion, velocity=motor.model.velocity_max)

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("cia402", "TRAJ-03")
def slows_down_as_it_speeds_up():
    """The deceleration is not sent: the drive uses the acceleration."""

    def wrong(push):
        def pushed(self, acceleration, deceleration):
            push(self, acceleration, acceleration)

        return pushed

    with replaced(DriveMotions, "_push_ramps", wrong):
        yield


@mutant("ideal", "TRAJ-04")
def functions_begin_at_zero():
    """A relative function is followed as if the motor were at 0."""
    with motions_changed(IdealMotor, lambda motor, motion: replace(motion, offset=0.0)):
        yield


@mutant("cia402", "TRAJ-05")
def a_ramp_as_steep_as_can_be():
    """A velocity trajectory uses the ramps of the model, not its duration."""

    def wrong(motor, motion):
        if not is_trajectory(motion, VELOCITY):
            return motion
        steepest = motor.model.acceleration_max
        return replace(motion, acceleration=steepest, deceleration=steepest)

    with motions_changed(Cia402Motor, wrong):
        yield


@mutant("cia402", "TRAJ-06")
def a_step_of_torque():
    """A torque trajectory is a step to its final value."""

    def stepped(profile_of):
        def of(motion, unit):
            if is_trajectory(motion, TORQUE):
                motion = replace(motion, slope=inf)
            return profile_of(motion, unit)

        return of

    with replaced(drive_motions, "torque_profile_of", stepped):
        yield


@mutant("ideal", "TRAJ-07")
def integrated_by_the_nominal_period():
    """A velocity profile is integrated with a period that is 5 % too long."""

    def wrong(motor, motion):
        if motion.function is None or motion.variable is not VELOCITY:
            return motion
        return replace(motion, function=1.05 * motion.function)

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "TRAJ-08")
def final_velocity_is_forgotten():
    """A trajectory with a final velocity ends at rest."""
    with motions_changed(IdealMotor, lambda motor, motion: replace(motion, final_velocity=0.0)):
        yield


@mutant("ideal", "START-01")
def an_equal_trajectory_is_not_sent_again():
    """A trajectory equal to the previous one is not sent."""
    before = {}

    def wrong(motor, motion):
        asked = motion.trajectory
        known, before[motor] = before.get(motor), asked
        return replace(motion, target=motion.start) if asked and asked is known else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("cia402", "START-02")
def ramps_only_grow():
    """Ramps are sent only if they are steeper than those in the drive."""
    told = {}

    def steeper(push):
        def pushed(self, *ramps):
            told[self] = tuple(map(max, ramps, told.get(self, ramps)))
            push(self, *told[self])

        return pushed

    with replaced(DriveMotions, "_push_ramps", steeper):
        yield


@mutant("cia402", "START-02")
def start_before_settings():
    """Ramps are written after the start: each motion uses those of the previous one."""
    late = {}

    def kept(push):
        def pushed(self, acceleration, deceleration):
            before, late[self] = late.get(self), (acceleration, deceleration)
            if before is not None:
                push(self, *before)

        return pushed

    with replaced(DriveMotions, "_push_ramps", kept):
        yield


@mutant("cia402", "START-03")
def set_points_wait_for_one_another():
    """A new set-point waits in the drive until the previous one is reached (bit 5 forgotten)."""
    with replaced(drive_control, "CHANGE_IMMEDIATELY", lambda bit: 0):
        yield


@mutant("ideal", "START-04")
def a_velocity_is_not_replaced():
    """During a velocity set-point, another velocity is not sent."""

    def wrong(motor, motion):
        velocity = motor._read_velocity()
        goes = is_setpoint(motion, VELOCITY) and velocity != 0.0
        return replace(motion, target=velocity) if goes else motion

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "START-05")
def setting_ends_what_goes_on():
    """Setting a trajectory during a motion ends the motion before any start."""

    def eager(check):
        def checked(self, variable, command):
            check(self, variable, command)
            if not isinstance(command, Setpoint) and not self.hardware.is_over:
                self.hardware.slow_down(self.model.deceleration)

        return checked

    with replaced(IdealMotor, "_check_command", eager):
        yield


@mutant("ideal", "MOVE-01")
def angles_within_a_turn():
    """Angles are reduced to half a turn on each side of 0, as for a compass."""

    def wrong(motor, motion):
        if not is_setpoint(motion, POSITION):
            return motion
        return replace(motion, target=remainder(motion.target, tau))

    with motions_changed(IdealMotor, wrong):
        yield


@mutant("ideal", "MOVE-02")
def an_end_without_a_beginning_is_none():
    """A trajectory is over when a movement was seen: one that is too short never ends."""

    def wrong(is_done):
        def done(self):
            run = self._physical.run
            motion = None if run is None else run.motion
            follows = motion is not None and motion.mode is ControlMode.TRAJECTORY
            return is_done(self) and not (follows and abs(motion.distance) < 1e-4)

        return done

    with replaced(IdealMotor, "_is_done", wrong):
        yield


@mutant("leadshine", "START-03")
def replaced_set_points_are_lost():
    """A set-point started during a motion is not sent to the drive."""

    def deaf(trigger):
        def triggered(self):
            known = self.progress.poll
            if known is None or not known.is_moving:
                trigger(self)

        return triggered

    with replaced(LeadshineHwMotor, "trigger", deaf):
        yield


@mutant("cia402", "TRAJ-09")
def the_last_set_point_is_left_out():
    """A stream ends one set-point early, and continues at the velocity of the one before."""

    def wrong(travelled):
        def made(self, at):
            end = self._demand.final_argument
            if at < end - 0.5 * self._period_s:
                self._early = at
                return travelled(self, at)
            self.over = True
            position = travelled(self, self._early)
            return position + (at - self._early) * self.velocity

        return made

    with replaced(StreamedMotion, "_travelled", wrong):
        yield


@mutant("cia402", "START-06")
def ramps_are_written_for_trajectories_only():
    """A set-point has no ramps of its own, so those of the last trajectory remain."""
    ramps = {}

    def wrong(motor, motion):
        if is_trajectory(motion, POSITION):
            ramps[motor] = motion.acceleration, motion.deceleration
        elif is_setpoint(motion, POSITION) and motor in ramps:
            up, down = ramps[motor]
            return replace(motion, acceleration=up, deceleration=down)
        return motion

    with motions_changed(Cia402Motor, wrong):
        yield


@mutant("ideal", "LEAD-01")
def a_led_motor_is_done_with_its_leader_at_rest():
    """A motion over another motor's position is over as soon as that motor stands still."""

    def wrong(look):
        def looked(self, now_ns):
            look(self, now_ns)
            if self._look[2] == 0.0 and now_ns - self.begun_ns > 100_000_000:
                self.over_ns = now_ns

        return looked

    with replaced(Led, "look", wrong):
        yield


@mutant("cia402", "SET-10")
def more_than_that_is_not_needed():
    """Torques above a limit of the drive are accepted, and made as large as the limit."""

    def wrong(raw):
        return lambda unit, torque: raw(unit, max(-3.5, min(torque, 3.5)))

    with replaced(TorqueUnit, "raw", wrong):
        yield


@mutant("ideal", "LIM-06")
def far_enough():
    """A target beyond 5 rad is replaced by 5 rad."""

    def cut(_motor, motion):
        return replace(motion, target=max(-5.0, min(motion.target, 5.0)))

    with motions_changed(IdealMotor, cut):
        yield


@mutant("ideal", "TRAJ-14")
def velocities_do_not_bend():
    """The limit of the second derivative of a velocity is accepted and not kept."""

    def wrong(bend_of):
        def bend(model, variable, trajectory):
            return None if variable is VELOCITY else bend_of(model, variable, trajectory)

        return bend

    with replaced(functions, "bend_of", wrong):
        yield


@mutant("cia402", "LEAD-03")
def led_velocity_is_integrated_backwards():
    """The way of a velocity over an argument is counted against its direction."""

    def wrong(travelled):
        def backwards(motion, at):
            return 2.0 * motion._from - travelled(motion, at)

        return backwards

    with replaced(StreamedMotion, "_travelled", wrong):
        yield


@mutant("cia402", "MEAS-06")
def wraps_are_counted_twice():
    """Where the counter of the drive ends, its span is added twice."""

    def wrong(wrap):
        def counted(node, step):
            wrap(node, step)
            wrap(node, step)

        return counted

    with replaced(DriveNode, "_wrap", wrong):
        yield
