"""Logical motors with central servo: amplifier and encoder, servo on the host.

The servo runs on the host, as on JPL's FIDO: trajectories are sampled and PID is computed once a
cycle. The hardware is a plain torque amplifier and an encoder counter on a CANopen I/O node::

    hw = AmplifierHwMotor(bus, node_id=3, channel=1, current_per_volt_a_v=0.8)
    gains = PidGains.tuned(60.0, current_per_acceleration=0.038)
    motor = SoftwareMotor(hw, MotorModel.load("wheel.toml"), gains)

| command                      | behaviour of the servo                                          |
| ---------------------------- | --------------------------------------------------------------- |
| set-point, position          | step of the demand to the target; no profile                    |
| set-point, velocity          | step of the demand, or ramp at the acceleration limit, if given |
| set-point, torque or current | step of the current, or ramp at the slope limit, if given       |
| trajectory, any variable     | sampled every cycle; position and velocity with feed-forward    |
| homing (35, 37)              | the present position becomes 0                                  |

The response to a position step is limited to the model's maximum velocity and current. Limits of
its derivatives cannot be guaranteed without a profile, so they are refused. Motors of one bus begin
with the same SYNC.
"""

from collections.abc import Callable, Mapping
from dataclasses import fields
from functools import partial
from math import inf, isfinite
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.bus_load import FULL, SYNC, period_on_wire_s
from motorhil.motorapi.adaptations.host_servo.cycle import CycleReport
from motorhil.motorapi.adaptations.host_servo.demand import Scales, course_of
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.host_servo.servo import ServoLimits
from motorhil.motorapi.adaptations.host_servo.settings import HostServoTable, IoOptions, PidGains
from motorhil.motorapi.api.bus_traffic import traffic_on
from motorhil.motorapi.api.registration import Shared, read_settings
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint, as_number
from motorhil.motorapi.errors import UnsupportedError, UsageError
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.planning.functions import from_here
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import Firing, SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime
    from motorhil.motorapi.trajectory import Trajectory

_HERE_IS_ZERO: Final = (None, 35, 37)
_VOLTS: Final = 10.0
# The time without approach to the target of a set-point, after which it fails. It includes the time
# to rest from the full speed, with a load that leaves a thirtieth of the planned deceleration.
_STALL_S: Final = 1.0
_STALL_STOPS: Final = 30.0
# Standstill beside the target: frames of commands were lost, or a load holds the motor there.
_SHORT_S: Final = 2.0
_LIMITED: Final = "torque, current and velocity set-points with a limit of their first derivative"


@final
@frozen(kw_only=True)
class ServoParameters:
    """The tunable parameters of a servo besides its gains; U is rad, or m of a linear motor.

    Attributes:
        position_window: the distance within which a target counts as reached [U]; None: ten
            increments.
        settle_s: the time for which it must be within that window, and a motor at rest stand still
            [s].
        following_error_window: the largest following error of a motion without a fault [U]; inf: no
            limit. None: ten times the model's start tolerance.
        following_error_s: the time for which it must be exceeded [s]. A set-point of position
            fails instead after a time without approach to its target.
        quick_stop_deceleration: [U/s²]; None: the model's deceleration.

    Raises:
        UsageError: one is not a number > 0.
    """

    position_window: float | None = None
    settle_s: float = 0.02
    following_error_window: float | None = None
    following_error_s: float = 0.01
    quick_stop_deceleration: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None and not field.name.endswith("_s"):
                continue
            check_positive(field.name, value, may_be_inf=field.name == "following_error_window")


def check_positive(name: str, value: object, *, may_be_inf: bool = False) -> None:
    """Raise UsageError if `value` is not a number > 0."""
    number = as_number(value)
    if not number > 0.0 or not (isfinite(number) or (may_be_inf and number == inf)):
        raise UsageError(f"{name} = {value!r}: must be a number > 0")


