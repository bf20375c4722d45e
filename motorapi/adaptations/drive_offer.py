"""Synchronous-start capability of a CiA 402 drive, and its time bounds."""

from typing import TYPE_CHECKING, Final

from motorapi.adaptations.bus_traffic import FULL, SYNC, period_on_wire_s, sync_period, traffic_on
from motorapi.adaptations.canopen_link import HEARTBEAT_ID
from motorapi.bus_timing import Firing, OneFrame
from motorapi.commands import ControlVariable
from motorapi.synchronization import SyncLevel, SyncOffer
from motorapi.traffic import PeriodicMessage

if TYPE_CHECKING:
    from motorapi.adaptations.cia402_hardware import Cia402HwMotor
    from motorapi.adaptations.drive_setup import DriveFacts

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
    period_s, why = sync_period(link)
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
    traffic, unbounded = traffic_on(link, sync_period(link)[0])
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
