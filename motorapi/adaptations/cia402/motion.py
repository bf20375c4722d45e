"""Motions of a CiA 402 drive: arming, starting and confirming.

The mode of operation for each command:

| command                                  | mode | how it starts                             |
| ---------------------------------------- | ---- | ----------------------------------------- |
| set-point or simple trajectory, position | pp   | new set-point, changed immediately        |
| set-point or simple trajectory, velocity | pv   | target velocity 60FFh; ramps 6083h, 6084h |
| set-point or simple trajectory, torque   | tq   | target torque 6071h; slope 6087h          |
| trajectory that is a function            | csp  | its first set-point, latched by SYNC      |

Synchronous-start capability of a CiA 402 drive, and its time bounds.

Measured begin and end of a CiA 402 drive's motion.

Triggers that start an armed motion of a CiA 402 drive.

Objects to write to a drive when a motion begins.

They are the logical motor's parameters, and settings for this motion alone: a torque slope, a quick
stop within the model's limit, the ramp of a halt. The drive gets its own values back afterwards.

Joint start of set-points beside a cyclic SYNC, in one burst.

Set-points cannot be armed one by one there: each would begin with the next SYNC. So all are
prepared up to the one frame that is still to be sent. Then all frames are sent just after a SYNC,
and have a period to pass the bus before the next SYNC latches them. If they have not passed by then
(other traffic, a delayed frame), that SYNC *straddles* the burst. The drives whose frames have
passed begin with it, the others with a later one. This is detected and counted, as each frame's
time on the wire is known.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID, CanopenBus
from motorhil.motorapi.adaptations.canopen.bus_load import (
    FULL,
    SYNC,
    period_on_wire_s,
    sync_period,
    traffic_on,
)
from motorhil.motorapi.adaptations.canopen.sdo import SdoAborted
from motorhil.motorapi.adaptations.cia402.csp import CspStream, StreamedMotion
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.cia402.motion_status import (
    SETTLE_NS,
    MotionWatch,
    SetpointWatch,
    StreamWatch,
)
from motorhil.motorapi.adaptations.cia402.objects import ENABLE_OPERATION, FAULT_BIT, HALT, Mode
from motorhil.motorapi.adaptations.cia402.parameters import (
    HALT_OPTION,
    WINDOW_OFF,
    Cia402Parameters,
    Place,
)
from motorhil.motorapi.adaptations.cia402.profile import (
    STEEPEST,
    DriveProfile,
    as_motion,
    as_torque_motion,
    check_limits,
    check_target,
    expected_s,
    profile_of,
    ramp_s,
    torque_profile_of,
)
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, StateError
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage
from motorhil.motorapi.synchronization.offer import Firing, OneFrame, SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.canopen.link import Transmission
    from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts
    from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
    from motorhil.motorapi.locking.process_lock import LockHandle
    from motorhil.motorapi.model import MotorModel

_LATCHED: Final = {ControlVariable.POSITION: 0x607A, ControlVariable.VELOCITY: 0x60FF}
_SET_POINT_BYTES: Final = 6
_REQUEST_ID: Final = 0x600
_REPLY_ID: Final = 0x580


def offer_of(hardware: "Cia402HwMotor", variable: ControlVariable, *, streamed: bool) -> SyncOffer:
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
    return _offer(hardware, SyncLevel.TRIGGERED, link.name, reason, firing, unbounded)


def _streamed(hardware: "Cia402HwMotor", can_id: int, reason: str) -> SyncOffer:
    """Return the offer of a stream: SYNC 1 brings the present position, SYNC 2 the first step."""
    link, period_s = hardware.link, hardware.options.set_point_period_ms / 1e3
    set_points = PeriodicMessage(can_id, _SET_POINT_BYTES, period_s)
    traffic, unbounded = traffic_on(link, period_s, (set_points,))
    firing, signal_s = None, None
    if traffic is not None:
        firing = Firing(link.name, traffic, (SYNC, SYNC), 2.0 * period_s, 1)
        signal_s = period_on_wire_s(link, traffic, period_s)
    return _offer(
        hardware,
        SyncLevel.CYCLIC,
        link.name,
        reason,
        firing,
        unbounded,
        signals=1,
        signal_s=signal_s,
        streamed=True,
    )


def _in_a_burst(
    hardware: "Cia402HwMotor", frame: OneFrame, period_s: float, reason: str
) -> SyncOffer:
    """Return the offer beside a cyclic SYNC: frames go out just after one SYNC, for the next."""
    link = hardware.link
    traffic, unbounded = traffic_on(link, period_s)
    # One SYNC to wait for, one that latches; further SYNCs of a straddling burst are in the skew.
    firing, signal_s = None, None
    if traffic is not None:
        signal_s = period_on_wire_s(link, traffic, period_s)
        firing = Firing(link.name, traffic, (SYNC, SYNC), 2.0 * period_s, 0)
    return _offer(
        hardware,
        SyncLevel.TRIGGERED,
        link.name,
        reason,
        firing,
        unbounded,
        signals=1,
        signal_s=signal_s,
        burst=frame,
        period_s=period_s,
    )


def _alone(
    hardware: "Cia402HwMotor", facts: "DriveFacts", variable: ControlVariable, reason: str
) -> SyncOffer:
    """Return the offer of a start by a controlword, or by a target effective when written."""
    link, node_id = hardware.link, hardware.node_id
    traffic, unbounded = traffic_on(link, sync_period(hardware.node.bus.sync)[0])
    mates = [HEARTBEAT_ID + node_id]
    if facts.status is not None:
        mates.append(facts.status.cob_id & 0x7FF)
    exchange = (
        OneFrame(_REQUEST_ID + node_id, 8),
        OneFrame(_REPLY_ID + node_id, 8, tuple(mates)),
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
    return _offer(hardware, SyncLevel.SEQUENTIAL, hardware.label, reason, firing, unbounded)


def _offer(
    hardware: "Cia402HwMotor",
    level: SyncLevel,
    group: str,
    reason: str,
    firing: Firing | None,
    unbounded: str,
    *,
    signals: int = 0,
    signal_s: tuple[float, float] | None = (0.0, 0.0),
    burst: OneFrame | None = None,
    period_s: float | None = None,
    streamed: bool = False,
) -> SyncOffer:
    if firing is not None and signal_s is None:
        unbounded = FULL
    options = hardware.options
    tick_ms, ppm = options.servo_period_ms, options.oscillator_ppm
    latency_s = end_s = None
    no_start = no_end = ""
    if ppm is None:
        no_end = "the accuracy of its clock is not known (oscillator_ppm)"
    if tick_ms is None:
        no_start = no_end = "its profile tick is not known (servo_period_ms)"
    else:
        latency_s = end_s = (0.0, tick_ms / 1e3 / (1.0 - (ppm or 0.0) * 1e-6))
    if streamed:
        end_s, no_end = None, "the duration of streamed set-points is not predicted"
    return SyncOffer(
        level=level,
        group=group,
        latency_s=latency_s,
        reason=reason,
        firing=firing,
        signals=signals,
        signal_s=signal_s,
        burst=burst,
        period_s=period_s,
        oscillator_ppm=ppm,
        end_s=end_s,
        no_firing_bound=unbounded,
        no_start_bound=no_start,
        no_end_bound=no_end,
    )


def times_of_stream(watch: "StreamWatch", stream: "CspStream | None") -> MotionTimes:
    """Return the motion times of streamed set-points."""
    source = "SYNC of the first set-point on the wire; position within its window in a TPDO"
    if stream is not None and stream.late:
        source += f"; {stream.late} of {stream.sent} set-points were late"
    if stream is not None and stream.missed:
        source += f"; the host missed {stream.missed} periods"
    return MotionTimes(watch.started_ns, watch.ended_ns, source, latched_ns=watch.started_ns)


def times_of_set_point(
    watch: "SetpointWatch", point: "ArmedSetPoint | None", *, together: bool
) -> MotionTimes:
    """Return the motion times of one set-point; `point` is what a SYNC has started, if any."""
    commanded_ns, ended_ns = watch.commanded_ns, watch.ended_ns
    if point is not None:
        source = "SYNC on the wire; target reached in a TPDO"
        if point.straddles:
            source += f"; it began {point.straddles} SYNC later than the first"
        return MotionTimes(commanded_ns, ended_ns, source, point.latched_ns, point.straddles)
    if together:
        source = "its command on the wire; target reached in a TPDO"
        return MotionTimes(commanded_ns, ended_ns, source, commanded_ns)
    source = "set-point acknowledge and target reached in a TPDO"
    return MotionTimes(watch.started_ns, ended_ns, source, commanded_ns)


def settings_of(
    motion: Motion, parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> dict[Place, int]:
    """Return the values to write, by object; all other objects get the drive's own values.

    Raises:
        LimitError: a value does not fit the drive.
    """
    units = reader.known()[0]
    wanted = parameters.objects(units)
    if motion.function is not None:
        # A quick stop in mid-stream must not exceed the model's deceleration.
        own = hardware.parameters.own((0x6085, 0))
        if own is None:
            own = hardware.objects.read_optional(0x6085)
        highest = units.acceleration_raw(motion.deceleration)
        if own is not None and (own == 0 or own > highest):
            wanted[0x6085, 0] = highest
    elif motion.variable is ControlVariable.TORQUE:
        slope = torque_profile_of(motion, reader.torque_unit()).slope
        if slope is not None and slope != STEEPEST:
            wanted[0x6087, 0] = slope
    return wanted | _halt_settings(motion, hardware, reader)


def _halt_settings(
    motion: Motion, hardware: Cia402HwMotor, reader: DriveReader
) -> dict[Place, int]:
    """Return the settings for a halt with the motion's own deceleration, if it has one.

    605Dh = 1 selects the motion's own ramp, 6084h. 2 selects the quick stop ramp, 6085h, which is
    set to the motion's deceleration meanwhile.
    """
    asked = motion.stop_deceleration
    if asked is None or hardware.objects.read_optional(HALT_OPTION) is None:
        return {}
    units = reader.known()[0]
    steepest = units.acceleration_raw(asked)
    if steepest == units.acceleration_raw(motion.deceleration):
        return {(HALT_OPTION, 0): 1}
    return {(HALT_OPTION, 0): 2, (0x6085, 0): steepest}


def window_of(
    parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> int | None:
    """Return the position window of the target [increments], or None if the drive has none."""
    units, limits = reader.known()
    if parameters.position_window is not None:
        return parameters.objects(units)[0x6067, 0]
    own = hardware.parameters.own((0x6067, 0))
    return limits.window if own is None else (None if own == WINDOW_OFF else own)


_PERIODS: Final = 4
_HALTED: Final = (ENABLE_OPERATION | HALT).to_bytes(2, "little") + bytes(4)


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
        control: "DriveControl",
        index: int,
        target: int,
        fired: Callable[[int], None],
    ) -> None:
        self._control = control
        self._sync = control.node.bus.sync
        self._index = index
        self._target = target
        self._fired = fired
        self.place = 0
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


_FIRST_SYNC_S: Final = 0.5


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
class SetPointTrigger:
    """The controlword that makes one drive accept its target position."""

    def __init__(self, hardware: Cia402HwMotor, watch: SetpointWatch) -> None:
        self._hardware = hardware
        self._watch = watch

    def fire(self) -> None:
        """Send the controlword and wait until it was on the wire."""
        transmission = self._hardware.control.send_set_point()
        if transmission is not None:
            self._hardware.link.confirmed([transmission])
        now_ns = self._hardware.runtime.now_ns()
        self._watch.begin(now_ns if transmission is None else transmission.time_ns or now_ns)


@final
class LiveTargetTrigger:
    """One drive's target velocity (60FFh) or torque (6071h), which takes effect when written."""

    def __init__(
        self, hardware: Cia402HwMotor, watch: SetpointWatch, index: int, target: int
    ) -> None:
        self._hardware = hardware
        self._watch = watch
        self._index = index
        self._target = target

    def fire(self) -> None:
        """Write the target to the drive, and release a halt."""
        hardware = self._hardware
        hardware.objects.write(self._index, self._target)
        transmission = hardware.control.send_holding_word()
        if transmission is not None:
            hardware.link.confirmed([transmission])
        self._watch.begin(hardware.runtime.now_ns())


