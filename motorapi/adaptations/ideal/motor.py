"""Ideal motors: logical motors that follow their commands exactly.

They are the reference for every other kind of motor, and the quickest way to try an application.
There is no bus, no drive and no plant: commands are executed exactly and at once. See
`IdealMotor`::

    hw = IdealHwMotor(runtime, "left wheel")
    motor = IdealMotor(hw, model=MotorModel.load("wheel.toml"))

| command                      | behaviour of the motor                                         |
| ---------------------------- | -------------------------------------------------------------- |
| set-point, position          | straight motion at the velocity limit, without ramps           |
| set-point, velocity          | ramp at the acceleration limit                                 |
| set-point, torque or current | step, or ramp at the given limit of the first derivative       |
| trajectory, any variable     | the demand of the trajectory, at every instant                 |
| homing (35, 37)              | the present position becomes 0, at once                        |

A set-point has no profile: its variable moves straight to the target at the limit of its first
derivative, from the command or else from the model. So velocity steps in a position set-point,
which no real motor can do. This distinguishes it from a trajectory. In torque and current control
the shaft is held: the motor exerts torque and stands still.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.api.registration import API_VERSION, Shared, adaptation, read_settings
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.errors import LinkError, UnsupportedError
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.planning.functions import from_here
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import Firing, SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel
from motorhil.settings import number, text

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime
    from motorhil.motorapi.trajectory import Trajectory

_HERE_IS_ZERO: Final = (None, 35, 37)


@final
class IdealMotor(Motor):
    """A logical motor on an ideal one; any number of them may share one hardware object.

    Args:
        hardware: the hardware object.
        model: the limits of the motor.
        name: the name in messages and records. None: the model's name and the hardware's label.
        on_close: called once, when the motor is closed. The maker of the hardware object closes it.

    Attributes:
        hardware: the hardware object; tests inject faults there.
    """

    def __init__(
        self,
        hardware: IdealHwMotor,
        model: "MotorModel",
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(
            name=name,
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
            on_close=on_close,
        )
        self.hardware: Final = hardware

    # --- capabilities ----------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return True

    def _check_command(self, variable: ControlVariable, command: "Setpoint | Trajectory") -> None:
        """Accept every command, as every plan can be executed."""

    def _limits_jerk(self, variable: ControlVariable) -> bool:
        return True

    def _sync_offer(self) -> SyncOffer:
        reason = "ideal motors of one runtime begin at the same nanosecond"
        trigger = self.hardware.shared_trigger
        return SyncOffer(
            *(SyncLevel.TRIGGERED, trigger, (0.0, 0.0), reason),
            firing=Firing(),
            oscillator_ppm=0.0,
            end_s=(0.0, 0.0),
        )

    # --- connecting, state and measurements ------------------------------------------------

    def _connect(self) -> None:
        if self.hardware.is_closed:
            label = self.hardware.label
            raise LinkError(link=label, reason="this hardware object is closed")

    def _read_state(self) -> MotorState:
        return self.hardware.state

    def _read_fault(self) -> Fault | None:
        return self.hardware.fault

    def _read_referenced(self) -> bool:
        return self.hardware.is_referenced

    def _read_position(self) -> float:
        return self.hardware.reading().position

    def _read_velocity(self) -> float:
        return self.hardware.reading().velocity

    def _read_reference(self) -> float:
        return self.hardware.reading().position

    def _read_torque(self) -> float:
        return self.hardware.reading().torque

    def _read_following_error(self) -> float:
        return 0.0

    def _latest(self) -> Measurement | None:
        hardware = self.hardware
        position, velocity, torque = hardware.reading()
        now_ns = self.runtime.now_ns()
        return Measurement(now_ns, hardware.state, position, velocity, torque, 0.0)

    def _position_source(self) -> str:
        return "the law of its motion"

    def _refresh(self) -> float | None:
        return self.hardware.look_again_s()

    # --- power, fault, reference -----------------------------------------------------------

    def _enable(self) -> None:
        self.hardware.enable()

    def _disable(self) -> None:
        self.hardware.disable()

    def _reset_fault(self) -> None:
        self.hardware.reset_fault()

    def _home(self, method: int | None) -> None:
        if method not in _HERE_IS_ZERO:
            raise UnsupportedError(
                motor=self.name, feature=f"homing by method {method}", supported="35 and 37"
            )
        self.hardware.call_here(0.0)

    # --- motion ----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        def planned(position: float) -> Motion:
            return from_here(self.name, self.model, motion, position)

        return self.hardware.arm(planned, together=together)

    def _disarm(self) -> None:
        self.hardware.disarm()

    def _is_done(self) -> bool:
        hardware = self.hardware
        fault = hardware.fault
        if fault is not None:
            raise fault.as_error(self.name)
        self._connect()
        if hardware.failure is not None:
            raise hardware.failure
        return hardware.is_over

    def _stop(self) -> None:
        self.hardware.slow_down(self.model.deceleration)

    def _quick_stop(self) -> None:
        self.hardware.slow_down(self.model.deceleration, quickly=True)

    def _open_low_level(self) -> IdealHwMotor:
        return self.hardware

    def _motion_times(self) -> MotionTimes | None:
        begun_ns, over_ns = self.hardware.motion_times_ns()
        if begun_ns is None:
            return None
        return MotionTimes(begun_ns, over_ns, "the law of its motion")


_SHARED: Final[Shared[IdealHwMotor]] = Shared("axis")


@final
@frozen(kw_only=True, slots=False)
class IdealTable:
    """An ideal motor, not on any bus: it executes every command exactly and at once."""

    name: str | None = text(None, "Name of the motor; absent: the model's.")
    axis: str | None = text(
        None, "Motors of one axis are one physical motor; absent: the motor's name."
    )
    position: float | None = number(
        None,
        unit="{u}",
        doc="Initial position; absent: 0.",
        name="position_{u}",
        plausible=(1e-7, 1e6),
        plausible_m=(1e-9, 1e4),
    )
    torque_constant: float | None = number(
        None,
        0,
        doc="Torque [N·m], or force [N], per current [A]; absent: 1.",
        name="torque_constant_n_m_a",
        of_linear="torque_constant_n_a",
        above=True,
    )

    SCHEMA: ClassVar[Mapping[str, object]] = {
        "not": {
            "anyOf": [
                {"required": ["position_rad", "position_m"]},
                {"required": ["torque_constant_n_m_a", "torque_constant_n_a"]},
            ]
        }
    }


@adaptation(api=API_VERSION, needs_bus=False)
def build(
    bus: None, settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> IdealMotor:
    """Return the motor described by a settings table (entry point `motorhil.adaptations`, ideal).

    Motors that name the same axis share one hardware object, made by the first of them.

    Args:
        bus: None.
        settings: `name`; `axis` (default: the name); the initial position and the torque constant,
            both with their units: `position_rad`, `torque_constant_n_m_a`, of a linear motor
            `position_m`, `torque_constant_n_a`.
        model: the motor model.
        runtime: the runtime of the motor.

    Raises:
        UsageError: a setting is unknown or invalid.
    """
    own = read_settings(IdealTable, settings, model.unit)
    name = own.name or model.name
    axis = own.axis or name
    position, constant = own.position, own.torque_constant
    hardware = _SHARED.get(
        runtime,
        axis,
        lambda: IdealHwMotor(
            runtime,
            axis,
            position=0.0 if position is None else position,
            torque_constant=1.0 if constant is None else constant,
        ),
        lambda built: (
            position in (None, built.initial_position) and constant in (None, built.torque_constant)
        ),
    )
    return IdealMotor(hardware, model, name=name, on_close=lambda: _SHARED.give_back(hardware))
