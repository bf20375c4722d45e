"""Joint start of motions of CiA 402 drives at one SYNC: what is possible, and how it is done.

RPDOs of transmission type 1 hold their set-points until SYNC. Beside a cyclic SYNC, set-points
cannot be armed one by one: each would begin with the next SYNC. So all are prepared up to the one
frame that is still to be sent. Then all frames are sent just after a SYNC, in one *burst*. They
have a period to pass the bus before the next SYNC latches them. If they have not passed by then
(other traffic, a delayed frame), that SYNC *straddles* the burst. The drives whose frames have
passed begin with it, the others with a later one. This is detected and counted, as each frame's
time on the wire is known.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID, CanopenBus
from motorhil.motorapi.adaptations.canopen.bus_load import (
    FULL,
    SYNC,
    period_on_wire_s,
    sync_period,
)
from motorhil.motorapi.adaptations.canopen.sdo import REQUEST_ID, RESPONSE_ID
from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts
from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
from motorhil.motorapi.adaptations.cia402.csp import CspStream, StreamedMotion
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.objects import ENABLE_OPERATION, HALT
from motorhil.motorapi.api.bus_traffic import traffic_on
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage
from motorhil.motorapi.synchronization.offer import Firing, OneFrame, SyncOffer
from motorhil.motorapi.synchronization.quality import SyncLevel

if TYPE_CHECKING:
    from motorhil.motorapi.locking.process_lock import LockHandle
    from motorhil.motorapi.runtime.can_link import Transmission

_LATCHED: Final = {ControlVariable.POSITION: 0x607A, ControlVariable.VELOCITY: 0x60FF}
_SET_POINT_BYTES: Final = 6
_PERIODS: Final = 4
_HALTED: Final = (ENABLE_OPERATION | HALT).to_bytes(2, "little") + bytes(4)
_FIRST_SYNC_S: Final = 0.5


def offer_of(hardware: Cia402HwMotor, variable: ControlVariable, *, streamed: bool) -> SyncOffer:
    """Return how a motion of `variable` can begin together with others."""
    facts, link = hardware.connect(), hardware.link
    armed = facts.latched_ids.get(0x607A if streamed else _LATCHED.get(variable, 0))
    if variable is ControlVariable.TORQUE:
        reason = "6071h, target torque, is in no RPDO that SYNC latches"
        return _alone(hardware, facts, variable, reason)
    if armed is None:
        reason = "; ".join(facts.limitations) or "it has no RPDO latched by SYNC"
        return _alone(hardware, facts, variable, reason)
    reason = f"RPDO {armed:03X}h is latched by SYNC"
    if hardware.options.servo_period_ms is None:
        reason += "; servo_period_ms, from the latch to the profile, is not known"
    if streamed:
        return _streamed(hardware, armed, reason)
    period_s, why = sync_period(hardware.node.bus.sync)
    if period_s is not None:
        frame = OneFrame(armed, _SET_POINT_BYTES)
        return _in_a_burst(hardware, frame, period_s, f"{reason}; {why}")
    traffic, unbounded = traffic_on(link)
    firing = None if traffic is None else Firing(link.name, traffic, (SYNC,), 0.0, 1)
    return _completed(
        hardware,
        SyncOffer(SyncLevel.TRIGGERED, link.name, None, reason, firing, no_firing_bound=unbounded),
    )


def _streamed(hardware: Cia402HwMotor, can_id: int, reason: str) -> SyncOffer:
    """Return the offer of a stream: SYNC 1 brings the present position, SYNC 2 the first step."""
    link, period_s = hardware.link, hardware.options.set_point_period_ms / 1e3
    set_points = PeriodicMessage(can_id, _SET_POINT_BYTES, period_s)
    traffic, unbounded = traffic_on(link, period_s, (set_points,))
    firing, signal_s = None, None
    if traffic is not None:
        firing = Firing(link.name, traffic, (SYNC, SYNC), 2.0 * period_s, 1)
        signal_s = period_on_wire_s(link, traffic, period_s)
    offer = SyncOffer(
        level=SyncLevel.CYCLIC,
        group=link.name,
        latency_s=None,
        reason=reason,
        firing=firing,
        signals=1,
        signal_s=signal_s,
        no_firing_bound=unbounded,
    )
    return replace(
        _completed(hardware, offer),
        end_s=None,
        no_end_bound="the duration of streamed set-points is not predicted",
    )


def _in_a_burst(
    hardware: Cia402HwMotor, frame: OneFrame, period_s: float, reason: str
) -> SyncOffer:
    """Return the offer beside a cyclic SYNC: frames go out just after one SYNC, for the next."""
    link = hardware.link
    traffic, unbounded = traffic_on(link, period_s)
    # One SYNC to wait for, one that latches; further SYNCs of a straddling burst are in the skew.
    firing, signal_s = None, None
    if traffic is not None:
        signal_s = period_on_wire_s(link, traffic, period_s)
        firing = Firing(link.name, traffic, (SYNC, SYNC), 2.0 * period_s, 0)
    offer = SyncOffer(
        level=SyncLevel.TRIGGERED,
        group=link.name,
        latency_s=None,
        reason=reason,
        firing=firing,
        signals=1,
        signal_s=signal_s,
        burst=frame,
        period_s=period_s,
        no_firing_bound=unbounded,
    )
    return _completed(hardware, offer)


def _alone(
    hardware: Cia402HwMotor, facts: DriveFacts, variable: ControlVariable, reason: str
) -> SyncOffer:
    """Return the offer of a start by a controlword, or by a target effective when written."""
    link, node_id = hardware.link, hardware.node_id
    traffic, unbounded = traffic_on(link, sync_period(hardware.node.bus.sync)[0])
    mates = [HEARTBEAT_ID + node_id]
    if facts.status is not None:
        mates.append(facts.status.cob_id & 0x7FF)
    exchange = (
        OneFrame(REQUEST_ID + node_id, 8),
        OneFrame(RESPONSE_ID + node_id, 8, tuple(mates)),
    )
    frames: tuple[OneFrame, ...] = ()
    exchanges = 0
    if variable is not ControlVariable.POSITION:
        frames, exchanges = exchange, 1
    if facts.control_id is not None:
        frames = (*frames, OneFrame(facts.control_id, 2))
    else:
        frames, exchanges = (*frames, *exchange), exchanges + 1
    reply_ms = hardware.options.sdo_reply_ms
    if exchanges and reply_ms is None and not unbounded:
        unbounded = "the drive's SDO response time is not known (sdo_reply_ms)"
    firing = None
    if traffic is not None and not (exchanges and reply_ms is None):
        idle_s = exchanges * (reply_ms or 0.0) / 1e3
        firing = Firing(link.name, traffic, frames, idle_s, 1)
    return _completed(
        hardware,
        SyncOffer(
            SyncLevel.SEQUENTIAL, hardware.label, None, reason, firing, no_firing_bound=unbounded
        ),
    )


def _completed(hardware: Cia402HwMotor, offer: SyncOffer) -> SyncOffer:
    """Return the offer with the drive's latency and the accuracy of its clock, as far as known."""
    if offer.firing is not None and offer.signal_s is None:
        offer = replace(offer, no_firing_bound=FULL)
    options = hardware.options
    tick_ms, ppm = options.servo_period_ms, options.oscillator_ppm
    latency_s = None
    no_start = no_end = ""
    if ppm is None:
        no_end = "the accuracy of its clock is not known (oscillator_ppm)"
    if tick_ms is None:
        no_start = no_end = "its profile tick is not known (servo_period_ms)"
    else:
        latency_s = (0.0, tick_ms / 1e3 / (1.0 - (ppm or 0.0) * 1e-6))
    return replace(
        offer,
        latency_s=latency_s,
        oscillator_ppm=ppm,
        end_s=latency_s,
        no_start_bound=no_start,
        no_end_bound=no_end,
    )


