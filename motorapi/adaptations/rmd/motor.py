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
from dataclasses import dataclass, replace
from functools import partial
from math import tau
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
    ControlMode,
    ControlVariable,
    DeviceFault,
    Fault,
    Measurement,
    Motion,
    MotionKind,
    Motor,
    MotorBusyError,
    MotorModel,
    MotorState,
    Shared,
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
_SUPPORTED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY, ControlVariable.CURRENT)
_CLEARED_S: Final = 2.0
_ASK_S: Final = 0.05


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RmdTable(RmdOptions):
    """A motor behind an RMD."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Its ID.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class RmdMotor(Motor):
    """A logical motor on an RMD; several of them may share one hardware object.

    The drive's angles are those of its output, behind its own gear.

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
        drive = hardware.drive
        super().__init__(
            name=name,
            model=model,
            runtime=drive.runtime,
            physical=drive.physical,
            on_close=on_close,
        )
        if model.kind is not MotionKind.ROTARY:
            raise UsageError(f"motor model {model.name}: kind is linear; expected rotary")
        self._hardware = hardware

    @property
    def hardware(self) -> RmdHwMotor:
        """The drive, with all its abilities."""
        return self._hardware

    # --- the six that make a motor

    def _connect(self) -> None:
        self._hardware.connect()

    def _latest(self) -> Measurement | None:
        hardware, last = self._hardware, self._hardware.estimate
        if last is None:
            return None
        state = MotorState.ENABLED if hardware.mode else MotorState.DISABLED
        if hardware.fault is not None:
            state = MotorState.FAULT
        return Measurement(last.time_ns, state, last.angle / _DEGREES, last.speed / _DEGREES)

    def _enable(self) -> None:
        hardware = self._hardware
        self._check_fault()
        if hardware.mode and hardware.motions.variable is not None:
            return  # it holds, after a quick stop
        hardware.track()
        sender = partial(hardware.send, ControlVariable.POSITION)
        hardware.drive.confirm(hardware.motions.hold(hardware.measured(), sender))
        self._await_mode(True)
        self._check_fault()

    def _disable(self) -> None:
        self._hardware.motions.forget()
        self._hardware.obey(Command.SHUTDOWN)
        self._await_mode(False)

    def _await_mode(self, is_on: bool) -> None:
        hardware, left = self._hardware, 20
        while bool(hardware.mode) != is_on and hardware.fault is None and left:
            left -= 1
            self.runtime.wait_until(lambda: bool(hardware.mode) == is_on, _ASK_S)

    def _command(self, motion: Motion) -> None:
        hardware = self._hardware
        if abs(motion.target * _scale(motion.variable)) > _DEGREES_MAX:
            raise UsageError(
                f"{self.name}: {motion.target:g} does not fit 32 bits of 0.01 degrees; expected at"
                f" most {_DEGREES_MAX / _DEGREES:g}; move less far"
            )
        hardware.track()
        sender = partial(hardware.send, motion.variable)
        scale = _scale(motion.variable)
        hardware.drive.confirm(hardware.motions.start(motion, scale, hardware.measured(), sender))

    def _stop(self) -> None:
        hardware = self._hardware
        if not hardware.mode or hardware.estimate is None:
            return
        slower = self._physical.stop_deceleration(self.model.deceleration) * _DEGREES
        sender = partial(hardware.send, ControlVariable.POSITION)
        try:
            hardware.motions.stop(slower, hardware.measured(), sender)
        except MotorBusyError:  # another program has the motor
            hardware.tell_anyway(Command.STOP)

    # --- capabilities

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable in _SUPPORTED

    def _quantise(self, motion: Motion) -> Motion:
        step = 100.0 * _scale(motion.variable)
        return replace(motion, target=round(motion.target * step) / step)

    def _read_fault(self) -> Fault | None:
        return self._hardware.fault

    def _reset_fault(self) -> None:
        hardware = self._hardware
        if hardware.read_errors() & UNTIL_RESTART:
            hardware.restart()
            hardware.connect()
        end_ns = self.runtime.now_ns() + round(_CLEARED_S * 1e9)
        while hardware.read_errors() and self.runtime.now_ns() < end_ns:
            self.runtime.wait_until(lambda: False, _ASK_S)
        if not hardware.errors:
            hardware.fault = None
        self._check_fault()

    def _check_fault(self) -> None:
        fault = self._hardware.fault
        if fault is not None:
            raise DeviceFault(
                motor=self.name, code=fault.code, text=fault.text, since_ns=fault.since_ns
            )

    def _is_done(self) -> bool:
        motions = self._hardware.motions
        is_over = super()._is_done()
        if motions.error is not None:
            raise motions.error
        return is_over and not motions.is_going

    def _read_reference(self) -> float:
        motions = self._hardware.motions
        if motions.variable is not ControlVariable.POSITION:
            return self._read_position()
        return motions.now(ControlVariable.POSITION, self._hardware.measured())[0] / _DEGREES

    def _position_source(self) -> str:
        return "multi-turn angle, answer 92h"

    # --- the hardware itself

    def _open_low_level(self) -> RmdHwMotor:
        self._hardware.motions.forget()
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.drive.doubt()


def _scale(variable: ControlVariable) -> float:
    """Return the unit of the drive [deg, deg/s, A] per unit of the motor interface."""
    return 1.0 if variable is ControlVariable.CURRENT else _DEGREES


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
    options = own.part(RmdOptions)
    hardware = _SHARED.get(
        bus,
        own.node_id,
        lambda: RmdHwMotor(bus, own.node_id, runtime=runtime, options=options),
        lambda built: built.options == options,
    )
    return RmdMotor(hardware, model, name=own.name, on_close=lambda: _SHARED.give_back(hardware))
