"""Running a bus in tests: deliveries and their times."""

from collections.abc import Iterable

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.port import KIND_MASK, TOLD, Delivery, confirms, hears

BIT = 1000  # [ns] at 1 Mbit/s
Submission = tuple[int, int, bytes]  # (time [ns], port, frame)
Timed = tuple[int, Delivery]


def run(bus: CanBus, submissions: Iterable[Submission] = (), until_ns: int = 10**12) -> list[Timed]:
    """Return all deliveries of the bus, called at every deadline with submissions in time."""
    deliveries: list[Timed] = []
    for time_ns, port, frame in submissions:
        deliveries += expire_all(bus, time_ns)
        bus.submit(port, frame, time_ns)
    return deliveries + expire_all(bus, until_ns)


def expire_all(bus: CanBus, until_ns: int) -> list[Timed]:
    deliveries: list[Timed] = []
    due_ns = bus.next_deadline_ns()
    while due_ns is not None and due_ns <= until_ns:
        deliveries += [(due_ns, delivery) for delivery in bus.expire(due_ns)]
        again_ns = bus.next_deadline_ns()
        assert again_ns is None or again_ns > due_ns, "a deadline that does not pass"
        due_ns = again_ns
    return deliveries


def heard(deliveries: Iterable[Timed], port: int) -> list[tuple[int, bytes]]:
    """Return the frames that this port receives, with their times."""
    return [
        (time_ns, frame)
        for time_ns, (frame, sender, kind) in deliveries
        if sender != port and hears(kind, port)
    ]


def confirmed(deliveries: Iterable[Timed], port: int) -> list[tuple[int, bytes]]:
    """Return the frames confirmed to this port, with their times."""
    return [
        (time_ns, frame)
        for time_ns, (frame, sender, kind) in deliveries
        if sender == port and confirms(kind)
    ]


def traffic(deliveries: Iterable[Timed]) -> list[Timed]:
    """Return the frames on the wire, without error messages."""
    return [one for one in deliveries if one[1][2] & KIND_MASK != TOLD]
