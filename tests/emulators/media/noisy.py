"""A bus with modest traffic and bit errors, for hours: two TPDOs every 100 ms at 500 kbit/s."""

import random

from emulators.media.can_bus import CanBus
from emulators.media.can_frame import pack
from emulators.media.delivery import HEARD, KIND_MASK, TOLD
from emulators.media.fault_rule import FaultKind, FaultRule
from emulators.media.faults import FaultPlan

PERIOD_NS = 100_000_000
HOUR_NS = 3600 * 10**9


def noisy_hours(hours: int, rate: float = 1e-6, seed: int = 1) -> tuple[CanBus, list[int]]:
    """The bus afterwards; [frames submitted, confirmed, heard by the third node]."""
    noise = FaultRule("noise", FaultKind.NOISE, bit_error_rate=rate)
    bus = CanBus("can0", 500_000, FaultPlan([noise], random.Random(seed).random))
    for name in ("left", "right", "host"):
        bus.attach(name)
    counts = [0, 0, 0]
    for turn in range(hours * HOUR_NS // PERIOD_NS):
        now_ns = turn * PERIOD_NS
        for port in (0, 1):
            bus.submit(port, pack(0x181 + port, turn.to_bytes(8, "little")), now_ns)
            counts[0] += 1
        due_ns = bus.next_deadline_ns()
        while due_ns is not None and due_ns < now_ns + PERIOD_NS:
            for _, _, kind in bus.expire(due_ns):
                if kind & KIND_MASK != TOLD:
                    counts[1] += kind & KIND_MASK != HEARD
                    counts[2] += 1
            due_ns = bus.next_deadline_ns()
    return bus, counts
