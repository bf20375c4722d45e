"""CPU time per frame on the emulated CAN bus."""

from random import Random
from time import process_time_ns

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from tests.benchmarks.workloads import best_us, bus, bus_traffic, one_by_one
from tests.support.can.noisy_bus import noisy_hours


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    frames = bus_traffic()
    rule = FaultRule("rare", FaultKind.DROP, probability=0.01)

    def with_faults() -> None:
        one_by_one(CanBus("can0", faults=FaultPlan([rule], Random(1).random)), frames)

    start_ns = process_time_ns()
    _, tally = noisy_hours(24)
    assert not tally.wrong, tally.wrong[:3]
    assert tally.confirmed == tally.submitted
    noisy_s = (process_time_ns() - start_ns) / 1e9
    return [
        ("CAN bus: 24 h, 20 frames/s, bit error rate 1e-6", noisy_s, "CPU s"),
        *bus(),
        ("CAN bus: with a fault rule", best_us(with_faults), "us"),
    ]


if __name__ == "__main__":
    for name, figure, unit in run():
        print(f"{name:32} {figure:8.2f} {unit}")
