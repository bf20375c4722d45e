"""Traffic on a CAN bus, declared and own: the basis of timing bounds.

Future frames cannot be observed, so they are declared: the messages of others, each with its
maximum rate. The frames of this program and its own drives are known here and added.

    declare_traffic(bus, CanTraffic(1_000_000, (PeriodicMessage(0x123, 8, period_s=0.01),)))

Without a declaration there is no bound. A declaration is a promise: any other frame on the bus
(from a further program, or an SDO transfer of another thread while motors are fired) breaks it. Bus
faults are not covered either.
"""

from collections.abc import Iterable, Sequence
from dataclasses import field, replace
from math import isfinite
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import UsageError

if TYPE_CHECKING:
    import can

_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_SHIFT_EFF: Final = 18
_LENGTH_MAX: Final = 8
FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_RATE_MAX_BIT_S: Final = 1_000_000
_DATA_RATE_MAX_BIT_S: Final = 20_000_000
_TIME_MAX_S: Final = 1e6
_PERIOD_MIN_S: Final = 1e-6


@final
@frozen
class PeriodicMessage:
    """Frames with one identifier, of one sender.

    Attributes:
        can_id: the identifier.
        length: maximum number of data bytes.
        period_s: minimum time between two frames, except for the jitter [s].
        jitter_s: maximum delay of a frame after its due time [s].
        extended: the identifier has 29 bits.
        fd: CAN FD frames; `length` is then one of FD_LENGTHS.
        bit_rate_switch: their data use the data bit rate of the bus.
    """

    can_id: int
    length: int
    period_s: float
    jitter_s: float = 0.0
    extended: bool = False
    fd: bool = False
    bit_rate_switch: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: a value is not a number, or out of range.
        """
        id_max = _EFF_MAX if self.extended else _SFF_MAX
        if not _is_whole(self.can_id) or not 0 <= self.can_id <= id_max:
            raise UsageError(f"can_id = {self.can_id!r}: must be 0 to {id_max:X}h")
        if self.bit_rate_switch and not self.fd:
            raise UsageError("bit_rate_switch = True: requires a CAN FD frame; give fd=True")
        if self.fd and (not _is_whole(self.length) or self.length not in FD_LENGTHS):
            lengths = ", ".join(str(one) for one in FD_LENGTHS[_LENGTH_MAX + 1 :])
            raise UsageError(f"length = {self.length!r}: a CAN FD frame has 0 to 8, {lengths}")
        if not self.fd and (not _is_whole(self.length) or not 0 <= self.length <= _LENGTH_MAX):
            raise UsageError(f"length = {self.length!r}: a frame has 0 to 8 data bytes")
        if not _is_number(self.period_s) or not _PERIOD_MIN_S <= self.period_s <= _TIME_MAX_S:
            raise UsageError(f"period_s = {self.period_s!r}: must be 1e-6 to 1e6 s")
        if not _is_number(self.jitter_s) or not 0.0 <= self.jitter_s <= _TIME_MAX_S:
            raise UsageError(f"jitter_s = {self.jitter_s!r}: must be 0 to 1e6 s")

    @property
    def name(self) -> str:
        """The name of the identifier in messages."""
        return f"{self.can_id:08X}h" if self.extended else f"{self.can_id:03X}h"

    @property
    def rank(self) -> int:
        """The priority: lower wins arbitration (ISO 11898-1: with equal base, the 11-bit one)."""
        return rank_of(self.can_id, extended=self.extended)


def rank_of(can_id: int, *, extended: bool = False) -> int:
    """Return the priority of an identifier: lower wins arbitration."""
    if extended:
        base, rest = can_id >> _SHIFT_EFF, can_id & (1 << _SHIFT_EFF) - 1
        return (base << 1 | 1) << _SHIFT_EFF | rest
    return can_id << 1 << _SHIFT_EFF


@final
@frozen
class CanTraffic:
    """All messages that may be sent on one bus.

    Attributes:
        bitrate_bit_s: nominal bit rate [bit/s].
        messages: one per identifier.
        queued: ranks of messages in the single FIFO queue of this program, which ignores priority.
        data_bitrate_bit_s: for CAN FD frames with a bit rate switch [bit/s]; None: their duration
            is that without a switch.
    """

    bitrate_bit_s: int
    messages: tuple[PeriodicMessage, ...] = ()
    queued: frozenset[int] = field(default_factory=frozenset)
    data_bitrate_bit_s: int | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: the bit rate is out of range, or two messages have one identifier.
        """
        rate = self.bitrate_bit_s
        if not _is_whole(rate) or not 1_000 <= rate <= _RATE_MAX_BIT_S:
            raise UsageError(f"bitrate_bit_s = {rate!r}: must be 1000 to 1000000 bit/s")
        fast = self.data_bitrate_bit_s
        if fast is not None and (not _is_whole(fast) or not rate <= fast <= _DATA_RATE_MAX_BIT_S):
            raise UsageError(f"data_bitrate_bit_s = {fast!r}: must be {rate} to 20000000 bit/s")
        ranks: set[int] = set()
        for message in self.messages:
            if not isinstance(message, PeriodicMessage):
                raise UsageError(f"{message!r} is not a message: give PeriodicMessage(...)")
            if message.rank in ranks:
                raise UsageError(
                    f"{message.name} is declared twice: an identifier has one sender; give the "
                    "shorter period and the greater length"
                )
            ranks.add(message.rank)

    def with_own(
        self,
        own: Iterable["NodeTraffic"],
        sync_period_s: float | None,
        streamed: Iterable[PeriodicMessage] = (),
    ) -> "CanTraffic":
        """Return the traffic with that of this program and its nodes; the worse one per identifier.

        Args:
            own: traffic of each node.
            sync_period_s: of a cyclic SYNC that is active or about to begin; None: no SYNC.
            streamed: set-points that this program sends or is about to send.
        """
        theirs: list[PeriodicMessage] = []
        ours: list[PeriodicMessage] = list(streamed)
        for node in own:
            theirs += node.sent
            ours += node.ours
            if sync_period_s is not None:
                theirs += [replace_period(one, sync_period_s) for one in node.sent_at_sync]
                ours += [replace_period(one, sync_period_s) for one in node.ours_at_sync]
        if sync_period_s is not None:
            ours.append(PeriodicMessage(SYNC_ID, 0, sync_period_s))
        return CanTraffic(
            self.bitrate_bit_s,
            worst_of([*self.messages, *theirs, *ours]),
            self.queued | frozenset(one.rank for one in ours),
            self.data_bitrate_bit_s,
        )


