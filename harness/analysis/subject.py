"""Subject of the analysis (a bus of a rig or a recording), and its results."""

from dataclasses import replace
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.analysis.advice import (
    Proposal,
    Reserved,
    Tolerance,
    propose,
    queues_that_help,
    rate_that_helps,
    shortest_error_interval_ns,
    tolerances,
)
from motorhil.harness.analysis.measured import Clock, Measured
from motorhil.motorapi.synchronization.can_response_time import (
    NO_ERRORS,
    BusLoad,
    Effort,
    ErrorModel,
    Response,
    response_times,
)

_STEPS: Final = {
    "response times": 1_000_000,
    "identifiers": 1_000_000,
    "queues": 250_000,
    "bit rates": 250_000,
    "error interval": 2_500_000,
    "tolerated errors": 5_000_000,
}
"""Limits of the parts of an analysis, for all of its buses: some seconds."""


@final
@frozen
class Queues:
    """The queueing of messages in nodes.

    Attributes:
        fifo: True: all nodes have one FIFO queue; False: none; None: as each node is configured.
        by_priority: nodes configured to send their most urgent message first.
    """

    fifo: bool | None = None
    by_priority: frozenset[str] = frozenset()

    def one_each(self, senders: frozenset[str]) -> frozenset[str]:
        """Return those of the senders that have one FIFO queue."""
        if self.fifo is None:
            return senders - self.by_priority
        return senders if self.fifo else frozenset()


@final
@frozen
class Sync:
    """A recorded SYNC: its identifier in the form of `Message.label`, and its clock."""

    label: str
    clock: Clock


@final
@frozen
class Subject:
    """A bus to analyse.

    Attributes:
        load: the messages on it.
        is_reserved: predicate of identifiers that must not be assigned.
        recorded: the measurements of each message; empty for a rig.
        measured: the recorded utilisation of the bus; None: unknown.
        notes: remarks for the reader of the results, one line each.
        sync: the measured SYNC; None: not recorded, or not periodic.
    """

    load: BusLoad
    is_reserved: Reserved
    recorded: tuple[Measured, ...] = ()
    measured: float | None = None
    notes: tuple[str, ...] = ()
    sync: Sync | None = None


@final
@frozen
class Remedy:
    """Measures that would bring every message in time.

    Attributes:
        proposal: the identifiers to change.
        queues: senders that would have to send by priority; None: no help.
        rate_bit_s: the lowest usual bit rate that helps [bit/s]; None: none does.
    """

    proposal: Proposal
    queues: tuple[str, ...] | None
    rate_bit_s: int | None


@final
@frozen
class Findings:
    """The results for a bus.

    Attributes:
        subject: the bus.
        errors: the error model.
        responses: worst cases, the most urgent message first.
        remedy: helpful measures; None: all messages are in time.
        interval_ns: the shortest error interval after the burst that makes no message late [ns];
            None: the burst alone makes a message late.
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
        """The messages that miss their deadlines."""
        return tuple(one for one in self.responses if one.is_in_time is False)


def analyse(subject: Subject, errors: ErrorModel = NO_ERRORS, buses: int = 1) -> Findings:
    """Analyse a bus: response times, remedies, and margins, each with a limited effort.

    If the effort is not sufficient, a note says so.

    Args:
        subject: the bus.
        errors: the error model.
        buses: the number of buses that share the effort.
    """
    load = subject.load
    efforts = {name: Effort(steps // buses) for name, steps in _STEPS.items()}
    responses = response_times(load, errors, efforts["response times"])
    remedy = None
    if any(one.is_in_time is False for one in responses):
        remedy = Remedy(
            propose(load, errors, subject.is_reserved, efforts["identifiers"]),
            queues_that_help(load, errors, efforts["queues"]),
            rate_that_helps(load, errors, efforts["bit rates"]),
        )
    interval_ns = shortest_error_interval_ns(load, max(1, errors.burst), efforts["error interval"])
    found = tolerances(load, efforts["tolerated errors"])
    ended = [
        f"{name} ({_STEPS[name] // buses:,})"
        for name, effort in efforts.items()
        if effort.is_over()
    ]
    if ended:
        text = f"ended early, so that more may be possible (steps): {', '.join(ended)}"
        subject = replace(subject, notes=(*subject.notes, text))
    return Findings(subject, errors, responses, remedy, interval_ns, found)


_RESTRICTED: Final = (
    *((0x000, 0x080), (0x081, 0x0FF), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F)),
    *((0x6E0, 0x6FF), (0x701, 0x7FF)),
)


def is_canopen_reserved(identifier: int, extended: bool) -> bool:
    """Return True if the identifier is not available for PDOs (NMT, SYNC, EMCY, SDO, ...).

    Source: CiA 301, restricted CAN-IDs; EMCY with its default COB-ID.
    """
    return not extended and any(low <= identifier <= high for low, high in _RESTRICTED)


def reserves_nothing(identifier: int, extended: bool) -> bool:
    """Return False: no identifier is reserved."""
    return False
