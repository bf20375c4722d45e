"""A bus of three nodes with faults, for tests."""

import random

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import pack
from tests.support.can.deliveries import BIT

SYNC = pack(0x080)  # 51 bits with intermission (can-utils, can-physics.md 6.2)
STATUS = pack(0x181, bytes.fromhex("3706"))  # 66 bits
HEARTBEAT = pack(0x701, b"\x05")  # 58 bits
LEFT, RIGHT, HOST = 0, 1, 2
NAMES = ("left", "right", "host")


def bus_with(*rules: FaultRule, seed: int = 1) -> CanBus:
    bus = CanBus("can0", faults=FaultPlan(rules, random.Random(seed).random))
    for name in NAMES:
        bus.attach(name)
    return bus


END = 48 * BIT  # of a SYNC submitted at 0


def cut(from_ns: int, until_ns: int | None, *ports: str) -> FaultRule:
    return FaultRule("cable", FaultKind.CUT, ports=ports, from_ns=from_ns, until_ns=until_ns)


def no_draw() -> float:
    raise AssertionError("a draw where none is needed")
