"""Streaming of set-points in cyclic synchronous position mode, one per SYNC.

Set-points are increments. Cycle k is k set-point periods after the start. A period in which the
host sends no SYNC does not count, so that set-points are never two steps apart. A trajectory over
time is sampled at these times; another argument is read in each cycle. A velocity trajectory is
followed by its integral: exactly over time, by the trapezoidal rule over another argument.

Another argument is not predictable. So its set-points are checked against the limits one by one:
- no step of position beyond the velocity limit;
- at the start, where the motor is at rest, no step of velocity beyond the acceleration limit times
  a period;
- later, no change of the velocity over 20 ms beyond that limit, as an argument received over a bus
  may be a period late.
A set-point that exceeds them raises LimitError, and is not sent.

An absolute trajectory may begin a little beside the motor's position
(`MotorModel.start_tolerance`). A step there in one period would violate every limit, so the motor
first moves there, within the limits: `lead_in` cycles before the first one of the trajectory.
"""

import struct
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext, suppress
from math import ceil
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
from motorhil.motorapi.adaptations.cia402.objects import ENABLE_OPERATION, HALT, Mode, PdsState
from motorhil.motorapi.adaptations.cia402.units import DriveUnits
from motorhil.motorapi.commands import ControlVariable, as_number
from motorhil.motorapi.errors import (
    LimitError,
    LinkError,
    MotorBusyError,
    MotorError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.generation import Trapezoid, shortest
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning.sampling import demand_of, way_of
from motorhil.motorapi.runtime.can_link import Transmission
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage, note_stream
from motorhil.motorapi.trajectory import value_of

if TYPE_CHECKING:
    from motorhil.motorapi.ownership.fencing import BoundFence, Fence
    from motorhil.motorapi.runtime.api import Registration
    from motorhil.motorapi.runtime.can_link import CanLink

_SETPOINT: Final = struct.Struct("<IB3xHi2x")
_HALF: Final = 0x8000_0000
_SPAN: Final = 0x1_0000_0000
_DEAF_NS: Final = 250_000_000
"""The time [ns] without movement after which a drive does not follow its moving set-points."""
_STUCK_NS: Final = 1_000_000_000
"""The time [ns] after which less suffices: slow set-points take long to get far ahead."""
_FAR: Final = 10
_STIRS: Final = 8
"""A drive that makes less than this part of its set-points' way only oscillates."""
_LAST_WORDS: Final = 2  # set-points that bring a stop, in case one is lost


@final
class CspStream:
    """A stream of set-points in csp (CiA 402-2, cyclic synchronous position mode), one per SYNC.

    The target of cycle k is sent right after SYNC k-1 and latched by SYNC k. So the frames of a
    cycle have a whole period to pass the bus. Cycle 0 is the position the drive holds now. The
    drive's demand reaches the target of cycle k one period after SYNC k, at constant velocity.

    Args:
        control: the controls of the drive, which has been brought up.
        period_s: the period of SYNC: integer milliseconds.
        next_target: (cycle, from 1) -> target in increments, or None at the end of the stream.
        began: called with the time [ns] when SYNC 1 was on the wire.
        lost: called with the error when the cyclic SYNC is lost.
        at_once: False: nothing is sent before `begin`.
        behind_inc: the distance in increments that the set-points may move while the drive stands
            still. Beyond it the drive does not follow, and is reported as lost. After a second, a
            tenth of it suffices. None: no check.

    Attributes:
        sent: the number of set-points sent.
        late: the number of set-points that still waited for the bus when their SYNC was sent.
        missed: the number of periods without a SYNC because its producer was late. They prolong the
            motion.
        ended: whether the last target has been latched.
        error: the exception that `next_target` raised; the drive is then halted by its own ramp. Or
            the error that another program has taken the drive over; then nothing more is sent to
            it.
        started_ns: the time when SYNC 1 was on the wire, the first to latch a target of
            `next_target`.
        latched_ns: the time when the SYNC after the last target was on the wire.
    """

    def __init__(
        self,
        control: DriveControl,
        period_s: float,
        next_target: Callable[[int], int | None],
        *,
        began: Callable[[int], None] | None = None,
        lost: Callable[[LinkError], None] | None = None,
        at_once: bool = True,
        behind_inc: int | None = None,
    ) -> None:
        facts = control.facts
        can_id = None if facts is None else facts.latched_ids.get(0x607A)
        if can_id is None:
            raise UnsupportedError(
                motor=control.node.label,
                feature="csp streaming",
                supported="" if facts is None else "; ".join(facts.limitations),
            )
        asked_ms = as_number(period_s) * 1e3
        period_ms = round(asked_ms) if 0.5 <= asked_ms < 1e3 else 0
        if not 1 <= period_ms <= 255 or abs(period_ms / 1e3 - period_s) > 1e-9:
            raise UsageError(
                f"period_s = {period_s}: must be integer milliseconds, 1 to 255 (60C2h)"
            )
        self._control = control
        self._node = control.node
        self._link = control.node.link
        self._sync = control.node.bus.sync
        self._sync.check(period_s)
        self._next_target = next_target
        self._heir: Callable[[], Callable[[int], int | None]] | None = None
        self._zero = 0  # the cycle that is cycle 0 for `_next_target`
        self._tell_began = began
        self._tell_lost = lost
        self._can_id = can_id
        self.period_s: Final = period_s
        self._cycle = 0
        self._target = 0
        self._step = 0  # between the last two targets
        self._word = ENABLE_OPERATION
        self._words_left = _LAST_WORDS
        self._registration: Registration | None = None
        self._fence: BoundFence | None = None
        self._last_sent: Transmission | None = None
        self.sent: int = 0
        self.late: int = 0
        self.missed: int = 0
        self._begun_ns = 0
        self._before_ns = 0
        self._behind_inc = behind_inc
        self._stood = (0, 0, 0)  # position at its last change, the target then, and the time
        self.ended: bool = False
        self.error: Exception | None = None
        self.started_ns: int | None = None
        self.latched_ns: int | None = None
        self._set_up(period_ms)
        if at_once:
            self.begin()

    def _set_up(self, period_ms: int) -> None:
        objects = self._control.objects
        try:
            for subindex, value in ((1, period_ms), (2, -3)):
                if objects.read_optional(0x60C2, subindex) not in (None, value):
                    objects.push(0x60C2, value, subindex)
        except SdoAborted as error:
            raise UnsupportedError(
                motor=self._node.label,
                feature=f"a set-point every {period_ms} ms ({error})",
                supported=self._own_period(),
            ) from error
        # The target must be at the drive's position before csp uses it.
        held = objects.read_optional(0x6062)
        held = objects.read_int(0x6064) if held is None else held
        self._target = self._node.on_from(held)
        objects.write(0x607A, held)
        self._control.set_mode(Mode.CYCLIC_SYNC_POSITION)

    def _own_period(self) -> str:
        value = self._control.objects.read_optional(0x60C2, 1)
        exponent = self._control.objects.read_optional(0x60C2, 2)
        return f"one every {value} x 10^{exponent} s (60C2h)"

    def begin(self) -> None:
        """Send cycle 0 and run SYNC; streams that begin together share every SYNC."""
        if self._registration is not None or self.ended:
            return
        if self._control.fence is not None:
            self._fence = self._control.fence.bound("set-points")
        self._last_sent = self._send()
        note_stream(self._link.bus, self._can_id, PeriodicMessage(self._can_id, 6, self.period_s))
        self._registration = self._sync.join(
            self.period_s, self._after_sync, self._sync_lost, lambda: self._fence
        )

    def hand_over(
        self,
        heir: Callable[[], Callable[[int], int | None]],
        began: Callable[[int], None],
        lost: Callable[[LinkError], None],
    ) -> None:
        """Go on with the set-points of another motion, from the next cycle on.

        Args:
            heir: called then, with the last target as `target`: cycle 0 of the other motion.
                Returns its `next_target`.
            began: called with the time [ns] when the SYNC of its first set-point was on the wire.
            lost: called with the error when the cyclic SYNC is lost.
        """
        self.started_ns = self.latched_ns = None
        self._heir, self._tell_began, self._tell_lost = heir, began, lost

    def _inherit(self, heir: Callable[[], Callable[[int], int | None]]) -> None:
        """Change to the set-points of the next motion."""
        self._heir = None
        self._zero = self._cycle - 1
        self._next_target = heir()

    def _send(self) -> Transmission:
        counter = (self._target + _HALF) % _SPAN - _HALF  # 607Ah wraps as the drive's counter
        frame = _SETPOINT.pack(self._can_id, 6, self._word, counter)
        fence: Fence | None = self._fence
        if fence is not None and self._word != ENABLE_OPERATION:
            fence = self._stop_fence()
        return self._link.send_tracked(frame, fence)

    def _stop_fence(self) -> "Fence | None":
        """Return the fence for a stop: any process may stop a drive, except one that lost it."""
        fence = self._control.fence
        return fence if fence is not None and fence.is_owned else None

    def _after_sync(self) -> None:
        """Send the target of cycle k + 1, after SYNC k was queued or heard."""
        last = self._last_sent
        if self._cycle and last is not None and last.time_ns is None:
            self.late += 1
        now_ns = self._link.runtime.now_ns()
        if self._cycle == 0:
            self._begun_ns = now_ns
        elif self._cycle == self._zero + 1:
            self._sync.at_next(self._began)
        period_ns = self.period_s * 1e9
        if self._sync.is_producer:
            periods = round((now_ns - self._begun_ns) / period_ns)
            self.missed = max(self.missed, periods - self._cycle)
        elif self._cycle:  # the period of a foreign producer's clock
            self.missed += max(0, round((now_ns - self._before_ns) / period_ns) - 1)
        self._before_ns = now_ns
        self._cycle += 1
        try:
            if self._word != ENABLE_OPERATION:
                self._go_on_stopping()
                return
            if self._node.is_lost:
                self._fail()  # it may still hear us; the waiting caller gets the loss
                return
            if self._node.state is not PdsState.OPERATION_ENABLED:
                self.cancel()  # A fault or another program: the drive no longer follows.
                return
            if not self._is_followed(now_ns):
                self._sync_lost(self._not_followed())
                return
            if self._heir is not None:
                self._inherit(self._heir)
            target = self._next_target(self._cycle - self._zero)
            if target is None:
                self._sync.at_next(self._was_latched)
                self.cancel()
                return
            self._step = target - self._target
            self._target = target
            self.sent += 1
            self._last_sent = self._send()
        except LinkError as error:
            self.error = error
            self.cancel()
        except MotorBusyError as error:
            self._lose(error)
        except Exception as error:  # An error of the application is raised in the waiting call.
            self.error = error
            self._fail()

    def _is_followed(self, now_ns: int) -> bool:
        """Return whether the drive moves while its set-points do; without SYNC it does not.

        Without a TPDO, only a position that was read in the last period shows where the drive is.
        """
        position, (stood, target, since_ns) = self._node.position_inc, self._stood
        made_inc = _STIRS * abs(position - stood)  # a drive that stands still may oscillate
        if self._cycle == 1 or made_inc > abs(self._target - target) or self._target == target:
            self._stood = (position, self._target, now_ns)
            return True
        stood_ns = now_ns - since_ns
        if self._behind_inc is None or stood_ns < _DEAF_NS:
            return True
        if not self._node.status_is_cyclic and now_ns - self._node.status_ns > self.period_s * 1e9:
            return True
        behind_inc = self._behind_inc if stood_ns < _STUCK_NS else self._behind_inc // _FAR
        return abs(self._target - target) <= behind_inc

    def _not_followed(self) -> LinkError:
        if self._node.is_told or not self._node.status_is_cyclic:
            reason = "the drive stands still while its set-points move; "
            reason += "is it blocked, or without SYNC?"
        else:
            reason = "the TPDO with its status does not arrive while its set-points move"
        return LinkError(link=self._node.label, reason=reason)

    def _fail(self) -> None:
        """Halt the drive on its ramp, from its present velocity."""
        self._target += self._step
        try:
            self.stop(ENABLE_OPERATION | HALT)
        except LinkError:
            self.cancel()
        self._halt()

    def _halt(self) -> None:
        """Halt at once, by RPDO where possible, unless another program has taken the drive over."""
        fence = self._stop_fence()
        with suppress(MotorError), nullcontext() if fence is None else fence.passage():
            self._control.send_halt()

    def _sync_lost(self, error: LinkError) -> None:
        """Halt the drive, as its SYNC has no producer, or two."""
        if self.ended:
            return
        self.error = error
        if self._tell_lost is not None:
            self._tell_lost(error)
        with suppress(MotorError):  # A set-point that waits for a SYNC would undo the halt.
            self._word = ENABLE_OPERATION | HALT
            self._send()
        self._halt()
        self.cancel()

    def _lose(self, error: MotorBusyError) -> None:
        """End the stream, as another program has taken the drive over."""
        self.error = error
        self.cancel()
        self._node.news.grow()

    def stop(self, word: int) -> None:
        """Send this controlword, which the drive was given before, with all further set-points.

        A set-point that waits in the drive for the next SYNC would revoke the word. So the
        set-point is sent again with the word, and SYNC continues until that frame is certainly
        latched. The target continues at the same rate, as the drive takes its velocity from there
        to slow down.
        """
        if self.ended:
            return
        if self._registration is None:
            self.cancel()
            return
        self._word = word
        try:
            self._last_sent = self._send()
        except MotorBusyError as error:  # another program has taken the drive
            self._lose(error)

    def _go_on_stopping(self) -> None:
        if self._words_left == 0:
            self.cancel()
            return
        self._words_left -= 1
        self._target += self._step
        self._last_sent = self._send()

    def _began(self, time_ns: int) -> None:
        self.started_ns = time_ns
        if self._tell_began is not None:
            self._tell_began(time_ns)

    def _was_latched(self, time_ns: int) -> None:
        self.latched_ns = time_ns

    @property
    def link(self) -> "CanLink":
        """The link of the drive."""
        return self._link

    @property
    def is_stopping(self) -> bool:
        """True if the stream is stopping; it then ends within three periods."""
        return self._word != ENABLE_OPERATION

    @property
    def target(self) -> int:
        """The last target sent, in increments."""
        return self._target

    def cancel(self) -> None:
        """End the stream; the drive holds the last set-point."""
        if not self.ended:
            self.ended = True
            note_stream(self._link.bus, self._can_id, None)
            if self._fence is not None:
                self._fence.release()
            if self._registration is not None:
                self._registration.cancel()


_ROUNDING: Final = 1e-9
_STEP_ROUNDING_INC: Final = 1.0  # two targets, each rounded by at most half an increment
_WINDOW_S: Final = 0.02
_LATE: Final = 1.5  # periods: an argument may be one period late, and have another period than ours


@final
class StreamedMotion:
    """The set-points of one motion.

    Args:
        motor: the motor's name, for messages.
        motion: the planned motion, with a function.
        units: the units of the drive.
        period_s: the time between two set-points [s].
        held_inc: the position the drive holds now.

    Attributes:
        lead_in: the cycles before cycle 0 for the move to the beginning of the trajectory.
        lead: `lead_in`, or more to wait for other motors; set by the trigger.
        over: whether the end of the trajectory has been demanded.
        velocity: the velocity of the set-points, of a motion that continues at its end [U/s].
    """

    def __init__(
        self, motor: str, motion: Motion, units: DriveUnits, period_s: float, held_inc: int
    ) -> None:
        self._motor = motor
        self._motion = motion
        self._units = units
        self._period_s = period_s
        self._demand = demand_of(motion)
        self._argument = motion.argument
        self._way: Callable[[float], float] | None = None
        self._before: tuple[float, float] | None = None  # the previous velocity and position
        self._held_inc = held_inc
        self._last_inc = held_inc
        self._step_inc_max = (
            motion.velocity * period_s * abs(units.increments(1.0)) * (1.0 + _ROUNDING)
            + _STEP_ROUNDING_INC
        )
        if motion.variable is ControlVariable.VELOCITY:
            self._from = units.position(held_inc)
            if self._argument is None and motion.function is not None:
                self._way = way_of(motion)
        else:
            self._from = motion.start
        self._scale = abs(units.increments(1.0))
        self._window = max(1, ceil(_WINDOW_S / period_s))
        self._recent: deque[float] = deque([self._from], 2 * self._window + 1)
        self._shift = 0.0  # of a relative trajectory: change of the argument since planning
        self._approach = self._approach_of(motion)
        self.lead_in: int = 0
        if self._approach is not None:
            self.lead_in = ceil(self._approach.duration_s / period_s * (1.0 - _ROUNDING))
        self.lead: int = self.lead_in
        self.over: bool = False
        self.velocity: float = 0.0

    def _approach_of(self, motion: Motion) -> Trapezoid | None:
        """Return the profile from the motor's position to the beginning; None: it is there."""
        away = self._from - self._units.position(self._held_inc)
        if abs(self._units.increments(away)) <= _STEP_ROUNDING_INC:
            return None
        return shortest(away, motion.velocity, motion.acceleration, motion.deceleration)

    def target(self, cycle: int) -> int | None:
        """Return the set-point of a cycle, counted from 1, in increments; None at the end.

        Call it once for each cycle, in order.

        Raises:
            LimitError: it is further from the previous one than the velocity limit allows.
            MotorError: the argument is not known.
        """
        if self.over and self.velocity == 0.0:
            return None
        place = cycle - self.lead
        if place <= 0:
            return self._approached(cycle - self.lead + self.lead_in)
        position = self._position(place)
        target = self._units.position_inc(position)
        if abs(target - self._last_inc) > self._step_inc_max:
            step = self._units.position(target) - self._units.position(self._last_inc)
            raise self._beyond("velocity", step / self._period_s, self._motion.velocity)
        if self._argument is not None:
            self._check_change(place, position)
        self._last_inc = target
        return target

    def _check_change(self, place: int, position: float) -> None:
        """Check the change of velocity of an argument that is not predictable."""
        recent, period_s = self._recent, self._period_s
        limit = min(self._motion.acceleration, self._motion.deceleration)
        recent.append(position)
        if place <= 2:  # a relative trajectory's first set-point is the motor's position
            velocity = (position - recent[-2]) / period_s
            allowed = limit * period_s + 2.0 * _STEP_ROUNDING_INC / (self._scale * period_s)
            if abs(velocity) > allowed:
                raise self._beyond("velocity at the start", velocity, allowed)
        window_s = self._window * period_s
        middle = recent[max(0, len(recent) - 1 - self._window)]
        now = (position - middle) / window_s
        change = now - (middle - recent[0]) / window_s
        allowed = limit * window_s + _LATE * abs(now) / self._window
        allowed += 2.0 * _STEP_ROUNDING_INC / (self._scale * window_s)
        if abs(change) > allowed:
            raise self._beyond("change of velocity", change / window_s, limit)

    def _approached(self, cycle: int) -> int:
        """Return the set-point on the way to the beginning."""
        approach = self._approach
        if approach is None or cycle <= 0:
            return self._held_inc
        start = self._units.position(self._held_inc)
        at = (
            self._from
            if cycle >= self.lead_in
            else start + approach.position(cycle * self._period_s)
        )
        self._last_inc = self._units.position_inc(at)
        return self._last_inc

    def _position(self, place: int) -> float:
        """Return the position demanded `place` periods after the start [U]."""
        demand = self._demand
        if self._argument is None:
            elapsed_s = place * self._period_s
            at = demand.initial_argument + elapsed_s
        else:
            at = value_of(self._argument)
        end = demand.final_argument
        if self.over or at >= end - _ROUNDING * max(1.0, abs(end)):
            self.over = True
            at = max(at, end)  # an argument may turn back, but the trajectory stays over
        if self._motion.variable is ControlVariable.VELOCITY:
            return self._travelled(at)
        if self.over and self._motion.final_velocity:
            self.velocity = demand.first(at)
        trajectory = self._motion.trajectory
        if place == 1 and self._argument is not None and trajectory and trajectory.is_relative:
            self._shift = self._from - demand.value(at)
        return demand.value(at) + self._shift

    def _travelled(self, at: float) -> float:
        """Return the integral of a velocity trajectory, continued at its final velocity."""
        demand = self._demand
        self.velocity = demand.value(at)
        if self._way is None:
            velocity, position = self._before or (demand.value(at), self._from)
            position += 0.5 * (velocity + self.velocity) * self._period_s
            self._before = (self.velocity, position)
            return position
        inside = min(at, demand.final_argument)
        return self._from + self._way(inside) + (at - inside) * self.velocity

    def _beyond(self, quantity: str, value: float, limit: float) -> LimitError:
        argument = self._argument
        if argument is None:
            reason = "a step of the trajectory"
        else:
            period_ms = self._period_s * 1e3
            reason = f"the {argument.name} steps: set-points are {period_ms:g} ms apart; it must be"
            reason += " received as often (status_period_ms, of a motor's position), or be slower"
        per = "/s²" if quantity.startswith("change") else "/s"
        return LimitError(
            motor=self._motor,
            quantity=quantity,
            value=value,
            low=-limit,
            high=limit,
            unit=f"{self._units.unit}{per}",
            reason=reason,
        )
