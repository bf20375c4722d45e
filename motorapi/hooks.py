"""Hooks of a motor: the protected methods that a vendor implements.

An adaptation derives from `motorhil.motorapi.motor.Motor`, contains a hardware object, and
implements these hooks. All values are in SI units with the sign of the motor model; increments stay
inside the hardware object. Unless its documentation says otherwise, a hook may wait, through
`self.runtime` only. Hooks raise the errors of `motorhil.motorapi.errors`; any other exception
reaches the caller as a `PluginError`. The public methods check modes, limits and state before they
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
  If it must poll, `_refresh` returns the interval.
- On CAN it declares the frames that it and its drive send, with
  `motorhil.motorapi.synchronization.bus_load.note_node` and `note_stream`. Otherwise skew bounds of
  others on that bus are wrong.

An adaptation may use any private name except those of the hooks and `_physical`. The interface
keeps its own state under names of another form.

A motor may be left moving, by a process that died or lost the motor to a takeover. Such a motor is
brought to rest by `_stop`, `_refresh` and `_is_done` before its next owner commands it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol, final

from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.device import Device
from motorhil.motorapi.errors import DeadlineExceeded, MotorError, PluginError, UnsupportedError
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes
from motorhil.motorapi.trajectory import ComplexTrajectory, Trajectory, has_moving_ends


class ArmHook(Protocol):
    """The type of `MotorHooks._arm`."""

    def __call__(self, motion: Motion, *, together: bool) -> Trigger:
        """See `MotorHooks._arm`."""


@final
@dataclass(frozen=True, slots=True)
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
        return cls(type(motor).__qualname__, *(_guarded(motor, f"_{name}") for name in names[1:]))

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


class MotorHooks(Device, ABC):
    """The vendor's side of a motor; the application's side is `motorhil.motorapi.motor.Motor`."""

    def __init__(
        self, *, name: str, model: MotorModel, runtime: Runtime, physical: PhysicalMotor
    ) -> None:
        super().__init__(name, runtime)
        self.__model = model
        self._physical = physical

    @property
    @final
    def model(self) -> MotorModel:
        """The constant properties of this motor."""
        return self.__model

    # ---- capabilities of the hardware: answered at once, without the bus ----

    @abstractmethod
    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        """Return True if this motor supports commands of this mode and variable."""

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        """Check that this motor can execute a command of a supported mode and variable at all.

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

    def _limits_jerk(self, variable: ControlVariable) -> bool:
        """Return True if simple trajectories of `variable` get the model's jerk limit by default.

        They are then motions with a `function`. Otherwise only a limit of the command is met.
        """
        return False

    @abstractmethod
    def _sync_offer(self) -> SyncOffer:
        """Return the capability for starts together with others, as configured now.

        This hook and `_quantise` are called after `_connect`.
        """

    @abstractmethod
    def _quantise(self, motion: Motion) -> Motion:
        """Return `motion` as the hardware executes it, rounded to its own units.

        Target, velocity, acceleration and deceleration may differ from the request by one step of
        the hardware. Velocities and accelerations are rounded down, so that no limit is exceeded
        (but not to 0). A rounded motion stays unchanged. The common duration of a group, and its
        end skew, are predicted from the result. A motion with a `function` keeps it.
        """

    # ---- connection, state and measurements ----

    def _connect(self) -> None:
        """Ensure that the hardware answers and is configured: booted, PDOs mapped, dead-man active.

        Called at the beginning of every public operation that needs the bus (except `state` and
        `fault`), so it must be cheap if nothing is to be done. Two threads may call it at once: the
        second waits for the first. Also called for read access: if other programs can be on the
        bus, it may write only inside `physical.ownership.owned_to_set_up`.
        """

    @abstractmethod
    def _read_state(self) -> MotorState:
        """Return the state, without waiting if the hardware reports it. A fault is not an error.

        OFFLINE if the motor does not respond. This hook and `_read_fault` may be called before any
        `_connect`.
        """

    @abstractmethod
    def _read_fault(self) -> Fault | None:
        """Return the fault that the drive reports, or None."""

    @abstractmethod
    def _read_referenced(self) -> bool:
        """Return True if position 0 is that of the model (homed since power-on)."""

    @abstractmethod
    def _read_position(self) -> float:
        """Return the measured position [U]."""

    @abstractmethod
    def _read_velocity(self) -> float:
        """Return the measured velocity [U/s]."""

    @abstractmethod
    def _read_reference(self) -> float:
        """Return the position that the controller holds or passes now [U]: the demand.

        With the power stage off, the measured position; so, too, in the motion of a set-point that
        the hardware makes without a profile: its demand is the target at once. Relative motions
        start from here, so that servo errors do not accumulate.
        """

    def _read_torque(self) -> float:
        """Return the measured torque [N·m], for a linear motor the force [N]."""
        raise UnsupportedError(motor=self.name, feature="measuring torque")

    def _read_following_error(self) -> float:
        """Return demand minus actual position [U]."""
        raise UnsupportedError(motor=self.name, feature="measuring the following error")

    def _latest(self) -> Measurement | None:
        """Return the last measurement, in callbacks of recorders: must neither wait nor send."""
        return None

    def _position_source(self) -> str:
        """Return the origin of the position in `_latest`, in words ("6064h in TPDO 1, 181h")."""
        return "position as heard"

    def _refresh(self) -> float | None:
        """Refresh the data that `_is_done` evaluates.

        Returns:
            The polling interval during a wait [s]; None if the hardware reports changes itself.
        """
        return None

    # ---- power, fault, reference ----

    @abstractmethod
    def _enable(self) -> None:
        """Switch on the power stage; the motor holds its position and does not move."""

    @abstractmethod
    def _disable(self) -> None:
        """Switch off the power stage."""

    @abstractmethod
    def _reset_fault(self) -> None:
        """Acknowledge and clear the fault (else DeviceFault); the power stage is off afterwards."""

    @abstractmethod
    def _home(self, method: int | None) -> None:
        """Begin homing by `method` (CiA 402 numbers; None: the default of the hardware).

        `_is_done` reports its end. An unknown method is an `UnsupportedError`.
        """

    # ---- motion, in the order _arm, Trigger.fire, _confirm ----

    @abstractmethod
    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        """Prepare `motion` in the hardware and confirm it, without any movement.

        Transmit every setting that differs from that of the hardware: mode, profile, target. The
        settings transmitted earlier are valid only while `self._physical.token` is unchanged.

        Args:
            motion: absolute and within the limits; this hook applies the rounding of the hardware.
            together: True if one trigger is to start several motors, so that the shared one of
                `SyncOffer.group` is needed; else any kind of start is acceptable.

        Returns:
            The trigger of the motion, the same (or an equal one) for all motors of a group.
        """

    @abstractmethod
    def _disarm(self) -> None:
        """Cancel what `_arm` prepared and no trigger has started yet.

        Also called after an `_arm`, a `Trigger.fire` or a `_confirm` that raised.
        """

    @abstractmethod
    def _confirm(self, motion: Motion) -> None:
        """Wait, with an own deadline, until the hardware has acknowledged the start."""

    @abstractmethod
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

        Also called for a motor that this process has not commanded, after a `_stop`.
        """

    @abstractmethod
    def _stop(self) -> None:
        """Slow down at the deceleration of the motion, then hold; the motion ends.

        This hook and the next two are called without a transaction, possibly from a callback and
        while another thread is inside another hook of this motor: send, do not wait.
        """

    def _stop_with_others(self) -> Trigger | None:
        """Do as `_stop`, for several motors that slow down at the same instant.

        Send, do not wait, as in `_stop`; the same holds for `fire` of the trigger.

        Returns:
            The trigger of the stop, equal for all motors that share one signal; None: already
            stopping.
        """
        self._stop()
        return None

    @abstractmethod
    def _quick_stop(self) -> None:
        """Stop by the quick stop of the drive; state STOPPED until enabled again."""

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
