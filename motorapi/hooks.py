"""What a vendor fills in: the protected hooks of a motor, on one page.

An adaptation derives from `motorapi.motor.Motor`, contains a hardware object, and fills these in.
All are in SI units and signed as the motor model says; increments stay inside the hardware object.
Unless a hook says otherwise it may wait, through `self.runtime` only, and raises the errors of
`motorapi.errors`; anything else it raises reaches the caller as a `PluginError`. The public methods
have checked modes, limits and state before they call a hook, and see to it that no two hooks that
act run at once on one physical motor (`_stop`, `_stop_with_others`, `_quick_stop` and `_halt`
excepted). U stands for the motor's unit of position: rad, or m for a linear motor.

The hardware object is the adaptation's own. What is expected of it:

- There is one for a physical motor and process. `motorapi.sharing.register_physical_motor` gives it
  the record that the motor is built with (`physical`); `release_physical_motor` ends that.
- Where other programs can open the same bus (`motorapi.process_lock.can_share_time`, and a name by
  `motorapi.lock_names`), it registers with a `ProcessLock` of that name and its node. Then whatever
  may start or change a motion or a setting goes out between `begin_write` and `end_write` of
  `physical.ownership`, as `motorapi.fencing` says, and never after they raised; on CAN `NodeFence`
  does it, and `announce` tells a hub. Stops go out without. A question that takes several frames
  needs a lock of its own, so that no other program's answer is taken for its own.
- What it does by itself (a stream, a servo) goes on under the ownership it began under, and no
  other: `NodeFence.bound`.
- If it hears of every change of what `_is_done` looks at, `physical.news` counts them. If it must
  ask, `_refresh` says how often.
- On CAN it tells what it sends and its drive sends, by `motorapi.traffic.note_node` and
  `note_stream`, or bounds on the skew of others on that bus are wrong.

A motor that was left moving, by a process that died or by one it was taken over from, is brought to
rest by `_stop`, `_refresh` and `_is_done` before its next owner commands it.
"""

from abc import ABC, abstractmethod
from typing import final

from motorapi.commands import ControlMode, ControlVariable, Motion, Setpoint
from motorapi.device import Device
from motorapi.errors import UnsupportedError
from motorapi.model import MotorModel
from motorapi.runtime import Runtime
from motorapi.sharing import PhysicalMotor
from motorapi.state import Fault, Measurement, MotorState
from motorapi.synchronization import MotionTimes, SyncOffer, Trigger
from motorapi.trajectory import ComplexTrajectory, Trajectory