@final
class SoftwareMotor(Motor):
    """A logical motor whose servo runs here; any number of them may share one hardware object.

    Args:
        hardware: the amplifier and the encoder.
        model: the constants of the motor; must define `increments_per_unit`.
        gains: the gains of the servo.
        parameters: its other parameters. Gains and parameters belong to this logical motor, and
            take effect at its next start().
        torque_constant: the torque at the output per current [N·m/A, of a linear motor N/A]; None:
            not known, and torque cannot be commanded.
        name: the name in messages and records. None: the model's name and the place.
        on_close: called once, when the motor is closed. The maker of the hardware object closes it.

    Raises:
        UsageError: the model does not define `increments_per_unit`.
    """

    def __init__(
        self,
        hardware: AmplifierHwMotor,
        model: "MotorModel",
        gains: PidGains,
        *,
        parameters: ServoParameters | None = None,
        torque_constant: float | None = None,
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
        if model.increments_per_unit is None:
            raise UsageError(
                f"{self.name}: the model does not define increments_per_{model.unit}, and a "
                "counter cannot"
            )
        self._hardware = hardware
        if torque_constant is not None:
            check_positive("torque_constant", torque_constant)
        self._torque_constant = torque_constant
        self._scale = model.increments_per_unit
        self._scales = Scales(model.increments_per_unit, torque_constant)
        self.gains = gains
        self.parameters = ServoParameters() if parameters is None else parameters
        self._held: tuple[float, float] = (0.0, 0.0)  # demand [inc], and the commanded value [U]

    @property
    def hardware(self) -> AmplifierHwMotor:
        """The hardware object: amplifier, encoder and servo."""
        return self._hardware

    @property
    def gains(self) -> PidGains:
        """The gains of this logical motor; they take effect at its next start()."""
        return self._gains

    @gains.setter
    def gains(self, gains: PidGains) -> None:
        if not isinstance(gains, PidGains):
            raise UsageError(f"gains = {gains!r}: give PidGains(kp=..., ki=..., kd=...)")
        self._gains = gains

    @property
    def parameters(self) -> ServoParameters:
        """The parameters of this logical motor; they take effect at its next start()."""
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: ServoParameters) -> None:
        if not isinstance(parameters, ServoParameters):
            raise UsageError(f"parameters = {parameters!r}: give ServoParameters(...)")
        self._parameters = parameters

    @property
    def cycles(self) -> CycleReport:
        """The timing statistics of the servo."""
        return self._hardware.report()

    # --- capabilities ----------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable is not ControlVariable.TORQUE or self._torque_constant is not None

    def _check_command(self, variable: ControlVariable, command: "Setpoint | Trajectory") -> None:
        if not isinstance(command, Setpoint):
            return
        limits = command.limits
        if limits is None or variable is not ControlVariable.POSITION:
            return
        if limits.first is not None or limits.second is not None or limits.third is not None:
            raise UnsupportedError(
                motor=self.name,
                feature="limits on the derivatives of a position set-point, which has no profile",
                supported=f"{_LIMITED}, and trajectories",
            )

    def _limits_jerk(self, variable: ControlVariable) -> bool:
        return True

    def _sync_offer(self) -> SyncOffer:
        period_s = self._hardware.io.cycle.period_s
        reason = f"one SYNC every {period_s * 1e3:g} ms: counts of it, outputs latched by the next"
        link, tick_ms = self._hardware.link, self._hardware.options.amplifier_tick_ms
        traffic, unbounded = traffic_on(link, period_s)
        firing, signal_s = None, None
        if traffic is not None:
            firing = Firing(link.name, traffic, (SYNC, SYNC), 2.0 * period_s, 1)
            signal_s = period_on_wire_s(link, traffic, period_s)
            unbounded = FULL if signal_s is None else ""
        return SyncOffer(
            level=SyncLevel.CYCLIC,
            group=("servo cycle", link.name, period_s),
            latency_s=None if tick_ms is None else (0.0, tick_ms / 1e3),
            reason=reason,
            firing=firing,
            signals=1,
            signal_s=signal_s,
            no_firing_bound=unbounded,
            no_start_bound="its amplifier's sampling period is not known (amplifier_tick_ms)",
            no_end_bound="the end depends on the servo, and is not predicted",
        )

    # --- connecting, state and measurements ------------------------------------------------

    def _connect(self) -> None:
        self._hardware.node.link.status.check()
        self._hardware.connect()

    def _read_state(self) -> MotorState:
        return self._hardware.state()

    def _read_fault(self) -> Fault | None:
        return self._hardware.axis.current_fault()

    def _read_referenced(self) -> bool:
        return self._hardware.is_homed

    def _read_position(self) -> float:
        self._hardware.node.check_heard()
        self._hardware.refresh()
        return self._hardware.servo.position / self._scale

    def _read_velocity(self) -> float:
        hardware = self._hardware
        hardware.node.check_heard()
        if hardware.servo.course is not None and hardware.is_regular:
            return hardware.servo.velocity / self._scale
        return hardware.measure_velocity() / self._scale

    def _read_reference(self) -> float:
        hardware = self._hardware
        hardware.node.check_link()
        course = hardware.servo.course
        if course is None:
            return self._read_position()
        if course.is_step and not hardware.axis.is_over:
            return self._read_position()  # a step has no profile: its demand is the target at once
        is_held = course.is_over and not course.final_velocity
        demand = course.target if is_held else hardware.servo.demand
        # Return the target as commanded while the servo holds it: rounding must not accumulate.
        return self._held[1] if demand == self._held[0] else demand / self._scale

    def _read_following_error(self) -> float:
        servo = self._hardware.servo
        return 0.0 if servo.course is None else (servo.demand - servo.position) / self._scale

    def _latest(self) -> Measurement | None:
        hardware = self._hardware
        counted_ns = hardware.axis.counted_ns
        if counted_ns < 0:
            return None
        servo, scale = hardware.servo, self._scale
        return Measurement(
            counted_ns,
            hardware.state(),
            servo.position / scale,
            servo.velocity / scale if servo.course is not None and hardware.is_regular else None,
            None,
            (servo.demand - servo.position) / scale,
        )

    def _position_source(self) -> str:
        return "counts that came with SYNC"

    # --- power, fault, reference -----------------------------------------------------------

    def _enable(self) -> None:
        self._hardware.enable(self._gains.per_increment(self._scale), self._limits(None))

    def _disable(self) -> None:
        self._hardware.disable()

    def _reset_fault(self) -> None:
        self._hardware.reset_fault()

    def _home(self, method: int | None) -> None:
        if method not in _HERE_IS_ZERO:
            raise UnsupportedError(
                motor=self.name, feature=f"homing by method {method}", supported="35 and 37"
            )
        self._hardware.call_here(0)

    # --- motion ----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        servo = self._hardware.servo
        planned = partial(from_here, self.name, self.model, motion)
        course = course_of(motion, self._scales, servo.demand_velocity, servo.current_a, planned)
        if motion.variable is ControlVariable.POSITION and motion.argument is None:
            self._held = (course.target, motion.target)
        gains = self._gains.per_increment(self._scale)
        return self._hardware.arm(course, gains, self._limits(motion), together=together)

    def _limits(self, motion: Motion | None) -> ServoLimits:
        """Return the limits of the servo, in increments."""
        own, model, size = self._parameters, self.model, abs(self._scale)
        current_a = _VOLTS * abs(self._hardware.current_per_volt_a_v)
        if model.current_max is not None:
            current_a = min(current_a, model.current_max)
        if model.torque_max is not None and self._torque_constant is not None:
            current_a = min(current_a, model.torque_max / self._torque_constant)
        behind = own.following_error_window
        if behind is None:
            behind = 10.0 * model.start_tolerance
        deceleration = model.deceleration
        if motion is not None:
            deceleration = motion.stop_deceleration or motion.deceleration
        period_s = self._hardware.io.cycle.period_s
        return ServoLimits(
            current_max_a=current_a,
            velocity_max=model.velocity_max * size,
            following_error=behind * size,
            following_s=own.following_error_s,
            stall_s=_STALL_S + _STALL_STOPS * model.velocity_max / model.deceleration,
            short_s=_SHORT_S,
            window=10.0 if own.position_window is None else own.position_window * size,
            velocity_window=0.02 * model.velocity_max * size + 0.5 / period_s,
            settle_s=own.settle_s,
            deceleration=deceleration * size,
        )

    def _disarm(self) -> None:
        self._hardware.axis.disarm()

    def _is_done(self) -> bool:
        axis = self._hardware.axis
        self._hardware.node.check_link()
        if axis.failure is not None:
            raise axis.failure
        fault = axis.current_fault()
        if fault is not None:
            raise fault.as_error(self.name)
        return axis.is_over

    def _stop(self) -> None:
        self._slow_down(self._hardware.servo.deceleration)

    def _slow_down(self, deceleration_inc_s2: float, *, quickly: bool = False) -> None:
        axis = self._hardware.axis
        axis.failure = None  # of the previous motion; this one can succeed
        axis.slow_down(deceleration_inc_s2, quickly=quickly)

    def _quick_stop(self) -> None:
        deceleration = self._parameters.quick_stop_deceleration
        if deceleration is None:
            deceleration = self.model.deceleration
        self._slow_down(deceleration * abs(self._scale), quickly=True)

    def _motion_times(self) -> MotionTimes | None:
        axis = self._hardware.axis
        if axis.started_ns is None:
            return None
        source = "SYNC on the wire; the count with which it had settled"
        return MotionTimes(axis.started_ns, axis.ended_ns, source)

    def _open_low_level(self) -> AmplifierHwMotor:
        self._hardware.fall_silent()
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.let_in()


