"""Measured begin and end of a CiA 402 drive's motion."""

from typing import TYPE_CHECKING

from motorapi.synchronization import MotionTimes

if TYPE_CHECKING:
    from motorapi.adaptations.csp_stream import CspStream
    from motorapi.adaptations.motion_watch import SetpointWatch, StreamWatch
    from motorapi.adaptations.sync_burst import ArmedSetPoint


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
