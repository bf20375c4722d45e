"""Capability of one motor's hardware for a common start with others.

A start has two steps. *Arming* prepares a motor so that one more signal starts its motion; it is
complete only when the hardware has confirmed it (on CAN: seen on the wire). *Firing* is that
signal. Motors whose hardware can share one signal (drives on one CAN bus: one SYNC) offer the same
trigger group and are fired by one trigger; the others are fired in turn.
"""

from collections.abc import Hashable
from typing import Protocol, final

from motorhil.frozen import frozen
from motorhil.motorapi.synchronization.bus_load import CanTraffic, rank_of
from motorhil.motorapi.synchronization.can_frame_length import longest
from motorhil.motorapi.synchronization.quality import SyncLevel


class Trigger(Protocol):
    """The start of every motion armed for it. Equal triggers are fired once."""

    def fire(self) -> None:
        """Start the armed motions; return when the signal was transmitted."""

    def __eq__(self, other: object, /) -> bool: ...

    def __hash__(self) -> int: ...


@final
@frozen
class OneFrame:
    """A frame that is sent once.

    Attributes:
        can_id: its identifier.
        length: data bytes.
        mates: identifiers that may precede it in the queue of its sender, if another node sends it:
            the TPDOs and the heartbeat of a node that answers an SDO.
        extended: the identifier has 29 bits.
        fd: a CAN FD frame.
        bit_rate_switch: its data use the data bit rate of the bus.
    """

    can_id: int
    length: int
    mates: tuple[int, ...] = ()
    extended: bool = False
    fd: bool = False
    bit_rate_switch: bool = False

    @property
    def rank(self) -> int:
        """The priority: lower wins arbitration."""
        return rank_of(self.can_id, extended=self.extended)

    def longest_ns(self, traffic: CanTraffic) -> int:
        """Return its duration on that bus with the most stuff bits [ns]."""
        bits = longest(
            self.length, extended=self.extended, fd=self.fd, switched=self.bit_rate_switch
        )
        return bits.time_ns(traffic.bitrate_bit_s, traffic.data_bitrate_bit_s)


@final
@frozen
class Firing:
    """The frames and delays of one trigger.

    Attributes:
        bus: the bus of its frames; None: no frames.
        traffic: the other traffic there, including that of this program and its nodes.
        frames: sent in turn, each queued when the one before it has been received.
        idle_s: maximum delay other than that of the bus [s].
        latched_after: number of frames received when the first drive latches its command; the last
            drive latches with the last frame.
        idle_after_s: the part of `idle_s` that may follow the latch of the first drive, if no frame
            does [s].
    """

    bus: Hashable | None = None
    traffic: CanTraffic | None = None
    frames: tuple[OneFrame, ...] = ()
    idle_s: float = 0.0
    latched_after: int = 0
    idle_after_s: float = 0.0

    def rest(self) -> "Firing":
        """Return the rest of the trigger after the first drive has latched its command."""
        has_frames = self.latched_after < len(self.frames)
        idle_s = self.idle_s if has_frames else self.idle_after_s
        return Firing(self.bus, self.traffic, self.frames[self.latched_after :], idle_s)


@final
@frozen
class SyncOffer:
    """The capability of one motor's hardware for a common start with others.

    Attributes:
        level: the means of a common start.
        group: motors whose offers name an equal group (a bus) are fired by one trigger.
        latency_s: minimum and maximum time from the latch of the command to the start of motion
            [s]; None without a bound.
        reason: the reason for the level, in words ("RPDO 1 has transmission type 255").
        firing: frames and delays of `Trigger.fire`; None without a bound.
        signals: index of the signal, after the first one of the trigger, that latches the command:
            1 for the first step of a streamed set-point, latched by the second SYNC.
        signal_s: minimum and maximum time from the first signal of the trigger to that one [s];
            None without a bound. It is the same for motors with one trigger and equal `signals`.
        burst: the frame sent with those of the others just after a signal, if signals come every
            `period_s` [s] and cannot be delayed; None: armed earlier.
        oscillator_ppm: maximum error of the drive's clock, either way [1e-6]; None: unknown.
        end_s: minimum and maximum time from the planned end of the motion, by the drive's own
            clock, to its end [s]; None without a bound.
        no_firing_bound: reason for a missing bound of `firing` or `signal_s`, in words; else "".
        no_start_bound: reason for a missing bound of `latency_s`; else "".
        no_end_bound: reason for a missing bound of `oscillator_ppm` or `end_s`; else "".
    """

    level: SyncLevel
    group: Hashable
    latency_s: tuple[float, float] | None
    reason: str
    firing: Firing | None = None
    signals: int = 0
    signal_s: tuple[float, float] | None = (0.0, 0.0)
    burst: OneFrame | None = None
    period_s: float | None = None
    oscillator_ppm: float | None = None
    end_s: tuple[float, float] | None = None
    no_firing_bound: str = ""
    no_start_bound: str = ""
    no_end_bound: str = ""
