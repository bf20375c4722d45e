"""The adaptation of the motor interface to drives with impedance control.

| command         | stream of commands                                          |
| --------------- | ----------------------------------------------------------- |
| position        | the demand with its velocity; kp, kd; torque of the inertia |
| velocity        | a ramp; kp = 0                                              |
| torque          | a ramp; kp = kd = 0: nothing limits the velocity            |
| stop, halt      | a ramp to rest, then that position                          |
| homing (35, 37) | off, zero here, on                                          |

Motors start one after another: there is no common signal.
"""

from contextlib import suppress
from dataclasses import dataclass, replace
from math import copysign
from typing import Final, final

from motorhil.motorapi.adaptations.mit.frames import (
    MODELS,
    Command,
    Frames,
    Maker,
    Special,
)
from motorhil.motorapi.adaptations.mit.hardware import (
    FOLLOWING_ERROR,
    MitHwMotor,
    MitOptions,
    Plan,
)
from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    CanMotor,
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    Fault,
    LimitError,
    Measurement,
    Motion,
    MotionTimes,
    MotorModel,
    MotorState,
    PeerError,
    Ramps,
    Setpoint,
    Trajectory,
    TrapezoidalTrajectory,
    adaptation,
    can_stream,
    demand_of,
    output_sign,
    require_here,
    require_time,
    text,
    whole,
    word,
)