_SHARED: Final[Shared[AmplifierHwMotor]] = Shared("amplifier")


def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> SoftwareMotor:
    """Return the motor described by a settings table (`motorhil.adaptations`, software).

    Motors that name the same channel of a node share one hardware object.

    Args:
        bus: the bus of the node.
        settings: `node_id`, `channel` (1), `current_per_volt_a_v`, `gains` (a table); `name`; any
            field of IoOptions; any of ServoParameters, with its unit in the key.
        model: the motor model.
        runtime: the runtime to wait with.

    Raises:
        UsageError: a setting is unknown, missing or invalid.
    """
    own = read_settings(HostServoTable, settings, model.unit)
    options = own.part(IoOptions)
    parameters = ServoParameters(
        **{one.name: getattr(own, one.name) for one in fields(ServoParameters)}
    )
    hardware = _SHARED.get(
        bus,
        (own.node_id, own.channel),
        lambda: AmplifierHwMotor(
            *(bus, own.node_id, own.channel),
            current_per_volt_a_v=own.current_per_volt_a_v,
            runtime=runtime,
            options=options,
        ),
        lambda built: (
            (built.options, built.current_per_volt_a_v) == (options, own.current_per_volt_a_v)
        ),
    )
    return SoftwareMotor(
        hardware,
        model,
        own.gains.gains(model.unit),
        parameters=parameters,
        torque_constant=own.torque_constant,
        name=own.name,
        on_close=lambda: _SHARED.give_back(hardware),
    )
