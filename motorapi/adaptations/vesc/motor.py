"""The adaptation of the motor interface to a VESC.

| command                                  | frames to the controller                             |
| ---------------------------------------- | ---------------------------------------------------- |
| set-point or simple trajectory, position | SET_POS, streamed along the trapezoid                |
| set-point or ramp, velocity              | SET_RPM, streamed along the ramp                     |
| set-point or ramp, current               | SET_CURRENT, streamed along the ramp                 |
| stop, halt, quick stop                   | SET_POS, streamed along a braking ramp, then held    |
| enable; disable                          | SET_POS to the present angle; SET_CURRENT 0          |

The motor interface's states are those of this program: a VESC reports none of its own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import tau
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.vesc.hardware import (
    MODES,
    NODE_ID_MAX,
    Mode,
    VescHwMotor,
    VescOptions,
)
from motorhil.motorapi.api import (
    REQUIRED,
    ControlVariable,
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

_SPAN_MAX: Final = 0.4  # of a turn of positions, within the lead and period of a stream
_FAULT_STOP_S: Final = 2.0  # a fault clears itself after 0.5 s, unless its cause lasts
_ASK_S: Final = 0.05
_ARRIVAL_S: Final = 2.0  # after the last set-point


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class VescTable(VescOptions):
    """A motor behind a VESC."""

    node_id: int = whole(REQUIRED, 0, NODE_ID_MAX, "", "Controller id.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class VescMotor(StreamedMotor[VescHwMotor]):
    """A logical motor on a VESC; several of them may share one hardware object.

    Args:
        hardware: the controller.
        model: the motor's constants; its gear ratio is required.
        name: its name in messages and records; None: the model's name and the drive's place.
        on_close: called once when the motor is closed. The hardware object belongs to its creator.

    Raises:
        UsageError: the model has no gear ratio.
    """

    def __init__(
        self,
        hardware: VescHwMotor,
        model: MotorModel,
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        is_rotary = model.kind is MotionKind.ROTARY
        if model.gear_ratio is None:
            key = "gear_ratio" if is_rotary else "motor_turns_per_m"
            raise UsageError(
                f"motor model {model.name}: {key} is missing, and a VESC counts turns of the"
                f" motor; expected {key} = 1.0 if there is no gear; add it"
            )
        turns = model.gear_ratio / (tau if is_rotary else 1.0)
        super().__init__(hardware, model, turns, name=name, on_close=on_close)

    def _latest(self) -> Measurement | None:
        hardware, last = self.hardware, self.hardware.estimate
        if last is None:
            return None
        is_off = hardware.motions.variable is None
        state = MotorState.DISABLED if is_off else MotorState.ENABLED
        if hardware.fault is not None:
            state = MotorState.FAULT
        position, velocity = last.position / self._units, last.velocity / self._units
        return Measurement(last.time_ns, state, position, velocity)

    def _enable(self) -> None:
        hardware = self.hardware
        self._check_fault()
        if hardware.motions.variable is not None:
            return  # it holds, after a quick stop
        self._hold()
        hardware.read_fault()
        self._check_fault()

    def _disable(self) -> None:
        self.hardware.drive.confirm(self.hardware.release())

    def _command(self, motion: Motion) -> None:
        self._check_speed(motion)
        super()._command(motion)

    def _check_speed(self, motion: Motion) -> None:
        """Refuse speeds that the controller cannot follow.

        Raises:
            UsageError: too fast for streamed positions, or too slow for speed control.
        """
        own = self.hardware.options
        if motion.variable is ControlVariable.POSITION:
            ahead_s = (own.lead_ms + own.stream_period_ms) / 1e3
            most = _SPAN_MAX * own.position_turns / (ahead_s * abs(self._units))
            if motion.velocity > most:
                raise UsageError(
                    f"{self.name}: a velocity of {motion.velocity:.4g} per s is too high for"
                    f" positions; expected at most {most:.4g} with position_turns ="
                    f" {own.position_turns:g}, as the controller takes the shorter way;"
                    " move slower, or configure a larger span"
                )
        elif motion.variable is ControlVariable.VELOCITY:
            erpm = round(abs(motion.target * self._units) * self.hardware.scale(Mode.SPEED))
            if 0 < erpm < own.erpm_min:
                raise UsageError(
                    f"{self.name}: a velocity of {motion.target:.4g} per s is {erpm} ERPM;"
                    f" expected 0, or at least {own.erpm_min:g} ERPM; configure s_pid_min_erpm, and"
                    " set erpm_min"
                )

    # --- capabilities

    def _quantise(self, motion: Motion) -> Motion:
        step = self._scale(motion.variable) * self.hardware.scale(MODES[motion.variable])
        return self._rounded(motion, step)

    def _reset_fault(self) -> None:
        hardware = self.hardware
        end_ns = self.runtime.now_ns() + round(_FAULT_STOP_S * 1e9)
        while hardware.read_fault() and self.runtime.now_ns() < end_ns:
            self.runtime.wait_until(lambda: False, _ASK_S)
        if not hardware.read_fault():
            hardware.fault = None
        self._check_fault()

    def _is_done(self) -> bool:
        hardware, is_over = self.hardware, super()._is_done()
        is_late = not hardware.motions.is_going and hardware.motions.since_end_s > _ARRIVAL_S
        if not is_over and hardware.held is not None and is_late:
            window = f"{self.model.start_tolerance:.3g} {self.model.unit}"
            hardware.fail(f"the motor did not reach its target within {window}")
            self._check_fault()
        return is_over

    def _position_source(self) -> str:
        return "angle of STATUS_4 (10h) with the turns of STATUS_5 (1Bh)"


_SHARED: Final[Shared[VescHwMotor]] = Shared("VESC")


@adaptation(api=1)
def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: MotorModel, runtime: "Runtime"
) -> VescMotor:
    """Build the motor that a table of settings describes; motors on one controller share it.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    own = read_settings(VescTable, settings)
    hardware, give_back = _SHARED.on_can(
        VescHwMotor, bus, own.node_id, runtime, own.part(VescOptions)
    )
    return VescMotor(hardware, model, name=own.name, on_close=give_back)