@final
class MitMotor(CanMotor[MitHwMotor]):
    """A logical motor on such a drive; several of them may share one hardware object."""

    def _units_of(self, model: MotorModel) -> float:
        return output_sign(model)

    # --- the six -----------------------------------------------------------------------------

    def _latest(self) -> Measurement | None:
        hardware, answer, sign = self.hardware, self.hardware.answer, self._units
        if answer is None:
            return None
        state = MotorState.ENABLED if hardware.is_held else MotorState.DISABLED
        behind = 0.0 if hardware.behind is None else sign * hardware.behind
        return Measurement(
            *(hardware.time_ns, MotorState.FAULT if hardware.fault else state),
            *(sign * answer.p, sign * answer.v, sign * answer.t, behind),
        )

    def _enable(self) -> None:
        hardware = self.hardware
        if hardware.plan is not None and hardware.is_on:
            return  # after a quick stop
        hardware.hold_here()
        hardware.ask(
            Special.ENTER, lambda: hardware.is_on or self._fault() is not None, "motor mode"
        )
        self._check_fault()

    def _disable(self) -> None:
        hardware = self.hardware
        hardware.release()
        hardware.ask(Special.LEAVE, lambda: not hardware.is_on, "the end of motor mode")

    def _command(self, motion: Motion) -> None:
        require_time(self.name, motion)
        ranges, furthest = self.hardware.frames.ranges, motion.target
        limit, unit = {
            ControlVariable.POSITION: (ranges.p, "rad"),
            ControlVariable.VELOCITY: (ranges.v, "rad/s"),
            ControlVariable.TORQUE: (ranges.t, "N·m"),
        }[motion.variable]
        if motion.function is not None:
            low, high = motion.function.bounds(*motion.interval)
            furthest = motion.offset + max(low, high, key=lambda end: abs(motion.offset + end))
        if abs(furthest) > limit:
            raise LimitError(
                motor=self.name,
                quantity=motion.variable.value,
                value=furthest,
                low=-limit,
                high=limit,
                unit=unit,
                reason="the range of the drive's frames",
            )
        self.hardware.follow(*self._planned(motion))

    def _stop(self) -> None:
        hardware, size = self.hardware, self._physical.stop_deceleration(self.model.deceleration)
        answer, now = hardware.answer, hardware.present()
        if not hardware.is_on or answer is None:
            return
        p, v = (now.p, now.v) if now.kp else (answer.p, answer.v)
        slower = -size if v > 0.0 else size
        end_s = abs(v) / size
        kp, kd = hardware.options.kp_n_m_rad, hardware.options.kd_n_m_s_rad

        def plan(at_s: float) -> Command:
            s = min(at_s, end_s)
            return Command(p + (v + 0.5 * slower * s) * s, v + slower * s, kp, kd)

        hardware.stop(plan)

    # --- capabilities ------------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable is not ControlVariable.CURRENT

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        if not can_stream(variable, command):
            super()._check_command(variable, command)

    def _motion_times(self) -> MotionTimes | None:
        return self.hardware.times()

    def _read_reference(self) -> float:
        held = self.hardware.present()
        return self._units * held.p if held.kp else self._read_position()

    def _read_referenced(self) -> bool:
        return self.hardware.is_zeroed

    def _read_fault(self) -> Fault | None:
        return self._fault()

    def _is_done(self) -> bool:
        self.hardware.check_stream()
        if self.hardware.mismatch:
            raise PeerError(self.hardware.mismatch)
        return super()._is_done()

    def _reset_fault(self) -> None:
        hardware = self.hardware
        hardware.release()
        steps = [Special.LEAVE, Special.CLEAR]
        if hardware.frames.maker is Maker.CUBEMARS:  # it has no request to clear
            steps = [Special.LEAVE, Special.ENTER, Special.LEAVE]
        hardware.fault = 0
        with suppress(DeadlineExceeded):  # the fault remains
            for one in steps:
                hardware.tell(one)
            hardware.ask(steps[-1], lambda: self._fault() is None, "the end of the fault")
        self._check_fault()

    def _home(self, method: int | None) -> None:
        require_here(self.name, method)
        self._disable()
        self.hardware.set_zero()
        self._enable()

    # --- helpers -----------------------------------------------------------------------------

    def _planned(self, motion: Motion) -> tuple[Plan, float]:
        """Return the commands of a motion, and its duration [s]."""
        sign, options = self._units, self.hardware.options
        kp, kd, inertia = options.kp_n_m_rad, options.kd_n_m_s_rad, options.inertia_kg_m2
        friction = options.friction_n_m
        if motion.variable is ControlVariable.POSITION:
            if motion.trajectory is None:
                motion = replace(motion, trajectory=TrapezoidalTrajectory(motion.distance))
            demand = demand_of(motion)
            begin = demand.initial_argument

            def position(at_s: float) -> Command:
                at = begin + at_s
                p, v, a = demand.value(at), demand.first(at), demand.second(at)
                rubs = copysign(friction, v) if v else 0.0
                return Command(sign * p, sign * v, kp, kd, sign * (inertia * a + rubs))

            return position, demand.final_argument - begin
        present, answer = self.hardware.present(), self.hardware.answer
        assert answer is not None  # connected
        if motion.variable is ControlVariable.VELOCITY:
            before = present.v if present.kd and not present.kp else answer.v
            ramps = Ramps(sign * before, motion.target, motion.acceleration, motion.deceleration)

            def velocity(at_s: float) -> Command:
                v = sign * _at(ramps, motion, at_s)
                return Command(0.0, v, 0.0, kd, copysign(friction, v) if v else 0.0)

            return velocity, ramps.duration_s
        ramps = Ramps(sign * present.t, motion.target, motion.slope, motion.slope)
        return lambda at_s: Command(t=sign * _at(ramps, motion, at_s)), ramps.duration_s

    def _fault(self) -> Fault | None:
        hardware, code = self.hardware, self.hardware.fault
        faults = {FOLLOWING_ERROR: "following error", **hardware.frames.maker.faults}
        texts = [faults[code]] if code in faults else [t for c, t in faults.items() if code & c]
        return Fault(code, ", ".join(texts) or "unknown", hardware.fault_ns) if code else None


def _at(ramps: Ramps, motion: Motion, at_s: float) -> float:
    on_ramp = ramps.at(at_s)
    return motion.target if on_ramp is None else on_ramp[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassicalOptions(MitOptions):
    """The options of a hardware object of a mini cheetah, CubeMars or Damiao drive."""

    master_id: int = whole(0, 0, 0x7FF, "", "Identifier of answers.")
    drive: str = word("ak80_6_v2", MODELS, "model", "Its model, which determines the ranges.")

    def frames(self, node_id: int) -> Frames:
        """Return the frames of the drive with this number."""
        maker, ranges = MODELS[self.drive]
        return Frames(node_id, self.master_id, maker, self.ranges(ranges))


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MitTable(ClassicalOptions):
    """A motor behind a drive with MIT frames."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Identifier of requests.", example="1")
    drive: str = word(REQUIRED, MODELS, "model", "Its model, which determines the ranges.")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class ClassicalHwMotor(MitHwMotor):
    """One mini cheetah, CubeMars or Damiao drive; see `MitHwMotor`."""

    OPTIONS: type[MitOptions] = ClassicalOptions


build: Final = adaptation(api=1)(CanBuilder(MitTable, ClassicalHwMotor, MitMotor))