class MotorHooks(Device, ABC):
    """The vendor's side of a motor; the application's side is `motorapi.motor.Motor`.

    Args:
        name: what messages and records call it.
        model: what is constant of the motor, shared between copies.
        runtime: where it waits.
        physical: the record its hardware object got from `register_physical_motor`.
    """

    def __init__(
        self, *, name: str, model: MotorModel, runtime: Runtime, physical: PhysicalMotor
    ) -> None:
        super().__init__(name, runtime)
        self._model = model
        self._physical = physical

    @property
    @final
    def model(self) -> MotorModel:
        """What is constant of this motor."""
        return self._model

    # ---- what the hardware can do: answered at once, without the wire ----

    @abstractmethod
    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        """Whether this motor can be commanded so."""

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        """This motor can execute the command (a mode and variable it supports) where it can at all.

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

    @abstractmethod
    def _sync_offer(self) -> SyncOffer:
        """What it offers for starting together with others, as it is configured now.

        This and `_quantise` are called after `_connect`.
        """

    @abstractmethod
    def _quantise(self, motion: Motion) -> Motion:
        """`motion` as the hardware will really make it, after rounding to its own units.

        Target, velocity, acceleration and deceleration may differ from what was asked by one step
        of the hardware; velocities and accelerations are rounded down, so that no limit is
        exceeded (but not to 0). What is rounded already stays as it is. The common duration of a
        group, and its end skew, are predicted from it. A motion with a `function` keeps it.
        """

    # ---- connecting, state and measurements ----

    def _connect(self) -> None:
        """The hardware answers and is configured: booted, PDOs mapped, dead-man set up.

        Called at the beginning of every public operation that needs the wire (but of `state` and
        `fault`), so it is cheap when there is nothing to do. Two parties may call it at once: the
        second waits for the first. Also called for who only reads: what it writes it may write
        inside `physical.ownership.owned_to_set_up` only, if other programs can be on the bus.
        """

    @abstractmethod
    def _read_state(self) -> MotorState:
        """The state; does not wait if the hardware reports it by itself. A fault is no error.

        OFFLINE if it is not heard. This and `_read_fault` may be called before any `_connect`.
        """

    @abstractmethod
    def _read_fault(self) -> Fault | None:
        """The fault the drive reports, None if there is none."""

    @abstractmethod
    def _read_referenced(self) -> bool:
        """Whether position 0 is where the model means it to be (homed since power-on)."""

    @abstractmethod
    def _read_position(self) -> float:
        """Measured position [U]."""

    @abstractmethod
    def _read_velocity(self) -> float:
        """Measured velocity [U/s]."""

    @abstractmethod
    def _read_reference(self) -> float:
        """The position the controller holds or moves through now [U]: the demand.

        With the power stage off, the measured position. Relative motions are counted from here, so
        that errors of the servo do not add up.
        """

    def _read_torque(self) -> float:
        """Measured torque [N·m], of a linear motor force [N]."""
        raise UnsupportedError(motor=self.name, feature="measuring torque")

    def _read_following_error(self) -> float:
        """Demand minus actual position [U]."""
        raise UnsupportedError(motor=self.name, feature="measuring the following error")

    def _latest(self) -> Measurement | None:
        """What was heard last. Must neither wait nor send: recorders ask from callbacks."""
        return None

    def _position_source(self) -> str:
        """Where the position in `_latest` was measured, in words ("6064h in TPDO 1, 181h")."""
        return "position as heard"

    def _refresh(self) -> float | None:
        """What `_is_done` looks at is fresh.

        Returns:
            After how long to call again while waiting [s]; None if the hardware reports by itself.
        """
        return None

    # ---- power, fault, reference ----

    @abstractmethod
    def _enable(self) -> None:
        """The power stage is on and the motor holds its position, without having moved."""

    @abstractmethod
    def _disable(self) -> None:
        """The power stage is off."""

    @abstractmethod
    def _reset_fault(self) -> None:
        """The fault is acknowledged and gone (else DeviceFault); the power stage is off."""

    @abstractmethod
    def _home(self, method: int | None) -> None:
        """Homing by `method` (CiA 402 numbering; None: the hardware's default) has begun.

        `_is_done` tells when it is over. An unknown method is an `UnsupportedError`.
        """

    # ---- motion. Called in the order _arm, Trigger.fire, _confirm. ----

    @abstractmethod
    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        """All that `motion` needs is in the hardware, confirmed, and nothing has moved yet.

        Every setting that differs from what the hardware holds was pushed: mode, profile, target.
        What the hardware was told is trusted only while `self._physical.token` is unchanged.

        Args:
            motion: absolute and within the limits; the hardware's rounding is up to this hook.
            together: whether one trigger is to start several motors, so that the shared one of
                `SyncOffer.group` is needed; else any way of starting will do.

        Returns:
            What starts the motion. The same (or an equal one) for all motors of one group.
        """

    @abstractmethod
    def _disarm(self) -> None:
        """What `_arm` prepared and nothing has started yet will not start any more.

        Also called after an `_arm`, a `Trigger.fire` or a `_confirm` that raised.
        """

    @abstractmethod
    def _confirm(self, motion: Motion) -> None:
        """The hardware has acknowledged the start (waits for it, with a deadline of its own)."""

    @abstractmethod
    def _is_done(self) -> bool:
        """Whether what was commanded last (motion, homing, stop, halt, quick stop) is over.

        A position motion: at the target; a velocity set-point: reached; homing: attained; any way
        of stopping: at rest. False from `_arm` (or the command) on until the hardware has shown
        otherwise *after* it: what it said of the motion before does not count. Called from inside
        waits and callbacks: must neither wait nor send.

        Raises:
            DeviceFault: the drive reports a fault.
            LinkError: the drive is no longer heard, or the bus is gone.
            MotionInterrupted: the hardware ended the motion (power off, another master).
            PeerError: homing failed.

        Also asked of a motor that nobody of this process has commanded, after a `_stop`.
        """

    @abstractmethod
    def _stop(self) -> None:
        """The motor slows down at the motion's deceleration, then holds; what it did is over.

        This and the two below are called without a transaction, possibly from a callback and while
        another party is inside another hook of this motor: send, do not wait.
        """

    def _stop_with_others(self) -> Trigger | None:
        """As `_stop`, of several motors that are to slow down at the same instant.

        As it: send, do not wait. So must `fire` of the trigger.

        Returns:
            What makes it slow down, equal for all that share one signal; None: it does already.
        """
        self._stop()
        return None

    @abstractmethod
    def _quick_stop(self) -> None:
        """The motor stops as the drive's quick stop does; state STOPPED, until enabled again."""

    def _halt(self) -> None:
        """The motor stops as the drive's halt does, then holds; the next start lifts the halt."""
        self._stop()

    def _motion_times(self) -> MotionTimes | None:
        """When the last motion began and ended, as the hardware told; None if it cannot tell."""
        return None

    # ---- the hardware itself ----

    def _open_low_level(self) -> object:
        """The hardware object, for the application alone.

        Called in a transaction, with nothing going on and nobody reading. What the hardware object
        does by itself (a stream, a servo, a poll) has ended when this returns, or StateError; it
        begins nothing by itself, and refuses other threads, while `self._physical.access` is set.
        It need not be connected.
        """
        raise UnsupportedError(motor=self.name, feature="low-level access")

    def _close_low_level(self) -> None:
        """Nothing is believed of the hardware any more; the next `_connect` finds out anew.

        Must neither wait nor send.
        """
