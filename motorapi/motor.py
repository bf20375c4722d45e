"""The base motor: what an application calls.

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

Setting is local: nothing is sent, and other logical motors of the same physical motor see nothing
of it. `start` takes the motor, pushes what differs, and starts, or raises and has moved nothing.
Public methods are final: they validate, take the motor, convert errors, and report. What a vendor
fills in is in `motorapi.hooks`; what only looks is in `motorapi.readable_motor`, what knows how
motions end in `motorapi.shared_motor`. U stands for the
motor's unit of position: rad, or m if linear.
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
    """A logical motor: the user's view of one physical motor. Settings are kept here until start().

    An adaptation derives from it and fills in the hooks; it cannot override what is public.
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
                    problem="public methods of Motor are final; fill in a hook instead",
                )

    # ---- what to do: kept here until start() ----

    @property
    @final
    def control_mode(self) -> ControlMode | None:
        """How commands are given; None until `set_control_mode`."""
        return self._mode

    @property
    @final
    def control_variable(self) -> ControlVariable:
        """The quantity being commanded."""
        return self._variable

    @final
    def set_control_mode(
        self, mode: ControlMode, variable: ControlVariable = ControlVariable.POSITION
    ) -> None:
        """Commands are given as `mode` says, for `variable`, from now on. Nothing is sent.

        A command for another mode or variable is forgotten.

        Raises:
            UnsupportedError: this motor cannot be commanded so.
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
        """`value` is what start() aims at. Nothing is sent.

        Args:
            value: the target, in the unit of the control variable (position: U).
            relative: `value` is a distance from where the motor is when it starts.
            limits: of the derivatives, where tighter than the model's.

        Raises:
            StateError: the control mode is not SETPOINT.
            LimitError: the target or a limit exceeds the model's.
        """
        self._require_mode(ControlMode.SETPOINT, "set_setpoint")
        setpoint = Setpoint(value, relative, limits)
        planning.check_setpoint(self.name, self.model, self._variable, setpoint)
        self._call(self._check_command, self._variable, setpoint)
        self._command = replace(setpoint, value=float(value))

    @final
    def set_trajectory(self, trajectory: Trajectory, argument: "Argument | None" = None) -> None:
        """`trajectory` is what start() follows. Nothing is sent.

        Args:
            trajectory: simple (TrapezoidalTrajectory) or complex (ComplexTrajectory).
            argument: what a complex one is a function of; None: of time since the start [s].

        Raises:
            StateError: the control mode is not TRAJECTORY.
            LimitError: a boundary value, a limit or the duration exceeds what the motor can do.
            UnsupportedError: the motor cannot follow one of that kind.
        """
        self._require_mode(ControlMode.TRAJECTORY, "set_trajectory")
        require_argument(self.name, argument)
        planning.check_trajectory(self.name, self.model, self._variable, trajectory, argument)
        self._call(self._check_command, self._variable, trajectory)
        self._command = trajectory
        self._argument = argument

    # ---- doing it ----

    @final
    def start(self, timeout_s: float | None = None) -> None:
        """The motion that was set has begun, with the settings made here.

        One atomic operation: the motor is taken, connected and enabled if it is not, every setting
        that differs is pushed, the motion is started and acknowledged; or an error is raised and
        nothing has moved. Starting again repeats the command. In mid-motion a set-point replaces
        a set-point of its variable, and what is said of velocity, torque or current replaces what
        was said of the same; everything else starts from rest.

        Args:
            timeout_s: how long to wait, first come first served, while another logical motor, of
                whatever process, holds it [s]; None: not at all, but for a short operation.

        Raises:
            StateError: nothing was set; a motion goes on; or it must be referenced first.
            LimitError: the way leaves the limits.
            MotorBusyError: another logical motor holds it; says who, what for, and since when.
            DeviceFault: the drive reports a fault: reset_fault() first.
            MotionInterrupted: somebody stopped the motor meanwhile.
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
        """`with motor.reserve("survey"):` the motor is this one's over several motions.

        Nobody else commands it inside the block, of whatever process; others read it, and may stop
        it. A motion that goes on at the end holds the motor until it is over, and has no lease.

        From whom it was taken over, his motion is interrupted, and until the end of his block he is
        refused by the name of who did it, unless he reserves it again.

        Args:
            purpose: what for; those who are refused are told.
            timeout_s: how long to wait for the motor [s], as in `start`; for rest, if it is taken
                from others.
            lease_s: whoever comes next may take it over once this motor was not used for so long
                [s]: no operation, no wait, no `Reservation.renew`; None: nobody may.
            take_over: take it from whoever has it, in front of all who wait, and bring it to rest.

        Raises:
            MotorBusyError: somebody else holds it, or moves it; or it is in the middle of a write.
            DeadlineExceeded: what was taken over does not come to rest.
        """
        check_timeout(timeout_s)
        check_lease(lease_s)
        check_take_over(take_over)
        if not isinstance(purpose, str):
            raise UsageError(f"{self.name}: purpose {purpose!r}: say it in words")
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
        """What was commanded last here (motion, homing or stop) is over; at once if nothing was.

        A velocity, torque or current set-point is done when it is reached, and goes on.

        Args:
            timeout_s: [s]; None: as long as it takes.

        Raises:
            DeadlineExceeded: not within `timeout_s`; the motion goes on.
            MotionInterrupted: it was stopped or replaced by somebody else.
            DeviceFault: the drive has a fault.
            LinkError: the drive is no longer heard.
        """
        wait_for_all((self,), timeout_s)

    @final
    def stop(self) -> None:
        """The motor is slowing down and its motion is over; wait_until_done() waits for rest.

        Stopping takes nobody's permission, and may be done from a callback. So may `quick_stop`
        and `halt`.
        """
        self._bring_to_rest("stop", self._stop)

    @final
    def quick_stop(self) -> None:
        """The motor stops as its quick stop does; it moves again only after enable()."""
        self._bring_to_rest("quick_stop", self._quick_stop)

    @final
    def halt(self) -> None:
        """The motor stops as the drive's halt option says; its motion is over."""
        self._bring_to_rest("halt", self._halt)

    # ---- power, fault, reference ----

    @final
    def enable(self) -> None:
        """The power stage is on and the motor holds its position.

        Raises:
            DeviceFault: the drive reports a fault: reset_fault() first.
        """
        with self._operation("enable"):
            if require_no_fault(self) is not MotorState.ENABLED:
                self._call(self._enable)

    @final
    def disable(self) -> None:
        """The power stage is off; a motion is over, and a motor in motion coasts."""
        with self._operation("disable"):
            status = self._status()
            self._call(self._disable)
            self._physical.end(f"disable() of {self.name}", self.runtime.now_ns(), status)

    @final
    def reset_fault(self) -> None:
        """There is no fault any more; the power stage is off if there was one.

        Raises:
            DeviceFault: its cause is still there.
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
        """The motor knows where its position 0 is.

        Args:
            method: as CiA 402 numbers them (37: here is 0); None: the hardware's default.
            wait: False: it has only begun; wait_until_done() waits for it.
            timeout_s: how long it may take [s]; after that it is stopped.

        Raises:
            UnsupportedError: the motor does not know the method.
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

    # ---- the hardware itself ----

    @final
    def low_level(self, *, timeout_s: float | None = None) -> AbstractContextManager[Any]:
        """`with motor.low_level() as hardware:` all the hardware can do, and nobody else at it.

        Inside the block nothing else of the interface touches the hardware, of whatever logical
        motor, this one included: operations and stops are refused, readings answer from what was
        heard last, or are refused; see `motorapi.low_level`. The hardware object is for this
        thread alone. Afterwards nothing is believed of it: the next start writes all it needs. A
        block of the same motor inside the block changes nothing.

        Args:
            timeout_s: how long to wait, first come first served, for another's low-level access
                and for the end of a motion [s]; None: neither is waited for.

        Raises:
            MotorBusyError: another logical motor holds it, or moves it.
            StateError: a motion of this one goes on.
            UnsupportedError: the adaptation gives no hardware object away.
        """
        return low_level_access(self, timeout_s)

    # ---- inside ----

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
