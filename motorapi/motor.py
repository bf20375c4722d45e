"""The base motor: the public interface for applications.

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
implements the hooks of `motorapi.hooks`. Read access is in `motorapi.readable_motor`, the end of
motions in `motorapi.shared_motor`. U is the unit of position of the motor: rad, or m if linear.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, final

from motorapi import planning
from motorapi.arguments import require_argument
from motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Setpoint,
    as_number,
)
from motorapi.errors import (
    PluginError,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorapi.execution import require_no_fault, require_rest, start_together
from motorapi.low_level import low_level_access
from motorapi.motion_waits import check_timeout, wait_for_all
from motorapi.reservation import Reservation, check_lease, check_take_over
from motorapi.shared_motor import SharedMotor
from motorapi.sharing import Run, RunStatus
from motorapi.state import MotorState
from motorapi.trajectory import Trajectory

if TYPE_CHECKING:
    from motorapi.arguments import Argument

_HOMING_TIMEOUT_S: Final = 60.0


class Motor(SharedMotor):
    """A logical motor: the user's view of one physical motor. Settings stay here until start().

    An adaptation derives from it and implements the hooks; it cannot override public methods.
    """

    _mode: ControlMode | None = None
    _variable: ControlVariable = ControlVariable.POSITION
    _command: Setpoint | Trajectory | None = None
    _argument: "Argument | None" = None

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        for name in cls.__dict__:
            if not name.startswith("_") and name != "close" and hasattr(Motor, name):
                raise PluginError(
                    plugin=cls.__qualname__,
                    where=name,
                    problem="public methods of Motor are final; implement a hook instead",
                )

    # ---- settings, kept here until start() ----

    @property
    @final
    def control_mode(self) -> ControlMode | None:
        """The form of commands; None until `set_control_mode`."""
        return self._mode

    @property
    @final
    def control_variable(self) -> ControlVariable:
        """The commanded quantity."""
        return self._variable

    @final
    def set_control_mode(
        self, mode: ControlMode, variable: ControlVariable = ControlVariable.POSITION
    ) -> None:
        """Set the form of commands and the commanded quantity. Nothing is sent.

        A command for another mode or variable is discarded.

        Raises:
            UnsupportedError: this motor does not support them.
        """
        if not isinstance(mode, ControlMode) or not isinstance(variable, ControlVariable):
            raise UsageError(
                f"{self.name}: control mode {mode!r}, {variable!r}: give a ControlMode and a"
                " ControlVariable, as ControlMode.SETPOINT, ControlVariable.VELOCITY"
            )
        if not self._call(self._supports, mode, variable):
            able = ", ".join(
                f"{m.value} of {v.value}"
                for m in ControlMode
                for v in ControlVariable
                if self._call(self._supports, m, v)
            )
            asked = f"{mode.value} of {variable.value}"
            raise UnsupportedError(motor=self.name, feature=asked, supported=able)
        if (mode, variable) != (self._mode, self._variable):
            self._command = None
        self._mode = mode
        self._variable = variable

    @final
    def set_setpoint(
        self, value: float, relative: bool = False, limits: DerivativeLimits | None = None
    ) -> None:
        """Set the target of start(). Nothing is sent.

        Args:
            value: the target, in the unit of the control variable (position: U).
            relative: `value` is a distance from the position at the start.
            limits: of the derivatives, if tighter than those of the model.

        Raises:
            StateError: the control mode is not SETPOINT.
            LimitError: the target or a limit exceeds that of the model.
        """
        self._require_mode(ControlMode.SETPOINT, "set_setpoint")
        setpoint = Setpoint(value, relative, limits)
        planning.check_setpoint(self.name, self.model, self._variable, setpoint)
        self._call(self._check_command, self._variable, setpoint)
        self._command = replace(setpoint, value=float(value))

    @final
    def set_trajectory(self, trajectory: Trajectory, argument: "Argument | None" = None) -> None:
        """Set the trajectory of start(). Nothing is sent.

        Args:
            trajectory: simple (TrapezoidalTrajectory) or complex (ComplexTrajectory).
            argument: the argument of a complex one; None: time since the start [s].

        Raises:
            StateError: the control mode is not TRAJECTORY.
            LimitError: a boundary value, a limit or the duration exceeds the ability of the motor.
            UnsupportedError: the motor cannot follow a trajectory of that kind.
        """
        self._require_mode(ControlMode.TRAJECTORY, "set_trajectory")
        require_argument(self.name, argument)
        planning.check_trajectory(self.name, self.model, self._variable, trajectory, argument)
        self._call(self._check_command, self._variable, trajectory)
        self._command = trajectory
        self._argument = argument

    # ---- motion ----

    @final
    def start(self, timeout_s: float | None = None) -> None:
        """Start the commanded motion, with the settings made here.

        This is one atomic operation. The motor is acquired, and connected and enabled if necessary;
        changed settings are transmitted; the motion is started and acknowledged. Otherwise an error
        is raised and nothing has moved. Another start repeats the command. During a motion a
        set-point replaces a set-point of its variable, and a command of velocity, torque or current
        replaces one of the same variable. All other commands start from rest.

        Args:
            timeout_s: timeout, first come first served, while another logical motor, of any
                process, holds it [s]; None: wait for a short operation only.

        Raises:
            StateError: no command is set, a motion is active, or homing is required first.
            LimitError: the path leaves the limits.
            MotorBusyError: another logical motor holds it; names holder, purpose and time.
            DeviceFault: the drive reports a fault: reset_fault() first.
            MotionInterrupted: another party stopped the motor meanwhile.
        """
        start_together((self,), timeout_s)

    @final
    @contextmanager
    def reserve(
        self,
        purpose: str = "",
        *,
        timeout_s: float | None = None,
        lease_s: float | None = None,
        take_over: bool = False,
    ) -> Iterator[Reservation]:
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
        check_timeout(timeout_s)
        check_lease(lease_s)
        check_take_over(take_over)
        if not isinstance(purpose, str):
            raise UsageError(f"{self.name}: purpose {purpose!r} is not text; describe it in words")
        patience = None if timeout_s is None else self._patience(as_number(timeout_s))
        who, asked_ns = f"reserve() of {self.name}", self.runtime.now_ns()
        physical = self._physical
        if take_over:
            physical.require_not_held_elsewhere()
        with physical.ownership.owned(
            self, who, purpose, patience, lease_s=lease_s, take_over=take_over, afresh=True
        ) as claim:
            with physical.transaction(self.runtime, who):
                self._take_physical(take_over or physical.ownership.is_orphan)
                if physical.ownership.is_orphan:
                    self._call(self._connect)
                    self._adopt(timeout_s if take_over else None, asked_ns)
            yield Reservation((self.name,), (claim,))

    @final
    def wait_until_done(self, timeout_s: float | None = None) -> None:
        """Wait until the last command (motion, homing or stop), if any, has ended.

        A velocity, torque or current set-point is done when it is reached, and continues.

        Args:
            timeout_s: [s]; None: no timeout.

        Raises:
            DeadlineExceeded: not within `timeout_s`; the motion continues.
            MotionInterrupted: another party stopped or replaced the motion.
            DeviceFault: the drive has a fault.
            LinkError: the drive no longer responds.
        """
        wait_for_all((self,), timeout_s)

    @final
    def stop(self) -> None:
        """Slow down and end the motion; wait_until_done() waits for rest.

        A stop needs no ownership, and may be called from a callback, as may `quick_stop` and
        `halt`.
        """
        self._bring_to_rest("stop", self._stop)

    @final
    def quick_stop(self) -> None:
        """Stop by the quick stop of the drive; the motor moves again only after enable()."""
        self._bring_to_rest("quick_stop", self._quick_stop)

    @final
    def halt(self) -> None:
        """Stop according to the halt option of the drive, and end the motion."""
        self._bring_to_rest("halt", self._halt)

    # ---- power, fault, reference ----

    @final
    def enable(self) -> None:
        """Switch on the power stage; the motor holds its position.

        Raises:
            DeviceFault: the drive reports a fault: reset_fault() first.
        """
        with self._operation("enable"):
            if require_no_fault(self) is not MotorState.ENABLED:
                self._call(self._enable)

    @final
    def disable(self) -> None:
        """Switch off the power stage and end the motion; a moving motor coasts."""
        with self._operation("disable"):
            status = self._status()
            self._call(self._disable)
            self._physical.end(f"disable() of {self.name}", self.runtime.now_ns(), status)

    @final
    def reset_fault(self) -> None:
        """Clear the fault, if any; the power stage is off afterwards.

        Raises:
            DeviceFault: its cause persists.
        """
        with self._operation("reset_fault"):
            fault = self._call(self._read_fault)
            if fault is None:
                return
            self._call(self._reset_fault)
            by = f"fault {fault.code:04X}h"
            self._physical.end(by, self.runtime.now_ns(), RunStatus.FAILED)

    @final
    def home(
        self, method: int | None = None, *, wait: bool = True, timeout_s: float = _HOMING_TIMEOUT_S
    ) -> None:
        """Find position 0 of the motor.

        Args:
            method: homing method number of CiA 402 (37: present position); None: the default of the
                hardware.
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
        with self._operation("home"):
            require_rest(self, "home")
            if require_no_fault(self) is not MotorState.ENABLED:
                self._call(self._enable)
            self._begin("home", None)
            try:
                self._call(self._home, method)
            except BaseException as error:
                self._physical.end(f"{error!r}", self.runtime.now_ns(), RunStatus.FAILED)
                raise
        if not wait:
            return
        try:
            self.wait_until_done(timeout_s)
        except BaseException:
            if not self._physical.ownership.is_lost_by(self):
                self.stop()
            raise

    # ---- direct hardware access ----

    @final
    def low_level(self, *, timeout_s: float | None = None) -> AbstractContextManager[Any]:
        """Return a context with exclusive hardware access: `with motor.low_level() as hardware:`.

        Inside the block no other part of the interface accesses the hardware, for any logical motor
        including this one. Operations and stops are refused; readings return the last value
        received, or are refused; see `motorapi.low_level`. The hardware object is for this thread
        only. Afterwards nothing is assumed of the hardware: the next start writes all its settings.
        A nested block of the same motor has no effect.

        Args:
            timeout_s: timeout, first come first served, for other low-level access and for the end
                of a motion [s]; None: do not wait.

        Raises:
            MotorBusyError: another logical motor holds or moves it.
            StateError: a motion of this one is active.
            UnsupportedError: the adaptation does not offer its hardware object.
        """
        return low_level_access(self, timeout_s)

    # ---- internal ----

    @final
    def _bring_to_rest(self, operation: str, hook: Callable[[], None]) -> None:
        with self._physical.interrupt(self.name):
            status = self._status()
            self._call(self._connect)
            self._call(hook)
            run = Run(f"{operation}() of {self.name}", self, self.runtime.now_ns(), None)
            self._run = run
            self._physical.begin(run, status)
            self._keep()

    @final
    def _require_mode(self, mode: ControlMode, operation: str) -> None:
        if self._mode is not mode:
            found = "not set" if self._mode is None else self._mode.name
            raise StateError(
                motor=self.name,
                operation=operation,
                state=f"its control mode is {found}",
                remedy=f"call set_control_mode(ControlMode.{mode.name}) first",
            )
