"""Triggers that start an armed motion of a CiA 402 drive."""

from dataclasses import dataclass
from functools import partial
from typing import Final, final

from motorapi.adaptations.canopen_link import CanopenLink
from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.csp_stream import CspStream
from motorapi.adaptations.motion_watch import SetpointWatch
from motorapi.adaptations.streamed_motion import StreamedMotion
from motorapi.adaptations.sync_burst import Burst, count_straddles
from motorapi.errors import LinkError

_FIRST_SYNC_S: Final = 0.5


@final
class SyncTrigger:
    """One SYNC for all motors armed on a bus: it latches set-points and begins streams.

    Args:
        link: the link of the bus.
        streams: the streams to begin. None: those of the group that is armed on this bus.
    """

    def __init__(self, link: CanopenLink, streams: "list[ArmedStream] | None" = None) -> None:
        self._link = link
        self._streams = link.armed_streams if streams is None else streams

    def fire(self) -> None:
        """Send SYNC and wait until it was on the wire; for streams, also the next one.

        The second SYNC brings the first step of the streams.

        Raises:
            LinkError: SYNC was not transmitted in time.
        """
        link = self._link
        streams = [one for one in self._streams if not one.stream.ended]
        is_group = self._streams is link.armed_streams
        self._streams.clear()
        points = link.armed_set_points[:] if is_group else []
        waiting = [one for one in points if one.transmission is None]
        burst = Burst(link, waiting) if waiting else None
        if streams:
            self._begin(streams)
        if burst is not None:
            burst.await_latched()
        elif not streams:
            link.confirmed([link.sync()])
        count_straddles(points)
        for one in points:
            one.unmark()
        if is_group:
            link.armed_set_points.clear()

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
        return isinstance(other, SyncTrigger) and other._streams is self._streams

    def __hash__(self) -> int:
        return id(self._streams)


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
