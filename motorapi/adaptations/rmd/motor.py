"""The adaptation of the motor interface to a MyActuator RMD.

| command                                  | request to the drive                                |
| ---------------------------------------- | --------------------------------------------------- |
| set-point or simple trajectory, position | A4h, streamed along the trapezoid, acceleration 0   |
| set-point or ramp, velocity              | A2h, streamed along the ramp, acceleration 0        |
| set-point or ramp, current               | A1h, streamed along the ramp                        |
| enable; disable                          | A4h to the present angle, which is held; 80h        |
| stop, halt, quick stop                   | A4h along a braking ramp, then held                 |
| reset of a fault                         | none, or 76h, which restarts the drive              |
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import copysign, tau
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.rmd.hardware import (
    NODE_ID_MAX,
    UNTIL_RESTART,
    Command,
    RmdHwMotor,
    RmdOptions,
)
from motorhil.motorapi.api import (
    REQUIRED,
    Measurement,
    Motion,
    MotionKind,
    MotorModel,
    MotorState,
    Shared,
    StreamedMotor,
    UsageError,
    adaptation,
    read_settings,
    text,
    whole,
)

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.api import Runtime

_DEGREES: Final = 360.0 / tau
_DEGREES_MAX: Final = ((1 << 31) - 1) / 100.0
_CLEARED_S: Final = 2.0
_ASK_S: Final = 0.05


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RmdTable(RmdOptions):
    """A motor behind an RMD."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Its ID.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class RmdMotor(StreamedMotor[RmdHwMotor]):
    """A logical motor on an RMD; several of them may share one hardware object.

    The drive's angles are those of its output, behind its own gear; of the model's gear ratio only
    the sign counts, for the direction.

    Args:
        hardware: the drive.
        model: the motor's constants.
        name: its name in messages and records; None: the model's name and the drive's place.
        on_close: called once when the motor is closed. The hardware object belongs to its creator.

    Raises:
        UsageError: the model is that of a linear motor.
    """

    def __init__(
        self,
        hardware: RmdHwMotor,
        model: MotorModel,
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        if model.kind is not MotionKind.ROTARY:
            raise UsageError(f"motor model {model.name}: kind is linear; expected rotary")
        units = copysign(_DEGREES, model.gear_ratio or 1.0)
        super().__init__(hardware, model, units, name=name, on_close=on_close)

    def _latest(self) -> Measurement | None:
        hardware, last = self.hardware, self.hardware.estimate
        if last is None:
            return None
        state = MotorState.ENABLED if hardware.mode else MotorState.DISABLED
        if hardware.fault is not None:
            state = MotorState.FAULT
        return Measurement(last.time_ns, state, last.angle / self._units, last.speed / self._units)

    def _enable(self) -> None:
        hardware = self.hardware
        self._check_fault()
        if hardware.mode and hardware.motions.variable is not None:
            return  # it holds, after a quick stop
        hardware.track()
        self._hold()
        self._await_mode(True)
        self._check_fault()

    def _disable(self) -> None:
        self.hardware.motions.forget()
        self.hardware.obey(Command.SHUTDOWN)
        self._await_mode(False)

    def _await_mode(self, is_on: bool) -> None:
        hardware, left = self.hardware, 20
        while bool(hardware.mode) != is_on and hardware.fault is None and left:
            left -= 1
            self.runtime.wait_until(lambda: bool(hardware.mode) == is_on, _ASK_S)

    def _command(self, motion: Motion) -> None:
        if abs(motion.target * self._scale(motion.variable)) > _DEGREES_MAX:
            raise UsageError(
                f"{self.name}: {motion.target:g} does not fit 32 bits of 0.01 degrees; expected at"
                f" most {_DEGREES_MAX / _DEGREES:g}; move less far"
            )
        self.hardware.track()
        super()._command(motion)

    def _quantise(self, motion: Motion) -> Motion:
        return self._rounded(motion, 100.0 * self._scale(motion.variable))

    def _reset_fault(self) -> None:
        hardware = self.hardware
        if hardware.read_errors() & UNTIL_RESTART:
            hardware.restart()
            hardware.connect()
        end_ns = self.runtime.now_ns() + round(_CLEARED_S * 1e9)
        while hardware.read_errors() and self.runtime.now_ns() < end_ns:
            self.runtime.wait_until(lambda: False, _ASK_S)
        if not hardware.errors:
            hardware.fault = None
        self._check_fault()

    def _position_source(self) -> str:
        return "multi-turn angle, answer 92h"


_SHARED: Final[Shared[RmdHwMotor]] = Shared("RMD")


@adaptation(api=1)
def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: MotorModel, runtime: "Runtime"
) -> RmdMotor:
    """Build the motor that a table of settings describes; motors on one drive share it.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    own = read_settings(RmdTable, settings)
    hardware, give_back = _SHARED.on_can(
        RmdHwMotor, bus, own.node_id, runtime, own.part(RmdOptions)
    )
    return RmdMotor(hardware, model, name=own.name, on_close=give_back)
