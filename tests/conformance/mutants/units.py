"""Mistakes of sign, unit and position, in commands and in measured values."""

from dataclasses import replace
from math import degrees, tau

from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.state import MotorState
from tests.conformance.mutants import motions_changed, mutant, replaced


@mutant("cia402", "UNIT-01")
def degrees_for_radians():
    """Angles are sent to the drive in degrees."""

    def in_degrees(motor, motion):
        return replace(motion, target=degrees(motion.target))

    with motions_changed(Cia402Motor, in_degrees):
        yield


@mutant("leadshine", "UNIT-01")
def encoder_of_2048_lines():
    """The encoder is assumed to have 2048 lines instead of 2000, in commands and answers."""
    with replaced(
        LeadshineHwMotor,
        "_per_unit",
        lambda per_unit: lambda self, model: per_unit(self, model) * 2048 / 2000,
    ):
        yield


@mutant("ideal", "UNIT-01")
def sign_of_the_gear_forgotten():
    """The sign of the gear ratio is ignored."""

    def turned(motor, motion):
        way = motion.target - motion.start
        return replace(motion, target=motion.start - way) if motor.name == "right" else motion

    from motorhil.motorapi.adaptations.ideal.motor import IdealMotor

    with motions_changed(IdealMotor, turned):
        yield


@mutant("ideal", "ID-01")
def all_motors_share_one_course():
    """All motors of a class share one motion."""
    everyone = []

    def kept(take):
        def taken(self, course, motion, failure=None, *, quietly=False):
            everyone[:] = [one for one in everyone if one.runtime is self.runtime]
            if self not in everyone:
                everyone.append(self)
            for one in everyone:
                take(one, course, motion, failure, quietly=quietly)

        return taken

    def listed(init):
        def made(self, *args, **kwargs):
            init(self, *args, **kwargs)
            everyone.append(self)

        return made

    with replaced(IdealHwMotor, "_take", kept), replaced(IdealHwMotor, "__init__", listed):
        yield


@mutant("leadshine", "ID-02")
def latest_asks_the_drive():
    """latest() asks the drive."""

    def asking(latest):
        def asked(self):
            self._poll()
            return latest(self)

        return asked

    with replaced(PolledMotor, "_latest", asking):
        yield


@mutant("cia402", "STATE-01")
def enabled_before_anything_was_heard():
    """Before its first message, a drive is reported as ready."""

    def hopeful(state):
        def told(self):
            return MotorState.ENABLED if self._hardware.facts is None else state(self)

        return told

    with replaced(DriveReader, "fresh_state", hopeful):
        yield


@mutant("leadshine", "STATE-02")
def disable_keeps_the_power_on():
    """disable() stops the motor and reports it as disabled, but its power stage stays on."""
    off = set()

    def lazy(disable):
        def disabled(self):
            off.add(self)
            self.post_stop(quick=False)

        return disabled

    def told(poll):
        def polled(self, model):
            found = poll(self, model)
            return replace(found, state=MotorState.DISABLED) if self in off else found

        return polled

    def on(enable):
        def enabled(self):
            off.discard(self)
            enable(self)

        return enabled

    with (
        replaced(LeadshineHwMotor, "disable", lazy),
        replaced(LeadshineHwMotor, "poll", told),
        replaced(LeadshineHwMotor, "enable", on),
    ):
        yield


@mutant("cia402", "MEAS-01")
def velocity_in_rpm():
    """The measured velocity is in revolutions per minute."""
    with replaced(
        DriveReader, "velocity", lambda velocity: lambda self: velocity(self) * 60.0 / tau
    ):
        yield


@mutant("cia402", "MEAS-02")
def torque_of_the_motors_shaft():
    """The measured torque is that of the motor, not of the output behind its gear."""
    with replaced(
        DriveReader, "torque", lambda torque: lambda self: torque(self) / self._model.gear_ratio
    ):
        yield


@mutant("cia402", "MEAS-03")
def following_error_turned_round():
    """The following error is actual minus demand."""
    with replaced(DriveReader, "following_error", lambda error: lambda self: -error(self)):
        yield


@mutant("cia402", "MEAS-01")
def a_velocity_of_0_is_taken_for_no_answer():
    """A velocity of 0 is taken for a value not yet received, and the one before is reported."""
    before = {}

    def wrong(velocity):
        def told(self):
            before[self] = velocity(self) or before.get(self, 0.0)
            return before[self]

        return told

    with replaced(DriveReader, "velocity", wrong):
        yield


@mutant("cia402", "MEAS-03")
def following_error_without_its_sign():
    """The following error is reported without its sign."""
    with replaced(DriveReader, "following_error", lambda error: lambda self: abs(error(self))):
        yield


@mutant("leadshine", "MEAS-04")
def positions_are_read_ten_times_a_second():
    """A position is asked for at most every 0.1 s, and repeated in between."""
    known = {}

    def wrong(read):
        def told(self):
            now_ns = self.runtime.now_ns()
            if self not in known or now_ns - known[self][0] > 100_000_000:
                known[self] = now_ns, read(self)
            return known[self][1]

        return told

    with replaced(PolledMotor, "_read_position", wrong):
        yield


@mutant("cia402", "MEAS-05")
def a_motor_is_where_it_was_sent():
    """A motor whose power is off is reported, and planned from, where it last was sent."""

    def wrong(position):
        def told(self):
            off = self.state() is MotorState.DISABLED and self.held[0] is not None
            return self.held[1] if off else position(self)

        return told

    with replaced(DriveReader, "position", wrong):
        yield