@final
class ArmedSetPoint:
    """A set-point of one drive that begins at a SYNC, with others.

    Args:
        control: the controls of the drive.
        index: the object that holds the target: 607Ah, 60FFh.
        target: the target in the drive's units.
        fired: called with the time [ns] when that SYNC was on the wire.

    Attributes:
        latched_ns: the time of that SYNC; None: not yet.
        place: the number of that SYNC, on this link.
        straddles: the SYNCs between the first one of the group and this one's.
        transmission: the frame; None: not sent yet.
    """

    def __init__(
        self,
        control: DriveControl,
        index: int,
        target: int,
        fired: Callable[[int], None],
    ) -> None:
        self._control = control
        self._sync = control.node.bus.sync
        self._index = index
        self._target = target
        self._fired = fired
        self.place: int = 0
        self._mark: LockHandle | None = None
        self.transmission: Transmission | None = None
        self.latched_ns: int | None = None
        self.straddles = 0

    def mark(self, can_id: int) -> None:
        """Mark the set-point as waiting in this RPDO of the drive, for other processes."""
        node = self._control.node
        waiting = (node.node_id, can_id, _HALTED)
        self._mark = self._sync.marks.mark(node.link.runtime, waiting, self)

    def unmark(self) -> None:
        """Remove the mark: a SYNC has latched the set-point, or it was overwritten."""
        mark, self._mark = self._mark, None
        if mark is not None:
            mark.release()

    def send(self) -> None:
        """Send the frame, unless the drive was stopped.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: low-level access is active, or another program has taken the motor over.
        """
        if not self._control.is_halted:
            self.transmission = self._control.send_armed(
                self._index, self._target, fired=self._latched
            )

    def _latched(self, time_ns: int) -> None:
        self.latched_ns = time_ns
        self.place = self._sync.count
        self._fired(time_ns)

    @property
    def is_over(self) -> bool:
        """True if no SYNC is awaited: the set-point was latched, or the drive stopped."""
        return self.latched_ns is not None or not self._control.is_armed


