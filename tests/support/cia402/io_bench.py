"""An I/O node on the bench of the drives."""

import struct
from pathlib import Path

from motorhil.emulators.cia401.node import IoNode, build
from motorhil.emulators.controller import ControllerContext
from tests.support.cia402.bench import MS, NODE, Bench

HOST = 127


def new_node(folder: Path = Path(), **settings: object) -> IoNode:
    table = {"node_id": NODE, **settings}
    node = build(table, ControllerContext(name="io", folder=folder, seed=1))
    assert isinstance(node, IoNode)
    return node


class IoBench(Bench):
    """A `Bench` with the operations of an I/O node."""

    def __init__(self, **settings: object) -> None:
        super().__init__(drive=new_node(**settings))

    def outputs(self, *raw: int) -> None:
        """Send RPDO 2 with its default mapping: analogue outputs, at once."""
        self.send(0x300 + NODE, struct.pack(f"<{len(raw)}h", *raw))

    def enables(self, bits: int) -> None:
        """Send RPDO 1: digital outputs."""
        self.send(0x200 + NODE, bytes((bits,)))

    def ready(self) -> "IoBench":
        """Bring the node to OPERATIONAL with all amplifiers enabled and ready."""
        self.operational()
        self.enables(0xFF)
        self.run(6 * MS)
        return self

    def heartbeat(self) -> None:
        self.send(0x700 + HOST, b"\x05")

    def watch_host(self, within_ms: int = 100) -> None:
        self.set(0x1016, 1, HOST << 16 | within_ms, 4)
        self.heartbeat()

    def counts(self) -> tuple[int, int]:
        """Return the two counters in TPDO 2 of a SYNC now."""
        self.sync()
        return struct.unpack("<ii", self.last(0x280 + NODE))
