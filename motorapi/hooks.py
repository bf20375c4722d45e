"""Hooks of a motor: the protected methods that a vendor implements.

An adaptation derives from `motorhil.motorapi.motor.Motor`, contains a hardware object, and
implements six of these hooks: `_connect`, `_latest`, `_enable`, `_disable`, `_command` and `_stop`.
Every other hook is a capability of the drive. Its default is true of a drive that lacks it: it
raises UnsupportedError, or does with the six what any drive can do. The conformance kit asks a
motor for its capabilities, and does not test for those that it lacks.

All values are in SI units with the sign of the motor model; increments stay inside the hardware
object. Unless its documentation says otherwise, a hook may wait, through `self.runtime` only. Hooks
raise the errors of `motorhil.motorapi.errors`; any other exception reaches the caller as a
`PluginError`. The public methods check modes, limits and state before they
call a hook. They ensure that no two acting hooks run at once on one physical motor, except `_stop`,
`_stop_with_others`, `_quick_stop` and `_halt`. U is the unit of position of the motor: rad, or m
for a linear motor.

The hardware object belongs to the adaptation. These requirements apply:

- One hardware object exists per physical motor and process.
  `motorhil.motorapi.ownership.physical_motor.register_physical_motor` returns the record with
  which the motor is built (`physical`); `release_physical_motor` removes it.
- If other programs can open the same bus (`motorhil.motorapi.locking.process_lock.can_share_time`,
  and a name from `motorhil.motorapi.locking.directory`), it registers with a `ProcessLock` of that
  name and its node. Then every frame that may start or change a motion or a setting is sent between
  `begin_write` and `end_write` of `physical.ownership`, as described in
  `motorhil.motorapi.ownership.fencing`, and never after they raised. On CAN, `NodeFence` does this,
  and `announce` informs a hub. Stops are sent without it. A request of several frames needs a lock
  of its own, so that the answer to another program is not mistaken for its own.
- Its recurring activity (a stream, a servo) continues under the ownership under which it began, and
  no other: `NodeFence.bound`.
- If it is notified of every change that `_is_done` evaluates, `physical.news` counts the changes.
  If it must poll, `_refresh` polls, and returns the interval.
- If it knows whether the drive is heard, `physical.check_heard` raises LinkError if it is not.
- On CAN it declares the frames that it and its drive send, with
  `motorhil.motorapi.synchronization.bus_load.note_node` and `note_stream`. Otherwise skew bounds of
  others on that bus are wrong.

An adaptation may use any private name except those of the hooks and `_physical`. The interface
keeps its own state under names of another form.

A motor may be left moving, by a process that died or lost the motor to a takeover. Such a motor is
brought to rest by `_stop`, `_refresh` and `_is_done` before its next owner commands it, unless it
has a fault. A drive that does not tell whether it is on must obey `_stop` in any case.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import fields
from typing import Any, Final, Protocol, final

from motorhil.frozen import frozen
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.device import Device
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    LinkError,
    MotionInterrupted,
    MotorError,
    PluginError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.physical_motor import ActiveMotion, PhysicalMotor
from motorhil.motorapi.runtime.api import LOOK_PERIOD_S, Runtime
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel
from motorhil.motorapi.trajectory import (
    ComplexTrajectory,
    Trajectory,
    TrapezoidalTrajectory,
    asks_for_smoothness,
    has_moving_ends,
)

_STILL_S: Final = 0.05
"""The time for which the position of a motor at rest must be constant [s]."""
_STILL_SHARE: Final = 1e-3
"""The velocity up to which a motor counts as at rest, as a share of its maximum."""
_BEGUN_S: Final = 0.1
"""The time after a command from which a velocity of 0 is that of its end [s]."""
_REACHED_SHARE: Final = 0.02
"""The deviation at which a velocity counts as reached, as a share of the maximum."""


class ArmHook(Protocol):
    """The type of `MotorHooks._arm`."""

    def __call__(self, motion: Motion, *, together: bool) -> Trigger:
        """See `MotorHooks._arm`."""


@final
@frozen
class Hooks:
    """The hooks of one motor, as the interface calls them; `MotorHooks` documents each.

    An exception of a hook that is not a `MotorError` becomes a `PluginError`.
    """

    plugin: str
    supports: Callable[[ControlMode, ControlVariable], bool]
    check_command: Callable[[ControlVariable, Setpoint | Trajectory], None]
    limits_jerk: Callable[[ControlVariable], bool]
    sync_offer: Callable[[], SyncOffer]
    quantise: Callable[[Motion], Motion]
    connect: Callable[[], None]
    read_state: Callable[[], MotorState]
    read_fault: Callable[[], Fault | None]
    read_referenced: Callable[[], bool]
    read_position: Callable[[], float]
    read_velocity: Callable[[], float]
    read_reference: Callable[[], float]
    read_torque: Callable[[], float]
    read_following_error: Callable[[], float]
    latest: Callable[[], Measurement | None]
    position_source: Callable[[], str]
    refresh: Callable[[], float | None]
    enable: Callable[[], None]
    disable: Callable[[], None]
    reset_fault: Callable[[], None]
    home: Callable[[int | None], None]
    arm: ArmHook
    disarm: Callable[[], None]
    confirm: Callable[[Motion], None]
    is_done: Callable[[], bool]
    stop: Callable[[], None]
    stop_with_others: Callable[[], Trigger | None]
    quick_stop: Callable[[], None]
    halt: Callable[[], None]
    motion_times: Callable[[], MotionTimes | None]
    open_low_level: Callable[[], object]
    close_low_level: Callable[[], None]

    @classmethod
    def of(cls, motor: "MotorHooks") -> "Hooks":
        """Return the hooks of a motor; each field has the name of its hook."""
        names = [field.name for field in fields(cls)]
        calls = {name: _guarded(motor, f"_{name}") for name in names[1:]}
        calls["latest"] = _latest_of(motor)
        return cls(type(motor).__qualname__, **calls)

    def fire(self, trigger: Trigger) -> None:
        """Fire a trigger that one of the hooks returned."""
        try:
            trigger.fire()
        except MotorError:
            raise
        except Exception as error:
            raise PluginError(plugin=self.plugin, where="fire", problem=repr(error)) from error


def _guarded(motor: "MotorHooks", name: str) -> Any:
    """Return a call of the hook, which is looked up by its name each time."""
    ownership = motor._physical.ownership  # noqa: SLF001  (of the class below)

    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            return getattr(motor, name)(*args, **kwargs)
        except DeadlineExceeded:
            ownership.refusal_check()  # then names the owner instead
            raise
        except MotorError:
            raise
        except Exception as error:
            plugin = type(motor).__qualname__
            raise PluginError(plugin=plugin, where=name, problem=repr(error)) from error

    return call


def _latest_of(motor: "MotorHooks") -> Callable[[], Measurement | None]:
    """Return the guarded call of `_latest`, which recorders make hundreds of times a second."""
    seen = motor._physical.seen  # noqa: SLF001  (of the class below)

    def latest() -> Measurement | None:
        try:
            heard = motor._latest()  # noqa: SLF001  (of the class below)
        except MotorError:
            raise
        except Exception as error:
            plugin = type(motor).__qualname__
            raise PluginError(plugin=plugin, where="_latest", problem=repr(error)) from error
        return seen(heard)

    return latest


@final
class Rest:
    """The rest of a motor, found from its positions.

    Attributes:
        rests: True if it has come to rest.
    """

    def __init__(self, model: MotorModel) -> None:
        self.rests: bool = False
        still = _STILL_SHARE * model.velocity_max * _STILL_S
        self._still: Final = max(still, 2.0 * (model.resolution or 0.0))
        self._place: float | None = None
        self._since_ns = self._seen_ns = 0

    def see(self, position: float, now_ns: int) -> bool:
        """Process a position [U] read at this time. Return `rests`."""
        if now_ns < self._seen_ns:
            return self.rests  # heard before the last one that was read
        self._seen_ns = now_ns
        if self._place is None or abs(position - self._place) > self._still:
            self._place, self._since_ns = position, now_ns
        self.rests = now_ns - self._since_ns >= round(_STILL_S * 1e9)
        return self.rests


@final
class _End:
    """The end of the last command, found from measurements alone."""

    def __init__(self, model: MotorModel) -> None:
        self._model: Final = model
        self._run: ActiveMotion | None = None
        self._rest = Rest(model)

    def is_over(self, run: ActiveMotion | None, latest: Measurement) -> bool:
        """Process a measurement. Return True if the command of `run` has ended."""
        if run is not None and run.is_over:
            run = None  # a motor left moving, after a stop
        if run is not self._run:
            self._run, self._rest = run, Rest(self._model)
        if run is None:
            return self._rests(latest, 0.0)
        elapsed_s, motion, model = (latest.time_ns - run.since_ns) / 1e9, run.motion, self._model
        if elapsed_s <= 0.0:
            return False  # measured before the command
        if motion is None:
            return self._rests(latest, elapsed_s)
        if motion.duration_s is not None and elapsed_s < motion.duration_s:
            return False
        if motion.variable is ControlVariable.POSITION:
            at = motion.target if latest.position is None else latest.position
            is_there = abs(at - motion.target) <= model.start_tolerance
            return self._rests(latest, elapsed_s) and is_there
        if motion.variable is ControlVariable.VELOCITY:
            at = motion.target if latest.velocity is None else latest.velocity
            return abs(at - motion.target) <= _REACHED_SHARE * model.velocity_max
        return elapsed_s >= abs(motion.distance) / motion.slope

    def _rests(self, latest: Measurement, elapsed_s: float) -> bool:
        """Return True if the motor is at rest, by its positions or, later, by its velocity."""
        still = _STILL_SHARE * self._model.velocity_max
        if latest.position is None or self._rest.see(latest.position, latest.time_ns):
            return True
        has_begun = elapsed_s >= _BEGUN_S
        return has_begun and latest.velocity is not None and abs(latest.velocity) <= still


@final
@frozen(eq=False)
class CommandTrigger:
    """The trigger of a drive without synchronous starts: its command itself."""

    fire: Callable[[], None]


def implements(motor: "MotorHooks", hook: str) -> bool:
    """Return True if the adaptation implements a hook that has a default."""
    return getattr(type(motor), hook) is not getattr(MotorHooks, hook)


class MotorHooks(Device, ABC):
    """The vendor's side of a motor; the application's side is `motorhil.motorapi.motor.Motor`.

    Args:
        name: name in messages and recordings; None: the names of the model and the hardware.
        model: constant properties of the motor, shared between copies.
        runtime: the runtime in which it waits.
        physical: the record that `register_physical_motor` returned for its hardware object.
        on_close: called once when the motor is closed. The hardware object belongs to its creator.

    Raises:
        UsageError: the class implements neither `_command` nor `_arm`.
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
        super().__init__(f"{model.name} at {physical.label}" if name is None else name, runtime)
        if not implements(self, "_arm") and not implements(self, "_command"):
            raise UsageError(f"{type(self).__qualname__}: implements neither _command nor _arm")
        self.__model = model
        self._physical = physical
        self.__on_close = on_close
        self.__end = _End(model)

    def close(self) -> None:
        """Close the motor; closing again does nothing."""
        on_close, self.__on_close = self.__on_close, None
        if on_close is not None:
            on_close()

    @property
    @final
    def model(self) -> MotorModel:
        """The constant properties of this motor."""
        return self.__model

    # ---- the six that every adaptation implements ----

    @abstractmethod
    def _connect(self) -> None:
        """Ensure that the hardware answers and is configured: booted, PDOs mapped, dead-man active.

        Called at the beginning of every public operation that needs the bus (except `state` and
        `fault`), so it must be cheap if nothing is to be done. Two threads may call it at once: the
        second waits for the first. Also called for read access: if other programs can be on the
        bus, it may write only inside `physical.ownership.owned_to_set_up`.
        """

    @abstractmethod
    def _latest(self) -> Measurement | None:
        """Return the last values received from the drive; None before the first ones.

        Called in callbacks of recorders: must neither wait nor send. The time is that at which the
        values were complete on the bus. The interface itself replaces the state by OFFLINE where
        `physical.check_heard` raises, and by STOPPED after a quick stop without a hook of its own.
        """

    @abstractmethod
    def _enable(self) -> None:
        """Switch on the power stage; the motor holds its position and does not move.

        Also called after a quick stop, when the power stage may be on already.
        """

    @abstractmethod
    def _disable(self) -> None:
        """Switch off the power stage."""

    def _command(self, motion: Motion) -> None:
        """Send `motion` to the drive, which begins it at once; return when it was transmitted.

        It is absolute and within the limits; this hook applies the rounding of the hardware. A
        drive that can hold a motion back until a signal implements `_arm` instead; by default, its
        trigger is fired at once.
        """
        self._arm(motion, together=False).fire()

    @abstractmethod
    def _stop(self) -> None:
        """Slow down at `physical.stop_deceleration`, then hold; the motion ends.

        This hook, `_quick_stop` and `_halt` are called without a transaction, possibly from a
        callback and while another thread is inside another hook of this motor: send, do not wait.
        A motor without power has nothing to stop, and must not refuse it.
        """

    # ---- capabilities of the hardware: answered at once, without the bus ----

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        """Return True if this motor supports commands of this mode and variable.

        By default, it supports set-points and trajectories of position.
        """
        return variable is ControlVariable.POSITION

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        """Check that this motor can execute a command of a supported mode and variable at all.

        By default, it executes what trapezoids of position and ramps of other variables can.
        Called when the command is set; nothing may be sent.

        Raises:
            UnsupportedError: it cannot, whatever the values.
        """
        if isinstance(command, ComplexTrajectory):
            raise UnsupportedError(
                motor=self.name,
                feature=f"a complex trajectory of {variable.value}",
                supported="simple trajectories",
            )
        if has_moving_ends(command):
            raise UnsupportedError(
                motor=self.name,
                feature="a trajectory that does not begin and end at rest",
                supported="trajectories from rest to rest",
            )
        if isinstance(command, TrapezoidalTrajectory) and asks_for_smoothness(variable, command):
            raise UnsupportedError(
                motor=self.name,
                feature=f"a trajectory of {variable.value} with limited jerk",
                supported="trajectories at constant acceleration",
            )

    def _limits_jerk(self, variable: ControlVariable) -> bool:
        """Return True if simple trajectories of `variable` get the model's jerk limit by default.

        They are then motions with a `function`. Otherwise only a limit of the command is met.
        """
        return False

    def _sync_offer(self) -> SyncOffer:
        """Return the capability for starts together with others, as configured now.

        By default, motors start one after another. This hook and `_quantise` are called after
        `_connect`.
        """
        return SyncOffer(
            SyncLevel.SEQUENTIAL,
            self._physical.label,
            None,
            "the drive has no signal that starts several: each has a command of its own",
            no_firing_bound="no bound is known for that command",
            no_start_bound="the drive's own cycle is not known",
            no_end_bound="the drive's own clock is not known",
        )

    def _quantise(self, motion: Motion) -> Motion:
        """Return `motion` as the hardware executes it, rounded to its own units.

        Target, velocity, acceleration and deceleration may differ from the request by one step of
        the hardware. Velocities and accelerations are rounded down, so that no limit is exceeded
        (but not to 0). A rounded motion stays unchanged. The common duration of a group, and its
        end skew, are predicted from the result. A motion with a `function` keeps it. By default,
        the hardware rounds nothing: its units are floating-point numbers.
        """
        return motion

    # ---- state and measurements ----

    def _read_state(self) -> MotorState:
        """Return the state, without waiting if the hardware reports it. A fault is not an error.

        OFFLINE if the motor does not respond. This hook and `_read_fault` may be called before any
        `_connect`. By default, the state of `_latest` after `_refresh`.
        """
        try:
            self._refresh()
        except (DeadlineExceeded, LinkError):
            return MotorState.OFFLINE
        latest = self._physical.seen(self._latest())
        return MotorState.OFFLINE if latest is None else latest.state

    def _read_fault(self) -> Fault | None:
        """Return the fault that the drive reports, or None.

        By default, that of `_latest_fault` after `_refresh`.
        """
        self._refresh()
        return self._latest_fault()

    def _latest_fault(self) -> Fault | None:
        """Return the last fault received, or None. Called inside waits: neither wait nor send.

        By default, that of a `_read_fault` of the adaptation, which must then not wait either;
        without one, a fault without a code.
        """
        if implements(self, "_read_fault"):
            return self._read_fault()
        latest = self._latest()
        if latest is None or latest.state is not MotorState.FAULT:
            return None
        return Fault(0, "the drive reports no code", latest.time_ns)

    def _read_referenced(self) -> bool:
        """Return True if position 0 is that of the model (homed since power-on)."""
        return False

    def _read_position(self) -> float:
        """Return the measured position [U]; this and the next: those of `_latest` by default."""
        return self.__present(self.__measure().position, "the position")

    def _read_velocity(self) -> float:
        """Return the measured velocity [U/s]."""
        return self.__present(self.__measure().velocity, "the velocity")

    def _read_reference(self) -> float:
        """Return the position that the controller holds or passes now [U]: the demand.

        With the power stage off, the measured position; so, too, in the motion of a set-point that
        the hardware makes without a profile: its demand is the target at once. Relative motions
        start from here, so that servo errors do not accumulate. By default, the target of the last
        motion while the motor rests there, else the measured position.
        """
        run, position = self._physical.run, self._read_position()
        motion = None if run is None or not run.finished else run.motion
        latest = self._physical.seen(self._latest())
        if motion is None or latest is None or latest.state is not MotorState.ENABLED:
            return position
        holds = motion.variable is ControlVariable.POSITION and not motion.final_velocity
        is_there = abs(position - motion.target) <= self.model.start_tolerance
        return motion.target if holds and is_there else position

    def _read_torque(self) -> float:
        """Return the measured torque [N·m], for a linear motor the force [N]."""
        return self.__present(self.__measure().torque, "torque")

    def _read_following_error(self) -> float:
        """Return demand minus actual position [U]."""
        return self.__present(self.__measure().following_error, "the following error")

    def _position_source(self) -> str:
        """Return the origin of the position in `_latest`, in words ("6064h in TPDO 1, 181h")."""
        return "position as heard"

    def _refresh(self) -> float | None:
        """Refresh the data that `_latest` and `_is_done` evaluate: ask a drive that must be asked.

        Returns:
            The polling interval during a wait [s]; None if the hardware reports changes itself. By
            default, None if `physical.news` counts them, else 10 ms.
        """
        return LOOK_PERIOD_S if self._physical.news is None else None

    # ---- fault, reference ----

    def _reset_fault(self) -> None:
        """Acknowledge and clear the fault (else DeviceFault); the power stage is off afterwards."""
        raise UnsupportedError(motor=self.name, feature="clearing a fault")

    def _home(self, method: int | None) -> None:
        """Begin homing by `method` (CiA 402 numbers; None: the default of the hardware).

        `_is_done` reports its end. An unknown method is an `UnsupportedError`.
        """
        raise UnsupportedError(motor=self.name, feature="homing")

    # ---- motion, in the order _arm, Trigger.fire, _confirm ----

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        """Prepare `motion` in the hardware and confirm it, without any movement.

        Transmit every setting that differs from that of the hardware: mode, profile, target. The
        settings transmitted earlier are valid only while `self._physical.token` is unchanged.

        Args:
            motion: absolute and within the limits; this hook applies the rounding of the hardware.
            together: True if one trigger is to start several motors, so that the shared one of
                `SyncOffer.group` is needed; else any kind of start is acceptable.

        Returns:
            The trigger of the motion, the same (or an equal one) for all motors of a group. By
            default, `_command` is the trigger.
        """
        return CommandTrigger(lambda: self._command(motion))

    def _disarm(self) -> None:
        """Cancel what `_arm` prepared and no trigger has started yet.

        Also called after an `_arm`, a `Trigger.fire` or a `_confirm` that raised.
        """

    def _confirm(self, motion: Motion) -> None:
        """Wait, with an own deadline, until the hardware has acknowledged the start."""

    def _is_done(self) -> bool:
        """Return True if the last command (motion, homing, stop, halt, quick stop) has ended.

        A position motion ends at the target, a velocity set-point when reached, homing when
        attained, and any kind of stop at rest. The result is False from `_arm` (or the command) on
        until the hardware has reported the end *after* it: earlier reports do not count. Called
        inside waits and callbacks: must neither wait nor send.

        Raises:
            DeviceFault: the drive reports a fault.
            LinkError: the drive no longer responds, or the bus is gone.
            MotionInterrupted: the hardware ended the motion (power off, another master).
            PeerError: homing failed.

        Also called for a motor that this process has not commanded, after a `_stop`. By default,
        the end is found from `_latest`: at the target and at rest for 50 ms, within the tolerance
        of the model; after the duration of a trajectory; for a velocity, within 2 % of the maximum.
        A drive that reports the end itself has a hook for it.
        """
        self.__check_heard()
        run, latest = self._physical.run, self._latest()
        if latest is None:
            return run is None
        self._check_fault()
        began_ns = None if run is None or run.is_over or run.motion is None else run.since_ns
        is_off = latest.state is MotorState.DISABLED
        if is_off and began_ns is not None and latest.time_ns > began_ns:
            raise MotionInterrupted(motor=self.name, by="the drive, now off", at_ns=latest.time_ns)
        return self.__end.is_over(run, latest)

    def _stop_with_others(self) -> Trigger | None:
        """Do as `_stop`, for several motors that slow down at the same instant.

        Send, do not wait, as in `_stop`; the same holds for `fire` of the trigger.

        Returns:
            The trigger of the stop, equal for all motors that share one signal; None: already
            stopping.
        """
        self._stop()
        return None

    def _quick_stop(self) -> None:
        """Stop by the quick stop of the drive; state STOPPED until enabled again.

        By default, the stop is that of `_stop`, and this process refuses motions until then.
        """
        latest = self._latest()
        if latest is not None and latest.state is MotorState.ENABLED:
            self._physical.is_quick_stopped = True
        self._stop()

    def _halt(self) -> None:
        """Do as `_stop`, by the halt of the drive; the next start clears the halt."""
        self._stop()

    def _motion_times(self) -> MotionTimes | None:
        """Return begin and end of the last motion as reported by the hardware, or None."""
        return None

    # ---- direct hardware access ----

    def _open_low_level(self) -> Any:  # an adaptation names its class
        """Return the hardware object for exclusive use by the application.

        Called in a transaction, at rest and without readers. The own activity of the hardware
        object (a stream, a servo, a poll) must have ended on return, or StateError is raised. The
        object begins nothing itself, and refuses other threads, while `self._physical.access` is
        set. A connection is not required.
        """
        raise UnsupportedError(motor=self.name, feature="low-level access")

    def _close_low_level(self) -> None:
        """Discard all knowledge of the hardware; the next `_connect` reads it again.

        Must neither wait nor send.
        """

    # ---- for adaptations and for the defaults above ----

    def _check_fault(self) -> None:
        """Raise the last fault received as a DeviceFault, if there is one; do not override."""
        fault = self._latest_fault()
        if fault is not None:
            raise fault.as_error(self.name)

    def __check_heard(self) -> None:
        check = self._physical.check_heard
        if check is not None:
            check()

    def __measure(self) -> Measurement:
        """Return the present measurement, for the defaults of readings."""
        self._refresh()
        self.__check_heard()
        latest = self._latest()
        if latest is None:
            raise LinkError(link=self._physical.label, reason=f"{self.name} was not heard yet")
        return latest

    def __present(self, value: float | None, what: str) -> float:
        if value is None:
            raise UnsupportedError(motor=self.name, feature=f"measuring {what}")
        return value
