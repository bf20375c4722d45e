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
from dataclasses import dataclass
from typing import Final, final

from motorhil.motorapi.adaptations.mit.frames import (
    MODELS,
    Frames,
    Maker,
    Special,
)
from motorhil.motorapi.adaptations.mit.hardware import (
    MitHwMotor,
    MitOptions,
)
from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    Measurement,
    Motion,
    MotorModel,
    MotorState,
    PeerError,
    StreamedMotor,
    adaptation,
    output_sign,
    require_here,
    require_within,
    text,
    whole,
    word,
)


@final
class MitMotor(StreamedMotor[MitHwMotor]):
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
        if hardware.motions.variable is not None and hardware.is_on:
            return  # after a quick stop
        hardware.hold()
        hardware.ask(
            Special.ENTER, lambda: hardware.is_on or hardware.fault is not None, "motor mode"
        )
        self._check_fault()

    def _disable(self) -> None:
        hardware = self.hardware
        hardware.release()
        hardware.ask(Special.LEAVE, lambda: not hardware.is_on, "the end of motor mode")

    def _command(self, motion: Motion) -> None:
        ranges, furthest = self.hardware.frames.ranges, motion.target
        limit, unit = {
            ControlVariable.POSITION: (ranges.p, "rad"),
            ControlVariable.VELOCITY: (ranges.v, "rad/s"),
            ControlVariable.TORQUE: (ranges.t, "N·m"),
        }[motion.variable]
        if motion.function is not None:
            low, high = motion.function.bounds(*motion.interval)
            furthest = motion.offset + max(low, high, key=lambda end: abs(motion.offset + end))
        reason = "the range of the drive's frames"
        quantity = motion.variable.value
        require_within(self.name, quantity, furthest, (-limit, limit), unit, reason)
        self.hardware.trust_ranges()
        super()._command(motion)

    def _stop(self) -> None:
        hardware = self.hardware
        if hardware.is_on and hardware.answer is not None:
            slower = self._physical.stop_deceleration(self.model.deceleration)
            hardware.motions.slow_down(slower, hardware.measured())
            hardware.stop_anyway()

    # --- capabilities ------------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable is not ControlVariable.CURRENT

    def _read_referenced(self) -> bool:
        return self.hardware.is_zeroed

    def _is_done(self) -> bool:
        if self.hardware.mismatch:
            raise PeerError(self.hardware.mismatch)
        return super()._is_done()

    def _reset_fault(self) -> None:
        hardware = self.hardware
        hardware.release()
        steps = [Special.LEAVE, Special.CLEAR]
        if hardware.frames.maker is Maker.CUBEMARS:  # it has no request to clear
            steps = [Special.LEAVE, Special.ENTER, Special.LEAVE]
        hardware.fault = None
        with suppress(DeadlineExceeded):  # the fault remains
            for one in steps:
                hardware.tell(one)
            hardware.ask(steps[-1], lambda: hardware.fault is None, "the end of the fault")
        self._check_fault()

    def _home(self, method: int | None) -> None:
        require_here(self.name, method)
        self._disable()
        self.hardware.set_zero()
        self._enable()


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
