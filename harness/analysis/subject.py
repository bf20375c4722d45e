"""A bus as it was found in a rig or a recording, and all that the analysis says of it."""

from dataclasses import dataclass
from typing import Final, final

from harness.analysis.clocks import Clock
from harness.analysis.errors import NO_ERRORS, ErrorModel
from harness.analysis.identifiers import Proposal, Reserved, propose
from harness.analysis.margins import (
    Tolerance,
    queues_that_help,
    rate_that_helps,
    shortest_error_interval_ns,
    tolerances,
)
from harness.analysis.message import BusLoad
from harness.analysis.recorded import Measured
from harness.analysis.response_time import Response, are_in_time, response_times


@final
@dataclass(frozen=True, slots=True)
class Queues:
    """How nodes queue what they send.

    Attributes:
        fifo: all of them in one queue, first in, first out, or none; None: as each is set up.
        by_priority: those that are set up to send their most urgent frame first.
    """

    fifo: bool | None = None
    by_priority: frozenset[str] = frozenset()

    def one_each(self, senders: frozenset[str]) -> frozenset[str]:
        """Which of these have one queue, first in, first out."""
        if self.fifo is None:
            return senders - self.by_priority
        return senders if self.fifo else frozenset()


@final
@dataclass(frozen=True, slots=True)
class Sync:
    """A SYNC that was recorded: its identifier, as `Message.label` has it, and its clock."""

    label: str
    clock: Clock


@final
@dataclass(frozen=True, slots=True)
class Subject:
    """A bus that is to be analysed.

    Attributes:
        load: what is sent on it.
        is_reserved: identifiers that nothing may be moved to.
        recorded: what was measured of each message; a rig has none.
        measured: the share of the bus that was used while it was recorded; None: not known.
        notes: what whoever reads the results must know, a line each.
        sync: what was measured of SYNC; None: it was not recorded, or is not periodic.
    """

    load: BusLoad
    is_reserved: Reserved
    recorded: tuple[Measured, ...] = ()
    measured: float | None = None
    notes: tuple[str, ...] = ()
    sync: Sync | None = None


@final
@dataclass(frozen=True, slots=True)
class Remedy:
    """What would bring every message in time.

    Attributes:
        proposal: which identifiers to change.
        queues: senders that would have to send their most urgent frame first; None: no help.
        rate_bit_s: the lowest usual bit rate that helps; None: none does.
    """

    proposal: Proposal
    queues: tuple[str, ...] | None
    rate_bit_s: int | None


@final
@dataclass(frozen=True, slots=True)
class Findings:
    """What was found of a bus.

    Attributes:
        subject: the bus.
        errors: what was let strike.
        responses: the most urgent first.
        remedy: None: all are in time.
        interval_ns: errors no closer than this, after the burst, make nobody late; None: not even
            the burst is stood.
        tolerances: of every message with a deadline, the most urgent first.
    """

    subject: Subject
    errors: ErrorModel
    responses: tuple[Response, ...]
    remedy: Remedy | None
    interval_ns: int | None
    tolerances: tuple[Tolerance, ...]

    @property
    def late(self) -> tuple[Response, ...]:
        """Those that miss their deadlines."""
        return tuple(one for one in self.responses if one.is_in_time is False)


def analyse(subject: Subject, errors: ErrorModel = NO_ERRORS) -> Findings:
    """All of it."""
    load = subject.load
    remedy = None
    if not are_in_time(load, errors):
        remedy = Remedy(
            propose(load, errors, subject.is_reserved),
            queues_that_help(load, errors),
            rate_that_helps(load, errors),
        )
    return Findings(
        subject=subject,
        errors=errors,
        responses=response_times(load, errors),
        remedy=remedy,
        interval_ns=shortest_error_interval_ns(load, max(1, errors.burst)),
        tolerances=tolerances(load),
    )


_RESTRICTED: Final = (
    *((0x000, 0x080), (0x081, 0x0FF), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F)),
    *((0x6E0, 0x6FF), (0x701, 0x7FF)),
)


def is_canopen_reserved(identifier: int, extended: bool) -> bool:
    """Whether no PDO may have it on a CANopen bus: NMT, SYNC, EMCY, SDO, heartbeat and the rest.

    Source: CiA 301, restricted CAN-IDs; EMCY where nobody has moved it.
    """
    return not extended and any(low <= identifier <= high for low, high in _RESTRICTED)


def reserves_nothing(identifier: int, extended: bool) -> bool:
    """No identifier is reserved."""
    return False
