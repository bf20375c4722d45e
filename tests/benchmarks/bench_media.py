"""What a frame costs on the emulated CAN bus, in CPU time of this process."""

from collections.abc import Callable
from random import Random
from time import process_time_ns

from emulators.media.can_bits import frame_bits
from emulators.media.can_bus import CanBus
from emulators.media.can_frame import pack
from emulators.media.faults import FaultKind, FaultPlan, FaultRule
from tests.emulators.media.noisy import noisy_hours

FRAMES = 5_000
ROUNDS = 15


def _traffic() -> list[bytes]:
    """TPDOs of 14 nodes, 8 bytes of data, no two alike."""
    draw = Random("bench_media")
    return [pack(0x181 + number % 14, draw.randbytes(8)) for number in range(FRAMES)]


def _best_us(work: Callable[[], None]) -> float:
    """The fastest of some rounds, per frame [us]: other work on the machine only adds."""
    best_ns = 0
    for _ in range(ROUNDS):
        start_ns = process_time_ns()
        work()
        took_ns = process_time_ns() - start_ns
        best_ns = min(best_ns, took_ns) or took_ns
    return best_ns / FRAMES / 1000


def _lengths(frames: list[bytes]) -> None:
    for frame in frames:
        frame_bits(frame)


def _alone(bus: CanBus, frames: list[bytes]) -> None:
    """Each frame is submitted when the one before has gone."""
    port = bus.attach("node")
    bus.attach("host")
    now_ns = 0
    for frame in frames:
        bus.submit(port, frame, now_ns)
        due_ns = bus.next_deadline_ns()
        while due_ns is not None:
            now_ns = due_ns
            bus.expire(now_ns)
            due_ns = bus.next_deadline_ns()
        now_ns += 10_000


def _contended(bus: CanBus, frames: list[bytes]) -> None:
    """14 nodes answer at the same time, as to a SYNC."""
    for number in range(14):
        bus.attach(f"node {number}")
    now_ns = 0
    for first in range(0, len(frames), 14):
        for port, frame in enumerate(frames[first : first + 14]):
            bus.submit(port, frame, now_ns)
        due_ns = bus.next_deadline_ns()
        while due_ns is not None:
            now_ns = due_ns
            bus.expire(now_ns)
            due_ns = bus.next_deadline_ns()


def run() -> list[tuple[str, float, str]]:
    """(name, figure, unit) of each measurement."""
    frames = _traffic()
    rule = FaultRule("rare", FaultKind.DROP, probability=0.01)

    def with_faults() -> None:
        _alone(CanBus("can0", faults=FaultPlan([rule], Random(1).random)), frames)

    start_ns = process_time_ns()
    _, tally = noisy_hours(24)
    assert not tally.wrong, tally.wrong[:3]
    assert tally.confirmed == tally.submitted
    noisy_s = (process_time_ns() - start_ns) / 1e9
    return [
        ("CAN bus: 24 h, 20 frames/s, bit error rate 1e-6", noisy_s, "CPU s"),
        ("CAN frame length, 8 bytes", _best_us(lambda: _lengths(frames)), "us"),
        ("CAN bus: submit to expire", _best_us(lambda: _alone(CanBus("can0"), frames)), "us"),
        ("CAN bus: of 14 at once", _best_us(lambda: _contended(CanBus("can0"), frames)), "us"),
        ("CAN bus: with a fault rule", _best_us(with_faults), "us"),
    ]


if __name__ == "__main__":
    for name, figure, unit in run():
        print(f"{name:32} {figure:8.2f} {unit}")
