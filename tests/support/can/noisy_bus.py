"""A bus with modest traffic and bit errors for hours.

Two nodes send a TPDO each every 100 ms at 500 kbit/s.
"""

import random
from dataclasses import dataclass, field

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.bus.port import KIND_MASK, TOLD, Delivery, confirms, hears
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import pack

PERIOD_NS = 100_000_000
HOUR_NS = 3600 * 10**9
HOST = 2


@dataclass
class Tally:
    """The fate of each frame; numbered frames reveal losses and duplicates."""

    submitted: int = 0
    confirmed: int = 0
    doubled: int = 0  # received again by the third node, after the sender's error
    wrong: list[str] = field(default_factory=list)  # frames lost, or duplicated without an error
    _heard: list[int] = field(default_factory=lambda: [-1, -1])  # last number, by sender
    _failed: list[bool] = field(default_factory=lambda: [False, False])  # since it was sent

    def hear(self, delivery: Delivery) -> None:
        frame, sender, kind = delivery
        if kind & KIND_MASK == TOLD:
            if frame[10] & told.TRANSMITTING and frame[11] == told.END_OF_FRAME:
                self._failed[sender] = True
            return
        self.confirmed += confirms(kind)
        if hears(kind, HOST):
            self._count(int.from_bytes(frame[8:16], "little"), sender)
        if confirms(kind):
            self._failed[sender] = False

    def _count(self, number: int, sender: int) -> None:
        before = self._heard[sender]
        if number == before and self._failed[sender]:
            self.doubled += 1
        elif number == before:
            self.wrong.append(f"{number} of {sender} came twice")
        elif number != before + 1:
            self.wrong.append(f"{before + 1} of {sender} is lost")
        self._heard[sender] = number


def noisy_hours(
    hours: int, rate: float = 1e-6, seed: int = 1, planted: tuple[FaultRule, ...] = ()
) -> tuple[CanBus, Tally]:
    """Run the bus and return it with the tally of its frames."""
    noise = FaultRule("noise", FaultKind.NOISE, bit_error_rate=rate)
    bus = CanBus("can0", 500_000, FaultPlan([noise, *planted], random.Random(seed).random))
    for name in ("left", "right", "host"):
        bus.attach(name)
    tally = Tally()
    for turn in range(hours * HOUR_NS // PERIOD_NS):
        now_ns = turn * PERIOD_NS
        for port in (0, 1):
            bus.submit(port, pack(0x181 + port, turn.to_bytes(8, "little")), now_ns)
            tally.submitted += 1
        due_ns = bus.next_deadline_ns()
        while due_ns is not None and due_ns < now_ns + PERIOD_NS:
            for delivery in bus.expire(due_ns):
                tally.hear(delivery)
            due_ns = bus.next_deadline_ns()
    return bus, tally