@final
class Burst:
    """The frames of several drives, sent one after another just after a SYNC."""

    def __init__(self, bus: CanopenBus, armed: Sequence[ArmedSetPoint]) -> None:
        self._link = bus.link
        self._sync = bus.sync
        self._armed = armed
        self._error: Exception | None = None
        self._is_sent = False
        bus.sync.at_next(self._send)

    def _send(self, time_ns: int) -> None:
        if self._is_sent:
            return
        self._is_sent = True
        try:
            for one in self._armed:
                one.send()
        except Exception as error:  # raised in the waiting call
            self._error = error

    def await_latched(self) -> None:
        """Wait until all set-points have begun, or their drives were stopped.

        Raises:
            LinkError: the bus does not accept the frames, or no SYNC comes.
            MotorBusyError: low-level access is active, or another program has taken a motor over.
        """
        link, armed = self._link, self._armed
        if not self._comes(lambda: self._is_sent):
            self._send(0)  # the producer of SYNC has ended: one of ours begins them
        if self._error is not None:
            raise self._error
        link.confirmed([one.transmission for one in armed if one.transmission is not None])
        if not self._comes(lambda: all(one.is_over for one in armed)):
            link.confirmed([self._sync.send()])

    def _comes(self, done: Callable[[], bool]) -> bool:
        """Return whether `done` becomes true; False: the cyclic SYNC has ended.

        Raises:
            LinkError: a cyclic SYNC should run, but does not come.
        """
        link = self._link
        runs = self._sync.known()
        period_s = 0.0 if runs is None else runs.period_ns / 1e9
        end_ns = link.runtime.now_ns() + round((_FIRST_SYNC_S + _PERIODS * period_s) * 1e9)
        while runs is not None:
            if link.wait_until(done, _PERIODS * period_s):
                return True
            runs = self._sync.known()
            if runs is not None and link.runtime.now_ns() >= end_ns:
                raise LinkError(link=link.name, reason=f"no SYNC was transmitted, but {runs}")
        return done()


def count_straddles(armed: Sequence[ArmedSetPoint]) -> None:
    """Set `straddles` of each set-point: the number of SYNCs after the first one."""
    latched = [one for one in armed if one.latched_ns is not None]
    for one in latched:
        one.straddles = one.place - min(other.place for other in latched)


@final
class ArmedGroup:
    """The motions that are to begin together at one SYNC of a bus.

    Attributes:
        streams: the streams of set-points.
        set_points: the single set-points.
    """

    def __init__(self) -> None:
        self.streams: Final[list[ArmedStream]] = []
        self.set_points: Final[list[ArmedSetPoint]] = []


def armed_group(bus: CanopenBus) -> ArmedGroup:
    """Return the group that is armed on this bus."""
    return bus.parts.part(ArmedGroup)


@final
class SyncTrigger:
    """One SYNC for all motors armed on a bus: it latches set-points and begins streams."""

    def __init__(self, bus: CanopenBus, armed: ArmedGroup) -> None:
        self._bus = bus
        self._link = bus.link
        self._armed = armed

    def fire(self) -> None:
        """Send SYNC and wait until it was on the wire; for streams, also the next one.

        The second SYNC brings the first step of the streams.

        Raises:
            LinkError: SYNC was not transmitted in time.
        """
        armed = self._armed
        streams = [one for one in armed.streams if not one.stream.ended]
        armed.streams.clear()
        points = armed.set_points[:]
        waiting = [one for one in points if one.transmission is None]
        burst = Burst(self._bus, waiting) if waiting else None
        if streams:
            self._begin(streams)
        if burst is not None:
            burst.await_latched()
        elif not streams:
            self._link.confirmed([self._bus.sync.send()])
        count_straddles(points)
        for one in points:
            one.unmark()
        armed.set_points.clear()

    def _begin(self, streams: "list[ArmedStream]") -> None:
        link = self._link
        # A trajectory that needs a shorter lead-in waits at its beginning for the longest one.
        lead = max(one.motion.lead_in for one in streams)
        for one in streams:
            one.motion.lead = lead
            one.stream.begin()
        for one in streams:
            begun = partial(_has_begun, one.stream)
            if not link.wait_until(begun, _FIRST_SYNC_S + 3 * one.stream.period_s):
                raise LinkError(link=link.name, reason="no SYNC was transmitted")

    def __eq__(self, other: object, /) -> bool:
        return isinstance(other, SyncTrigger) and other._armed is self._armed

    def __hash__(self) -> int:
        return id(self._armed)


@final
class HandOverTrigger:
    """The start of a motion in a stream that runs: its set-points follow those of the last one."""

    def __init__(self, stream: CspStream, hand_over: Callable[[], None]) -> None:
        self._stream = stream
        self._hand_over = hand_over

    def fire(self) -> None:
        """Start the motion, and wait until the SYNC of its first set-point was on the wire.

        Raises:
            LinkError: SYNC was not transmitted in time.
        """
        stream = self._stream
        self._hand_over()
        link = stream.link
        if not link.wait_until(partial(_has_begun, stream), _FIRST_SYNC_S + 3 * stream.period_s):
            raise LinkError(link=link.name, reason="no SYNC was transmitted")


@final
@frozen
class ArmedStream:
    """A stream of set-points that is ready to be sent."""

    stream: CspStream
    motion: StreamedMotion


def _has_begun(stream: CspStream) -> bool:
    return stream.started_ns is not None or stream.ended
