"""The motor: the public interface for applications.

Algorithm 1 of the paper runs nearly word for word::

    hw = Cia402HwMotor(bus, node_id=3)
    motor = Cia402Motor(hw, model=MotorModel.load("wheel.toml"))
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(1.0)
    motor.start()
    motor.wait_until_done(timeout_s=5)
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(1.0))
    motor.start()

Settings are local: nothing is sent, and other logical motors of the same physical motor are not
affected. `start` acquires the motor, transmits changed settings, and starts; or it raises and
nothing has moved.

Public methods are final: they validate, acquire the motor, convert errors, and report. The vendor
implements the hooks of `motorhil.motorapi.hooks`. The state behind the methods is in
`motorhil.motorapi.logical_motor`. U is the unit of position of the motor: rad, or m if linear.

Read access needs no ownership and never disturbs the owner of the motor. During low-level access
nothing is requested from the drive: readings return the last value received, or raise an error that
names the holder.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING, Final, Protocol, TypeVar, cast, final

from motorhil.motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Setpoint,
)
from motorhil.motorapi.errors import (
    MotorError,
    PluginError,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.execution import start_together, wait_for_all
from motorhil.motorapi.hooks import Hooks, MotorHooks
from motorhil.motorapi.logical_motor import LogicalMotor, check_timeout
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.outcome import DoneNotice, Outcome, Progress
from motorhil.motorapi.ownership.ownership import Ownership
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor, RunStatus
from motorhil.motorapi.ownership.reservation import Reservation, check_lease, check_take_over
from motorhil.motorapi.planning import single_axis as planning
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.trajectory import Trajectory, require_argument

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.api import Registration
    from motorhil.motorapi.trajectory import Argument

_HOMING_TIMEOUT_S: Final = 60.0

_HardwareT_co = TypeVar("_HardwareT_co", covariant=True)


class _WithHardware(Protocol[_HardwareT_co]):
    """A motor with the class of its hardware object: what its `_open_low_level` returns."""

    def _open_low_level(self) -> _HardwareT_co: ...


class Motor(MotorHooks):
    """A logical motor: the user's view of one physical motor. Settings stay here until start().

    An adaptation derives from it and implements the hooks; it cannot override public methods. The
    arguments are those of `MotorHooks`.
    """

    def __init__(
        self,
        *,
        name: str | None,
        model: MotorModel,
        runtime: Runtime,
        physical: PhysicalMotor,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        super().__init__(
            name=name, model=model, runtime=runtime, physical=physical, on_close=on_close
        )
        self.__logical = LogicalMotor(self.name, model, runtime, physical, Hooks.of(self))
        self.__hooks = self.__logical.hooks

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in cls.__dict__:
            if not name.startswith("_") and name != "close" and hasattr(Motor, name):
                raise PluginError(
                    plugin=cls.__qualname__,
                    where=name,
                    problem="public methods of Motor are final; implement a hook instead",
                )

    def __repr__(self) -> str:
        logical = self.__logical
        physical = logical.physical
        text = f"<{type(self).__name__} {self.name!r} on {physical.label}"
        try:
            latest = self._latest()
            if latest is not None:
                text += f": {latest.state.value}"
                text += (
                    "" if latest.position is None else f", {latest.position:g} {self.model.unit}"
                )
        except Exception as error:  # at a prompt, a repr that raises hides the problem
            text += f": {error!r}"
        if physical.access is not None:
            text += f"; held by {physical.access.who}"
        elif physical.run is not None and logical.goes_on(physical.run):
            text += f"; {physical.run.name} is active"
        return f"{text}>"

    @property
    @final
    def logical(self) -> LogicalMotor:
        """The state behind these methods, for groups and tools."""
        return self.__logical

    def close(self) -> None:
        """Release the motor: commands and measurements are refused. Closing again does nothing.

        Other logical motors of the same hardware object stay open.
        """
        self.__logical.close()
        super().close()

    # ---- settings, kept here until start() ----

    @property
    @final
    def control_mode(self) -> ControlMode | None:
        """The form of commands; None until `set_control_mode`."""
        return self.__logical.mode

    @property
    @final
    def control_variable(self) -> ControlVariable:
        """The commanded quantity."""
        return self.__logical.variable

    @final
    def set_control_mode(
        self, mode: ControlMode, variable: ControlVariable = ControlVariable.POSITION
    ) -> None:
        """Set the form of commands and the commanded quantity. Nothing is sent.

        A command for another mode or variable is discarded. So is any command if the mode is
        refused; the present mode is then kept.

        Raises:
            UnsupportedError: this motor does not support them.
        """
        before, self.__logical.command = self.__logical.command, None
        if not isinstance(mode, ControlMode) or not isinstance(variable, ControlVariable):
            raise UsageError(
                f"{self.name}: control mode {mode!r}, {variable!r}: give a ControlMode and a"
                " ControlVariable, as ControlMode.SETPOINT, ControlVariable.VELOCITY"
            )
        if not self.__hooks.supports(mode, variable):
            able = ", ".join(
                f"{m.value} of {v.value}"
                for m in ControlMode
                for v in ControlVariable
                if self.__hooks.supports(m, v)
            )
            asked = f"{mode.value} of {variable.value}"
            raise UnsupportedError(motor=self.name, feature=asked, supported=able)
        if (mode, variable) == (self.__logical.mode, self.__logical.variable):
            self.__logical.command = before
        self.__logical.mode = mode
        self.__logical.variable = variable

    @final
    def set_setpoint(
        self, value: float, relative: bool = False, limits: DerivativeLimits | None = None
    ) -> None:
        """Set the target of start(). Nothing is sent.

        A refused target discards the former command: start() then refuses, too.

        Args:
            value: the target, in the unit of the control variable (position: U).
            relative: `value` is a distance from the position at the start.
            limits: of the derivatives, if tighter than those of the model.

        Raises:
            StateError: the control mode is not SETPOINT.
            LimitError: the target or a limit exceeds that of the model.
        """
        self.__logical.command = None  # start() executes only what was accepted last
        self.__require_mode(ControlMode.SETPOINT, "set_setpoint")
        setpoint = Setpoint(value, relative, limits)
        planning.check_setpoint(self.name, self.model, self.__logical.variable, setpoint)
        self.__hooks.check_command(self.__logical.variable, setpoint)
        self.__logical.command = replace(setpoint, value=float(value))

    @final
    def set_trajectory(self, trajectory: Trajectory, argument: "Argument | None" = None) -> None:
        """Set the trajectory of start(). Nothing is sent.

        A refused trajectory discards the former command: start() then refuses, too.

        Args:
            trajectory: simple (TrapezoidalTrajectory) or complex (ComplexTrajectory).
            argument: the argument of a complex one; None: time since the start [s].

        Raises:
            StateError: the control mode is not TRAJECTORY.
            LimitError: a boundary value, a limit or the duration exceeds the ability of the motor.
            UnsupportedError: the motor cannot follow a trajectory of that kind.
        """
        self.__logical.command = None  # start() executes only what was accepted last
        self.__require_mode(ControlMode.TRAJECTORY, "set_trajectory")
        require_argument(self.name, argument)
        planning.check_trajectory(
            *(self.name, self.model, self.__logical.variable, trajectory, argument),
            limits_jerk=self.__hooks.limits_jerk(self.__logical.variable),
        )
        self.__hooks.check_command(self.__logical.variable, trajectory)
        self.__logical.command = trajectory
        self.__logical.argument = argument

    # ---- motion ----

    @final
    def start(self, timeout_s: float | None = None) -> None:
        """Start the commanded motion, with the settings made here.

        This is one atomic operation. The motor is acquired, and connected and enabled if necessary;
        changed settings are transmitted; the motion is started and acknowledged. Otherwise an error
        is raised and nothing has moved. Another start repeats the command. During a motion a
        set-point replaces a set-point of its variable, and a command of velocity, torque or current
        replaces one of the same variable. A trajectory with an initial velocity replaces a motion
        that has this velocity. All other commands start from rest.

        Args:
            timeout_s: timeout, first come first served, while another logical motor, of any
                process, holds it [s]; None: wait for a short operation only.

        Raises:
            StateError: no command is set, a motion is active, homing is required first, or the
                motor does not have the initial velocity of a trajectory.
            LimitError: the path leaves the limits.
            MotorBusyError: another logical motor holds it; names holder, purpose and time.
            DeviceFault: the drive reports a fault: reset_fault() first.
            MotionInterrupted: another party stopped the motor meanwhile.
        """
        start_together((self.__logical,), timeout_s)

    @final
    def reserve(
        self,
        purpose: str = "",
        *,
        timeout_s: float | None = None,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> AbstractContextManager[Reservation]:
        """Reserve the motor for several motions: `with motor.reserve("survey"):`.

        Inside the block no other owner, of any process, commands it; others may read it, and may
        stop it. A motion that is active at the end holds the motor until it has ended, without a
        lease. A takeover interrupts the motion of the former owner. Until the end of its block the
        former owner is refused, with the name of the new one, unless it reserves the motor again.

        Args:
            purpose: reported to other requests that are refused.
            timeout_s: timeout for the motor [s], as in `start`; with a takeover, for its rest.
            lease_s: another owner may take it over after this time without use [s]: no operation,
                no wait, no `Reservation.renew`; None: never.
            take_over: take it from its owner, ahead of all waiters, and bring it to rest.

        Raises:
            MotorBusyError: another owner holds or moves it, or is in the middle of a write.
            DeadlineExceeded: a motor that was taken over does not come to rest.
        """
        check_lease(lease_s)
        check_take_over(take_over)
        if not isinstance(purpose, str):
            raise UsageError(f"{self.name}: purpose {purpose!r} is not text; describe it in words")
        return self.__logical.reserve(purpose, check_timeout(timeout_s), lease_s, take_over)

    @final
    def wait_until_done(self, timeout_s: float | None = None) -> None:
        """Wait until the last command (motion, homing or stop), if any, has ended.

        A command that was set but not started is no reason to wait; a Python warning names it.

        A velocity, torque or current set-point is done when it is reached, and continues. A
        trajectory of them is done at the end of its ramp.

        Args:
            timeout_s: [s]; None: no timeout.

        Raises:
            DeadlineExceeded: not within `timeout_s`; the motion continues.
            MotionInterrupted: another party stopped or replaced the motion.
            DeviceFault: the drive has a fault.
            LinkError: the drive no longer responds.
        """
        wait_for_all((self.__logical,), timeout_s)

    @final
    def is_done(self) -> bool:
        """Return True if `wait_until_done` would return at once; raises as it does.

        A drive that must be polled is asked. In callbacks and in conditions of a wait, which cannot
        wait for the answer, its last status received counts.
        """
        return self.__logical.is_done()

    @final
    def on_done(self, callback: Callable[[Outcome], object]) -> "Registration":
        """Call `callback(outcome)` once, when the last command has ended.

        The call is immediate if it has ended already; else it happens in the event that ends it,
        whatever the outcome. Like any callback it must neither wait nor start anything that waits.
        A motor that must be polled reports only while a caller waits for it.

        Returns:
            A registration that cancels it.

        Raises:
            StateError: no command was given yet.
        """
        if not callable(callback):
            raise UsageError(f"{self.name}: on_done({callback!r}): not callable; give a function")
        run = self.__logical.run
        if run is None:
            raise StateError(
                motor=self.name,
                operation="on_done",
                state="nothing was commanded yet",
                remedy="call start() first, then on_done() reports the end of that motion",
            )
        notice = DoneNotice(
            lambda: self.__logical.outcome(run),
            callback,
            self.__logical.callback_failed,
            f"on_done of {self.name}",
        )
        notice.begin(self.runtime, self.__logical.physical, polls=self.__logical.coasts(run))
        return notice

    @final
    def progress(self) -> Progress | None:
        """Return the progress of the last command; None after its end, or without a command.

        This neither waits nor sends, so callbacks may call it. A command of velocity, torque or
        current continues after it was reached, and so does its progress.
        """
        run = self.__logical.run
        if run is None or run.is_over:
            return None
        try:
            if self.__logical.look(run) and run.ends:
                return None
        except MotorError:
            return None
        return self.__logical.progress(run)

    @final
    def stop(self) -> None:
        """Slow down and end the motion; wait_until_done() waits for rest.

        A motor without power coasts. It is at rest when its position has been constant for 50 ms.

        A stop needs no ownership, and may be called from a callback, as may `quick_stop` and
        `halt`.
        """
        self.__logical.bring_to_rest("stop", self.__hooks.stop)

    @final
    def quick_stop(self) -> None:
        """Stop by the quick stop of the drive; the motor moves again only after enable()."""
        self.__logical.bring_to_rest("quick_stop", self.__hooks.quick_stop)

    @final
    def halt(self) -> None:
        """Stop by the halt of the drive, at the deceleration of the motion, which ends."""
        self.__logical.bring_to_rest("halt", self.__hooks.halt)

    # ---- power, fault, reference ----

    @final
    def enable(self) -> None:
        """Switch on the power stage; the motor holds its position.

        Raises:
            DeviceFault: the drive reports a fault: reset_fault() first.
        """
        with self.__logical.operation("enable"):
            if self.__logical.require_no_fault() is not MotorState.ENABLED:
                self.__logical.enable()

    @final
    def disable(self) -> None:
        """Switch off the power stage and end the motion; a moving motor coasts."""
        with self.__logical.operation("disable"):
            status = self.__logical.status()
            self.__hooks.disable()
            self.__logical.physical.end(f"disable() of {self.name}", self.runtime.now_ns(), status)

    @final
    def reset_fault(self) -> None:
        """Clear the fault, if any; the power stage is off afterwards.

        Raises:
            DeviceFault: its cause persists.
        """
        with self.__logical.operation("reset_fault"):
            fault = self.__hooks.read_fault()
            if fault is None:
                return
            physical = self.__logical.physical
            if physical.run is not None:
                error = fault.as_error(physical.run.owner.name)
                physical.fail(error, self.runtime.now_ns())  # a wait may not have heard of it yet
            self.__hooks.reset_fault()

    @final
    def home(
        self, method: int | None = None, *, wait: bool = True, timeout_s: float = _HOMING_TIMEOUT_S
    ) -> None:
        """Find position 0 of the motor.

        Args:
            method: homing method number of CiA 402 (35, 37: the present position becomes 0); None:
                the default of the hardware, with a home offset of the hardware.
            wait: False: only begin; wait_until_done() waits for the end.
            timeout_s: timeout [s]; after that it is stopped.

        Raises:
            UnsupportedError: the motor does not support the method.
            PeerError: homing failed.
            DeadlineExceeded: not within `timeout_s`.
        """
        if method is not None and (not isinstance(method, int) or not -128 <= method <= 127):
            what = f"homing method {method!r}"
            raise UsageError(f"{self.name}: {what}: CiA 402 numbers them -128 to 127")
        check_timeout(timeout_s)
        with self.__logical.operation("home"):
            self.__logical.require_rest("home")
            if self.__logical.require_no_fault() is not MotorState.ENABLED:
                self.__logical.enable()
            self.__logical.begin("home", None)
            try:
                self.__hooks.home(method)
            except BaseException as error:
                self.__logical.physical.end(f"{error!r}", self.runtime.now_ns(), RunStatus.FAILED)
                raise
        if not wait:
            return
        try:
            self.wait_until_done(timeout_s)
        except BaseException:
            if not self.__logical.physical.ownership.is_lost_by(self.__logical):
                self.stop()
            raise

    # ---- state and measurements ----

    @property
    @final
    def ownership(self) -> Ownership:
        """The ownership of the physical motor; its `listeners` receive its events."""
        return self.__logical.physical.ownership

    @final
    def state(self) -> MotorState:
        """Return the state; OFFLINE if the motor does not respond."""
        access = self.__logical.physical.access
        if access is None:
            with self.__logical.physical.passage(self.name):
                return self.__hooks.read_state()
        latest = self.latest()
        if latest is None:
            raise access.busy(self.name)
        return latest.state

    @final
    def fault(self) -> Fault | None:
        """Return the fault reported by the drive, or None."""
        self.__logical.require_open()
        access = self.__logical.physical.access
        if access is None:
            with self.__logical.physical.passage(self.name):
                return self.__hooks.read_fault()
        latest = self.latest()
        if latest is None or latest.state is MotorState.FAULT:
            raise access.busy(self.name)  # only a request could tell the fault
        return None

    @final
    def is_referenced(self) -> bool:
        """Return True if position 0 is that of the model."""
        self.__logical.require_open()
        with self.__logical.physical.passage(self.name):
            self.__hooks.connect()
            return self.__hooks.read_referenced()

    @final
    def position(self) -> float:
        """Return the measured position [U]."""
        return self.__measured(self.__hooks.read_position, lambda latest: latest.position)

    @final
    def velocity(self) -> float:
        """Return the measured velocity [U/s]."""
        return self.__measured(self.__hooks.read_velocity, lambda latest: latest.velocity)

    @final
    def torque(self) -> float:
        """Return the measured torque [N·m], or force [N]."""
        return self.__measured(self.__hooks.read_torque, lambda latest: latest.torque)

    @final
    def following_error(self) -> float:
        """Return demand minus actual position [U]."""
        return self.__measured(
            self.__hooks.read_following_error, lambda latest: latest.following_error
        )

    @final
    def latest(self) -> Measurement | None:
        """Return the last measurement received; nothing is sent, so callbacks may call this."""
        return self.__hooks.latest()

    @final
    def __measured(
        self, read: Callable[[], float], heard: Callable[[Measurement], float | None]
    ) -> float:
        """Return a measured value; during low-level access, the last one received.

        Raises:
            LinkError: this motor was closed.
            MotorBusyError: low-level access is active, and no value was received.
        """
        self.__logical.require_open()
        access = self.__logical.physical.access
        if access is None:
            with self.__logical.physical.passage(self.name):
                self.__hooks.connect()
                return read()
        latest = self.latest()
        value = None if latest is None else heard(latest)
        if value is None:
            raise access.busy(self.name)
        return value

    # ---- direct hardware access ----

    @final
    def low_level(
        self: _WithHardware[_HardwareT_co], *, timeout_s: float | None = None
    ) -> AbstractContextManager[_HardwareT_co]:
        """Return a context with exclusive hardware access: `with motor.low_level() as hardware:`.

        Inside the block no other part of the interface accesses the hardware, for any logical motor
        including this one. Operations and stops are refused; readings return the last value
        received, or are refused; see `motorhil.motorapi.motor`. The hardware object is for this
        thread only. Type checkers know its class from the class of the motor. Afterwards nothing is
        assumed of the hardware: the next start writes all its settings. A nested block of the same
        motor has no effect.

        Args:
            timeout_s: timeout, first come first served, for other low-level access and for the end
                of a motion [s]; None: do not wait.

        Raises:
            MotorBusyError: another logical motor holds or moves it.
            StateError: a motion of this one is active.
            UnsupportedError: the adaptation does not offer its hardware object.
        """
        own = cast(Motor, self).__logical  # noqa: SLF001  (its own: the type of self hides it)
        access = own.low_level(check_timeout(timeout_s))
        return cast(AbstractContextManager[_HardwareT_co], access)

    # ---- internal ----

    @final
    def __require_mode(self, mode: ControlMode, operation: str) -> None:
        if self.__logical.mode is not mode:
            found = "not set" if self.__logical.mode is None else self.__logical.mode.name
            raise StateError(
                motor=self.name,
                operation=operation,
                state=f"its control mode is {found}",
                remedy=f"call set_control_mode(ControlMode.{mode.name}) first",
            )