@final
@dataclass(frozen=True, slots=True)
class ArmedStream:
    """A stream of set-points that is ready to be sent."""

    stream: CspStream
    motion: StreamedMotion


def _has_begun(stream: CspStream) -> bool:
    return stream.started_ns is not None or stream.ended


_CONFIRM_TIMEOUT_S: Final = 0.5
_RESEND_S: Final = 0.1
_BEHIND: Final = 10.0  # start tolerances: no drive stands still that far behind its set-points
_STOPPING_PERIODS: Final = 4
POLL_S: Final = 0.01
_LIVE: Final = {ControlVariable.VELOCITY: 0x60FF, ControlVariable.TORQUE: 0x6071}


@final
class DriveMotions:
    """The motions of one logical motor in its drive, from arming to the end.

    Attributes:
        parameters: the parameters to write before a motion of this logical motor begins.
    """

    def __init__(
        self, hardware: Cia402HwMotor, model: "MotorModel", reader: DriveReader, motor: str
    ) -> None:
        self._hardware = hardware
        self._runtime = hardware.runtime
        self._node = hardware.node
        self._control = hardware.control
        self._objects = hardware.objects
        self._model = model
        self._reader = reader
        self._motor = motor
        self.parameters = Cia402Parameters()
        self._watch: SetpointWatch | StreamWatch | None = None
        self._before: MotionWatch | None = None
        self._armed: CspStream | None = None  # the stream that begins, or began last
        self._point: ArmedSetPoint | None = None  # of the last group start
        self._together = False
        self._group = armed_group(hardware.node.bus)

    @property
    def _set_point_period_s(self) -> float:
        return self._hardware.options.set_point_period_ms / 1e3

    # --- prediction ----------------------------------------------------------------------------

    def offer(self, variable: ControlVariable, *, streamed: bool) -> SyncOffer:
        """Return how a motion of `variable` can begin together with others."""
        return offer_of(self._hardware, variable, streamed=streamed)

    def quantise(self, motion: Motion) -> Motion:
        """Return the motion in the drive's resolution; see `MotorHooks._quantise`."""
        units, limits = self._reader.known()
        if motion.function is not None:
            return motion  # its set-points are rounded to increments one by one
        if motion.variable is ControlVariable.TORQUE:
            unit = self._reader.torque_unit()
            return as_torque_motion(motion, torque_profile_of(motion, unit), unit)
        return as_motion(motion, profile_of(motion, self._model, units, limits), units)

    # --- arming ----------------------------------------------------------------------------

    def arm(self, motion: Motion, *, together: bool) -> Trigger:
        """Arm a motion in the drive; see `MotorHooks._arm`."""
        self._together = together
        self._point = None
        stream = self._hardware.stream
        if stream is not None and stream.is_stopping:
            self._runtime.wait_until(lambda: stream.ended, _STOPPING_PERIODS * stream.period_s)
        if stream is not None and not stream.ended:
            raise StateError(
                motor=self._motor,
                operation="start",
                state="set-points are being streamed to it",
                remedy="stop() first",
            )
        wanted = settings_of(motion, self.parameters, self._hardware, self._reader)
        self._hardware.parameters.apply(self._motor, wanted)
        if motion.function is not None:
            return self._arm_stream(motion)
        if motion.variable is ControlVariable.TORQUE:
            return self._arm_torque(motion)
        units, limits = self._reader.known()
        profile = profile_of(motion, self._model, units, limits)
        check_limits(self._motor, profile, units, limits)
        if motion.variable is ControlVariable.VELOCITY:
            return self._arm_velocity(motion, profile)
        return self._arm_position(motion, profile)

    def _arm_position(self, motion: Motion, profile: DriveProfile) -> Trigger:
        units, limits = self._reader.known()
        check_target(self._motor, profile.target, units, limits)
        self._control.set_mode(Mode.PROFILE_POSITION)
        self._push_ramps(profile.acceleration, profile.deceleration)
        self._objects.push(0x6081, profile.speed)
        self._control.take_set_points()
        watch = SetpointWatch(
            commanded_ns=None,
            expected_ns=round(expected_s(motion, profile, units) * 1e9),
            acknowledged=True,
            target_inc=profile.target,
            tolerance_inc=self._window(),
            distance_inc=profile.target - self._node.position_inc,
        )
        self._follow(watch)
        self._reader.held = (profile.target, motion.target)
        if self._can_arm(0x607A):
            return self._arm_latched(0x607A, profile.target, watch)
        self._objects.push(0x607A, profile.target)
        return SetPointTrigger(self._hardware, watch)

    def _arm_velocity(self, motion: Motion, profile: DriveProfile) -> Trigger:
        if not self._control.is_in(Mode.PROFILE_VELOCITY):
            self._objects.write(0x60FF, 0)  # an old target would take effect at once
            self._control.set_mode(Mode.PROFILE_VELOCITY)
        self._push_ramps(profile.acceleration, profile.deceleration)
        change = abs(motion.target - self._reader.velocity())
        slowest = min(motion.acceleration, motion.deceleration)
        self._control.keep_halt()
        watch = _live_watch(round(change / slowest * 1e9))
        self._follow(watch)
        if self._can_arm(0x60FF):
            return self._arm_latched(0x60FF, profile.target, watch)
        return LiveTargetTrigger(self._hardware, watch, 0x60FF, profile.target)

    def _arm_torque(self, motion: Motion) -> Trigger:
        unit = self._reader.torque_unit()
        profile = torque_profile_of(motion, unit)
        if not self._control.is_in(Mode.PROFILE_TORQUE):
            # In tq any value of 6071h takes effect at once; with 0, a load would drop.
            self._control.hold()
            self._control.set_mode(Mode.PROFILE_TORQUE)
        self._push_stopping_ramps(motion)
        if profile.slope == STEEPEST:
            with suppress(SdoAborted):  # A drive with a steepest slope of its own keeps that.
                self._objects.push(0x6087, STEEPEST)
        self._control.keep_halt()
        expected_ns = round(ramp_s(motion, profile, unit) * 1e9)
        watch = _live_watch(max(expected_ns, SETTLE_NS))
        self._follow(watch)
        return LiveTargetTrigger(self._hardware, watch, 0x6071, profile.target)

    def _arm_stream(self, motion: Motion) -> Trigger:
        hardware, period_s = self._hardware, self._set_point_period_s
        units = self._reader.known()[0]
        velocity = motion.variable is ControlVariable.VELOCITY
        if velocity and abs(motion.start) > motion.acceleration * period_s:
            raise StateError(
                motor=self._motor,
                operation="start",
                state=f"the trajectory begins at {motion.start:g} {units.unit}/s, and the "
                "drive changes to csp at rest",
                remedy="begin it at 0",
            )
        if not velocity:
            self._check_ends(motion)
        self._push_stopping_ramps(motion)
        self._control.keep_halt()
        watch = StreamWatch(period_ns=round(period_s * 1e9), tolerance_inc=self._window())

        def next_target(cycle: int) -> int | None:
            was_over = streamed.over
            try:
                target = streamed.target(cycle)
            except Exception as error:
                watch.fail(error)
                raise
            if was_over and not watch.has_arrived:  # the last one goes with the SYNC just queued
                last = None if streamed.velocity else stream.target
                self._node.bus.sync.at_next(partial(watch.arrive, last))
            return target

        hardware.connect()
        stream = CspStream(
            self._control,
            period_s,
            next_target,
            began=watch.begin,
            lost=watch.fail,
            at_once=False,
            behind_inc=abs(round(units.increments(_BEHIND * self._model.start_tolerance))),
        )
        streamed = StreamedMotion(self._motor, motion, units, period_s, stream.target)
        self._armed = hardware.stream = stream
        self._follow(watch)
        self._reader.held = (None, 0.0)
        if not velocity:
            self._reader.held = (units.position_inc(motion.target), motion.target)
        armed = self._group if self._together else ArmedGroup()
        armed.streams.append(ArmedStream(stream, streamed))
        return SyncTrigger(self._node.bus, armed)

    def _check_ends(self, motion: Motion) -> None:
        """Check that the whole trajectory is within the drive's own software position limits."""
        units, limits = self._reader.known()
        if motion.function is None or limits.position is None:
            return
        found = motion.function.extrema(*motion.interval)
        for value in (found.minimum, found.maximum):
            check_target(self._motor, units.position_inc(value + motion.offset), units, limits)

    def _push_stopping_ramps(self, motion: Motion) -> None:
        """Write the model's ramps for stop and halt (6084h), where the mode has no ramps."""
        units = self._reader.known()[0]
        self._push_ramps(
            units.acceleration_raw(motion.acceleration), units.acceleration_raw(motion.deceleration)
        )

    def _window(self) -> int | None:
        return window_of(self.parameters, self._hardware, self._reader)

    def _push_ramps(self, acceleration: int, deceleration: int) -> None:
        self._objects.push(0x6083, acceleration)
        if self._reader.known()[1].has_deceleration:
            self._objects.push(0x6084, deceleration)

    def _can_arm(self, index: int) -> bool:
        """Return whether SYNC can start the target, together with others."""
        return self._together and index in self._hardware.connect().latched_ids

    def _arm_latched(self, index: int, target: int, watch: SetpointWatch) -> Trigger:
        """Write the target for the next SYNC; while a cyclic SYNC runs, only prepare it."""
        bus, link, armed = self._node.bus, self._node.link, self._group
        point = ArmedSetPoint(self._control, index, target, watch.begin)
        self._point = point
        # If a foreign SYNC has already begun some motors, the others do not wait for another.
        has_begun = any(one.latched_ns is not None for one in armed.set_points)
        armed.set_points.append(point)
        cyclic = bus.sync.known() if has_begun else bus.sync.find_cyclic()
        if cyclic is None:
            point.mark(self._hardware.connect().latched_ids[index])
            point.send()
            if point.transmission is not None:
                link.confirmed([point.transmission])
        return SyncTrigger(bus, armed)

    def _follow(self, watch: SetpointWatch | StreamWatch) -> None:
        self._before = self._node.watch
        self._watch = watch
        self._hardware.follow(watch)

    def disarm(self) -> None:
        """Cancel an armed motion; see `MotorHooks._disarm`."""
        watch, stream = self._watch, self._armed
        if watch is not None and watch is self._node.watch and not _is_commanded(watch, stream):
            self._hardware.follow(self._before)  # for example a stop that came while arming
        if stream is not None and stream.started_ns is None:
            stream.cancel()
        point, self._point = self._point, None
        if point in self._group.set_points:
            self._group.set_points.remove(point)
        try:
            self._control.disarm()
        finally:
            if point is not None:
                point.unmark()

    # --- confirming ----------------------------------------------------------------------------

    def confirm(self, motion: Motion) -> None:
        """Confirm that the motion has begun; see `MotorHooks._confirm`."""
        watch = self._watch
        if watch is None or self._control.is_halted:
            return
        if isinstance(watch, StreamWatch):
            self._node.check_motion(self._motor)  # the trigger has waited for the first SYNC
        elif motion.variable is ControlVariable.POSITION:
            self._await_acknowledge(watch)
        else:
            self._confirm_target(motion)
        if not self._control.is_halted:
            self._control.has_started()
            if motion.variable is ControlVariable.POSITION and isinstance(watch, SetpointWatch):
                self._control.send_holding_word()

    def _await_acknowledge(self, watch: SetpointWatch) -> None:
        """Await the set-point acknowledge; send a lost controlword again.

        Repeating is safe: the drive detects an edge of bit 4, and there is no edge if it has the
        controlword already.
        """
        node = self._node
        deadline_ns = self._runtime.now_ns() + round(_CONFIRM_TIMEOUT_S * 1e9)

        def is_over() -> bool:
            ends = watch.started_ns is not None or self._control.is_halted
            is_gone = node.is_lost or not node.is_up
            return ends or node.statusword & FAULT_BIT != 0 or is_gone

        while True:
            node.refresh()
            pause_s = _RESEND_S if node.status_is_cyclic else POLL_S
            if self._runtime.wait_until(is_over, pause_s):
                if not self._control.is_halted:
                    node.check_motion(self._motor)
                return
            if self._runtime.now_ns() >= deadline_ns:
                raise DeadlineExceeded(
                    awaited=f"{self._motor}: set-point acknowledge",
                    timeout_s=_CONFIRM_TIMEOUT_S,
                    last_heard=node.describe_status(),
                )
            if not self._together:
                self._control.send_set_point()

    def _confirm_target(self, motion: Motion) -> None:
        """Read the target back, as pv and tq have no acknowledge."""
        index = _LIVE[motion.variable]
        if motion.variable is ControlVariable.TORQUE:
            target = torque_profile_of(motion, self._reader.torque_unit()).target
        else:
            units, limits = self._reader.known()
            target = profile_of(motion, self._model, units, limits).target
        found = self._objects.read_int(index)
        if found != target and not self._control.is_halted:
            raise DeadlineExceeded(
                awaited=f"{self._motor}: target {motion.variable.value} {target} in the drive",
                timeout_s=0.0,
                last_heard=f"{index:04X}h = {found}",
            )
        self._node.check_motion(self._motor)

    def times(self) -> MotionTimes | None:
        """Return the times of the motion; see `MotorHooks._motion_times`."""
        watch = self._watch
        if watch is None:
            return None
        if isinstance(watch, StreamWatch):
            return times_of_stream(watch, self._armed)
        return times_of_set_point(watch, self._point, together=self._together)


def _live_watch(expected_ns: int) -> SetpointWatch:
    """Return the watch of a target that has neither acknowledge nor position."""
    return SetpointWatch(
        commanded_ns=None,
        expected_ns=expected_ns,
        acknowledged=False,
        target_inc=None,
        tolerance_inc=None,
    )


def _is_commanded(watch: SetpointWatch | StreamWatch, stream: CspStream | None) -> bool:
    if isinstance(watch, StreamWatch):
        return stream is not None and stream.started_ns is not None
    return watch.commanded_ns is not None
