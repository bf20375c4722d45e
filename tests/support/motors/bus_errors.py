"""Injected error messages of a CAN controller to its own host."""

import struct
from collections.abc import Callable
from typing import Final

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig

MS = 1_000_000

# linux/can/error.h: data[1] state of the controller, data[6] TEC, data[7] REC
WARNING: Final = "20000204#0008000000006000"
PASSIVE: Final = "20000204#0020000000008000"
ACTIVE: Final = "20000004#0040000000000000"
OFF: Final = "20000040#0000000000000000"
RESTARTED: Final = "20000100#0000000000000000"
NO_ACKNOWLEDGE: Final = "200000A8#0000001900000000"


def message(text: str) -> bytes:
    can_id, _, data = text.partition("#")
    return struct.pack("<IB3x8s", int(can_id, 16), 8, bytes.fromhex(data))


def tell(rig: Rig, text: str, name: str = "host", bus: str = "can0") -> None:
    """Send the error message of that name to the host now."""
    segment = rig.world._segments[bus]
    endpoint = next(one for one in segment._by_port if one.name == name)
    endpoint.told(message(text), rig.runtime.now_ns())


def tell_at(rig: Rig, time_ns: int, text: str, name: str = "host") -> None:
    at(rig, time_ns, lambda: tell(rig, text, name))


def at(rig: Rig, time_ns: int, action: Callable[[], None]) -> None:
    rig.world.queue.alarm(lambda _now_ns: action()).set(time_ns)


def go_off(rig: Rig, off_ns: int, length_ns: int) -> None:
    """Cut the host off the bus for a time, and inject the bus-off message."""
    rule = FaultRule(
        f"off-{off_ns}", FaultKind.CUT, ports=("host",), from_ns=off_ns, until_ns=off_ns + length_ns
    )
    rig.faults.inject("can0", rule)
    tell_at(rig, off_ns, OFF)
    tell_at(rig, off_ns + length_ns, RESTARTED)