SYNC_ID: Final = 0x080


def replace_period(message: PeriodicMessage, period_s: float) -> PeriodicMessage:
    """Return the message with another period, and jitter in the same proportion."""
    share = message.jitter_s / message.period_s
    return replace(message, period_s=period_s, jitter_s=share * period_s)


def worst_of(messages: Sequence[PeriodicMessage]) -> tuple[PeriodicMessage, ...]:
    """Return one message per identifier that is at least as bad as all of that identifier.

    A CAN FD frame without a bit rate switch is longer than a classical one.
    """
    found: dict[int, PeriodicMessage] = {}
    for message in messages:
        known = found.get(message.rank)
        if known is not None and known != message:
            message = replace(
                message,
                length=max(message.length, known.length),
                period_s=min(message.period_s, known.period_s),
                jitter_s=max(message.jitter_s, known.jitter_s),
                fd=message.fd or known.fd,
                bit_rate_switch=message.bit_rate_switch and known.bit_rate_switch,
            )
        found[message.rank] = message
    return tuple(found[rank] for rank in sorted(found))


@final
@frozen
class NodeTraffic:
    """The traffic of a configured node, and that of this program because of it.

    Attributes:
        sent: by the node.
        ours: by this program.
        sent_at_sync: by the node, once per cyclic SYNC; likewise `ours_at_sync` by this program.
            Their period is that of SYNC, and their jitter the same fraction of it as here.
        unknown: its unbounded traffic, in words, or "".
    """

    sent: tuple[PeriodicMessage, ...] = ()
    ours: tuple[PeriodicMessage, ...] = ()
    sent_at_sync: tuple[PeriodicMessage, ...] = ()
    ours_at_sync: tuple[PeriodicMessage, ...] = ()
    unknown: str = ""


@final
class _BusTraffic:
    """The traffic known on one bus."""

    def __init__(self) -> None:
        self.declared: CanTraffic | None = None
        self.nodes: Final[dict[int, NodeTraffic]] = {}
        self.streams: Final[dict[int, PeriodicMessage]] = {}


def declare_traffic(bus: "can.BusABC", traffic: CanTraffic | None) -> None:
    """Declare all traffic on `bus` other than that of this program and its drives.

    Args:
        bus: the bus object of the motors.
        traffic: that of others; None: withdraw the declaration.

    Raises:
        UsageError: `traffic` is not a CanTraffic.
    """
    if not isinstance(traffic, CanTraffic | None):
        raise UsageError(f"{traffic!r} is not a CanTraffic")
    _known(bus).declared = traffic


def declared_traffic(bus: "can.BusABC") -> CanTraffic | None:
    """Return the declaration for this bus object, or None."""
    return _known(bus).declared


def note_node(bus: "can.BusABC", node_id: int, traffic: NodeTraffic) -> None:
    """Record the traffic of a node that this program has configured."""
    _known(bus).nodes[node_id] = traffic


def own_traffic(bus: "can.BusABC") -> tuple[NodeTraffic, ...]:
    """Return the traffic of all nodes that this program has configured on the bus, by node-ID."""
    return tuple(traffic for _, traffic in sorted(_known(bus).nodes.items()))


def note_stream(bus: "can.BusABC", can_id: int, message: PeriodicMessage | None) -> None:
    """Record the set-points that this program sends with this identifier; None: no more."""
    if message is None:
        _known(bus).streams.pop(can_id, None)
    else:
        _known(bus).streams[can_id] = message


def streams(bus: "can.BusABC") -> tuple[PeriodicMessage, ...]:
    """Return the set-points that this program sends on the bus."""
    return tuple(message for _, message in sorted(_known(bus).streams.items()))


def _known(bus: "can.BusABC") -> _BusTraffic:
    return context_of(bus).parts.part(_BusTraffic)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
