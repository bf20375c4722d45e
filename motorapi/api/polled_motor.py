"""The logical motor of a polled drive with registers.

The drive makes its profiles itself, and sends nothing without a request. This module follows its
status while a motion is active.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, final

from motorhil.motorapi.api.line_exchanges import is_silence
from motorhil.motorapi.api.polled_hardware import Poll, PolledHardware, Wanted
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    LimitError,
    LinkError,
    MotionInterrupted,
)
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel

POLL_S: Final = 0.01
_POLLS_MAX: Final = 2
_TIMEOUTS: Final = 4  # of a request: a poll with repeated ones that takes longer is too old
_BEGIN_NS: Final = 100_000_000  # for which a drive may show an old status
_RESTS: Final = 2  # the values of one poll are not simultaneous
_SLOW_TURNS_S: Final = 1 / 20  # of the motor: at rest, by the drive's integer rpm
_STILL_TURNS: Final = 1 / 500  # or it stays within that distance ...
_STILL_NS: Final = 50_000_000  # ... for that time, as some drives measure speed coarsely
_SUPPORTED: Final = (ControlVariable.POSITION, ControlVariable.VELOCITY)

HardwareT = TypeVar("HardwareT", bound=PolledHardware[Any])


@final
class _PolledTrigger(Generic[HardwareT]):
    """A trigger that starts one drive."""

    def __init__(self, motor: "PolledMotor[HardwareT]") -> None:
        self._motor = motor

    def fire(self) -> None:
        """Start the motion; the drive acknowledges it."""
        self._motor.fire()


class PolledMotor(Motor, Generic[HardwareT]):
    """The logical motor of a polled drive; each adaptation derives a class of its own name.

    Args:
        hardware: the hardware object of the drive.
        model: the constants of the motor.
        name: the name in messages and records. None: the model's name and the place.
        on_close: called once, when the motor is closed.

    Attributes:
        hardware: the hardware object of the drive.
    """

    def __init__(
        self,
        hardware: HardwareT,
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
        return variable in _SUPPORTED

    def _sync_offer(self) -> SyncOffer:
        hardware = self.hardware
        reason = "its line carries one request at a time: it is started by its own request"
        firing, unbounded = hardware.registers.line.start_bound(has_answer=True)
        if not hardware.STARTS_AT_ONCE:
            firing, unbounded = None, "a start may take several requests"
        return SyncOffer(
            SyncLevel.SEQUENTIAL,
            hardware.label,
            None,
            reason,
            firing,
            no_firing_bound=unbounded,
            no_start_bound="the drive's own cycle is not known",
            no_end_bound="the drive's own clock is not known",
        )

    def _quantise(self, motion: Motion) -> Motion:
        return self.hardware.quantised(motion, self.model)

    # --- connecting, state and measurements -------------------------------------------------

    def _connect(self) -> None:
        if self.hardware.is_closed:
            label = self.hardware.label
            raise LinkError(link=label, reason="this hardware object is closed")
        self.hardware.connect(self.model)

    def _poll(self) -> Poll:
        """Read the present status, for all logical motors on the drive."""
        poll = self._read_together()
        state = self.hardware.progress
        state.poll = state.last = poll
        rests = poll.has_arrived or poll.state is MotorState.DISABLED
        state.rests = state.rests + 1 if rests else 0
        still = _STILL_TURNS * self.hardware.turn(self.model)
        if state.anchor is None or abs(poll.position - state.anchor.position) > still:
            state.anchor = poll
        news = self._physical.news
        if news is not None:
            news.grow()
        return poll

    def _read_together(self) -> Poll:
        """Return values that are of one time; repeat a poll in which requests were repeated."""
        registers = self.hardware.registers
        longest_s = _TIMEOUTS * registers.timeout_s
        for _ in range(_POLLS_MAX):
            begun_ns, before = self.runtime.now_ns(), registers.repeats
            poll = self.hardware.poll(self.model)
            took_s = (self.runtime.now_ns() - begun_ns) / 1e9
            if took_s <= longest_s or registers.repeats == before:
                return poll
        raise DeadlineExceeded(
            awaited=f"{self.name}: a poll of its status, with few lost requests",
            timeout_s=longest_s,
            last_heard=f"the last answer, {took_s:.2f} s after the poll began",
        )

    def _read_state(self) -> MotorState:
        try:
            return self._poll().state
        except Exception as error:
            if is_silence(error):
                return MotorState.OFFLINE
            raise

    def _read_fault(self) -> Fault | None:
        return self._poll().fault

    def _read_referenced(self) -> bool:
        return self.hardware.is_referenced

    def _read_reference(self) -> float:
        poll, told = self._poll(), self.hardware.progress
        if poll.state is not MotorState.ENABLED:
            return poll.position
        if told.wanted is Wanted.ARRIVAL and told.target is not None and self._is_near(poll):
            return told.target  # the held target as commanded: rounding must not accumulate
        return poll.demand

    def _latest(self) -> Measurement | None:
        poll = self.hardware.progress.last
        if poll is None:
            return None
        error = poll.demand - poll.position
        return Measurement(poll.time_ns, poll.state, poll.position, poll.velocity, None, error)

    def _refresh(self) -> float | None:
        self._poll()
        return POLL_S

    # --- power, fault, reference ------------------------------------------------------------

    def _enable(self) -> None:
        self.hardware.enable()

    def _disable(self) -> None:
        self.hardware.disable()
        self.hardware.progress.wanted = None

    def _reset_fault(self) -> None:
        self.hardware.reset_fault()
        poll = self._poll()
        self._raise_fault(poll)

    def _raise_fault(self, poll: Poll) -> None:
        fault = poll.fault
        if fault is not None:
            raise fault.as_error(self.name)

    def _home(self, method: int | None) -> None:
        self.hardware.home(method, self.name)
        self._begun(Wanted.ARRIVAL)

    # --- motion -----------------------------------------------------------------------------

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        self._apply_parameters()
        if motion.variable is ControlVariable.POSITION and not together:
            # A slow member of a group may be early instead: the group tells how much.
            self.hardware.require_speed(motion, self.name, self.model)
        try:
            self.hardware.prepare(motion, self.model)
        except LimitError as error:
            raise self.hardware.in_units(error, self.name, self.model) from None
        state = self.hardware.progress
        moves = motion.variable is ControlVariable.POSITION
        state.armed = Wanted.ARRIVAL if moves else Wanted.VELOCITY
        rounded = motion if moves else self.hardware.quantised(motion, self.model)
        state.armed_at = rounded.target  # of a velocity, what the drive can make of almost 0
        before = 0.0 if state.poll is None else state.poll.velocity
        state.armed_s = 0.0 if moves else _ramp_s(motion, before)
        return _PolledTrigger(self)

    def _apply_parameters(self) -> None:
        """Bring the drive's tunable values to those of this motor; a make overrides it."""

    @final
    def fire(self) -> None:
        """Start the armed motion; for its trigger."""
        self.hardware.trigger()
        self.fired()

    @final
    def fired(self) -> None:
        """Note that the armed motion was started; for a trigger shared with others."""
        state = self.hardware.progress
        self._begun(state.armed, state.armed_at, state.armed_s)

    def _begun(self, wanted: Wanted, target: float | None = None, least_s: float = 0.0) -> None:
        state = self.hardware.progress
        state.wanted = wanted
        state.target = target
        state.rests = 0
        state.anchor = None
        registers = self.hardware.registers
        state.started_ns = self.runtime.now_ns()
        state.latched_ns = registers.line.started_ns.pop(registers.unit, None)
        state.least_ns = state.started_ns + round(least_s * 1e9)
        state.ended_ns = None
        state.poll = None

    def _confirm(self, motion: Motion) -> None:
        self._poll()

    def _is_done(self) -> bool:
        state = self.hardware.progress
        poll = state.poll
        if self.hardware.is_closed:
            raise LinkError(link=self.hardware.label, reason="this hardware object is closed")
        if poll is None:
            return state.wanted is None
        self._raise_fault(poll)
        self._refuse_interrupted(poll)
        done = {
            None: True,
            Wanted.ARRIVAL: poll.has_arrived and not self._is_short(poll),
            Wanted.VELOCITY: poll.at_velocity
            and poll.time_ns >= state.least_ns
            and not self._is_short(poll),
            Wanted.REST: not poll.is_moving and self._is_still(poll),
        }[state.wanted]
        if done and state.ended_ns is None:
            state.ended_ns = poll.time_ns
        return done

    def _is_still(self, poll: Poll) -> bool:
        """Return whether the motor itself rests; without current it coasts."""
        if abs(poll.velocity) <= _SLOW_TURNS_S * self.hardware.turn(self.model):
            return True
        anchor = self.hardware.progress.anchor
        return anchor is not None and poll.time_ns - anchor.time_ns >= _STILL_NS

    def _is_short(self, poll: Poll) -> bool:
        """Return whether the drive rests elsewhere than commanded, or at another velocity."""
        state = self.hardware.progress
        if not poll.has_arrived or state.target is None:
            return False
        return state.target != 0.0 if state.wanted is Wanted.VELOCITY else not self._is_near(poll)

    def _is_near(self, poll: Poll) -> bool:
        target, hardware = self.hardware.progress.target, self.hardware
        near = hardware.NEAR_TURNS * hardware.turn(self.model)
        return target is not None and abs(poll.demand - target) <= near

    def _refuse_interrupted(self, poll: Poll) -> None:
        """Raise MotionInterrupted if the drive or another program has ended the motion."""
        state = self.hardware.progress
        began_ns = poll.time_ns if state.started_ns is None else state.started_ns
        moves = state.wanted in (Wanted.ARRIVAL, Wanted.VELOCITY)
        if not moves or poll.time_ns - began_ns < _BEGIN_NS or state.rests < _RESTS:
            return
        if poll.state is MotorState.DISABLED:
            by = "another program, or the drive, which is disabled now"
        elif self._is_short(poll):
            by = f"another program, or an input of the drive: it rests at {poll.demand:g}"
        else:
            return
        raise MotionInterrupted(motor=self.name, by=by, at_ns=poll.time_ns)

    def _stop(self) -> None:
        self._begun(Wanted.REST)
        self.hardware.post_stop(quick=False)

    def _quick_stop(self) -> None:
        self._begun(Wanted.REST)
        self.hardware.post_stop(quick=True)

    def _open_low_level(self) -> HardwareT:
        return self.hardware

    def _close_low_level(self) -> None:
        self.hardware.forget()

    def _motion_times(self) -> MotionTimes | None:
        state = self.hardware.progress
        if state.started_ns is None:
            return None
        source = f"its trigger acknowledged; its status as polled every {POLL_S * 1e3:g} ms"
        return MotionTimes(state.started_ns, state.ended_ns, source, state.latched_ns)


def _ramp_s(motion: Motion, before: float) -> float:
    """Return the duration of a change of velocity, as the drive's window may be wide."""
    if motion.duration_s is not None:
        return motion.duration_s
    turns = before * motion.target < 0.0
    slower = abs(before) if turns else max(0.0, abs(before) - abs(motion.target))
    faster = abs(motion.target) if turns else max(0.0, abs(motion.target) - abs(before))
    return slower / motion.deceleration + faster / motion.acceleration
