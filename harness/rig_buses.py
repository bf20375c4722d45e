"""`[bus.NAME]` tables of a rig: CAN buses and Modbus lines.

kind = "can"          bitrate_bit_s, data_bitrate_bit_s (CAN FD), [[bus.NAME.message]],
                      [bus.NAME.node.NAME]
kind = "modbus_rtu"   a serial line: baud_bit_s, parity, stop_bits
kind = "modbus_tcp"   a gateway: latency_s, timeout_s
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, final

from emulators.media.can_node import CanNode, FrameSupport
from harness.rig_nodes import read_nodes, silent_nodes
from harness.rig_traffic import read_messages
from harness.settings import Table

if TYPE_CHECKING:
    from motorapi.traffic import PeriodicMessage

CAN: Final = "can"
MODBUS_RTU: Final = "modbus_rtu"
MODBUS_TCP: Final = "modbus_tcp"
BUS_KINDS: Final = (CAN, MODBUS_RTU, MODBUS_TCP)
LINES: Final = (MODBUS_RTU, MODBUS_TCP)
PARITIES: Final = ("E", "O", "N")

NODE_MAX: Final = 127
UNIT_MAX: Final = 247

_SECOND_NS: Final = 1_000_000_000
_KEYS: Final = {
    CAN: ("bitrate_bit_s", "data_bitrate_bit_s", "message", "node"),
    MODBUS_RTU: ("baud_bit_s", "parity", "stop_bits"),
    MODBUS_TCP: ("latency_s", "timeout_s"),
}
BUS_KEYS: Final = ("kind", *(key for keys in _KEYS.values() for key in keys))
_DATA_RATE_MAX: Final = 20_000_000
_BAUD: Final = 19_200
_LATENCY_S: Final = 50e-6


@final
@dataclass(frozen=True, slots=True)
class BusDescription:
    """A bus.

    Attributes:
        name: name in the rig.
        kind: one of BUS_KINDS.
        bitrate_bit_s: bit rate of a CAN bus, which divides 1e9 so that a bit lasts a whole number
            of
            nanoseconds; baud rate of a serial line; 0 for a gateway.
        data_bitrate_bit_s: bit rate of CAN FD frames between BRS and CRC delimiter, with the same
            limit as bitrate_bit_s; None for classical CAN.
        messages: messages that others send (CAN); None if its traffic is not declared.
        nodes: CAN controllers with special settings, by controller or "host".
        silent: those of `nodes` that are not controllers of the rig and only acknowledge.
        parity, stop_bits: of a serial line.
        latency_ns: delay of a gateway from sending to arrival [ns].
        timeout_ns: how long a gateway waits for a unit before it answers itself with exception
            code 0Bh [ns].
    """

    name: str
    kind: str
    bitrate_bit_s: int
    messages: "tuple[PeriodicMessage, ...] | None" = None
    nodes: Mapping[str, CanNode] = field(default_factory=dict)
    silent: tuple[str, ...] = ()
    parity: str = "E"
    stop_bits: int = 1
    latency_ns: int = 0
    timeout_ns: int = _SECOND_NS
    data_bitrate_bit_s: int | None = None

    @property
    def is_line(self) -> bool:
        """True for a Modbus line, whose controllers have units instead of node-IDs."""
        return self.kind in LINES

    def destroyers(self, controllers: Sequence[str]) -> list[str]:
        """Return the nodes that destroy CAN FD frames of this bus; none on a classical bus.

        Args:
            controllers: names of the controllers on the bus.
        """
        if self.data_bitrate_bit_s is None:
            return []
        plain = [name for name in controllers if name not in self.nodes]
        told = [name for name, chip in self.nodes.items() if chip.frames is FrameSupport.CLASSICAL]
        return plain + told


def read_bus(name: str, table: Table) -> BusDescription:
    """Read the bus of a table.

    Raises:
        RigError: the first error in the table.
    """
    kind = table.one_of("kind", BUS_KINDS, "bus kind", default=CAN)
    for key in table.values:
        owner = next((one for one, keys in _KEYS.items() if key in keys), kind)
        if owner != kind:
            raise table.error(key, f'belongs to kind "{owner}"', f'this bus is of kind "{kind}"')
    table.refuse_unknown(("kind", *_KEYS[kind]))
    if kind == MODBUS_RTU:
        return BusDescription(
            name,
            kind,
            table.integer("baud_bit_s", _BAUD, low=300, high=10_000_000, unit="bit/s"),
            parity=table.one_of("parity", PARITIES, "parity", default="E"),
            stop_bits=table.integer("stop_bits", 1, low=1, high=2),
        )
    if kind == MODBUS_TCP:
        latency_s = table.number("latency_s", _LATENCY_S, low=0.0, high=10.0, unit="s")
        timeout_s = table.number("timeout_s", 1.0, low=0.01, high=3600.0, unit="s")
        latency_ns, timeout_ns = round(latency_s * 1e9), round(timeout_s * 1e9)
        return BusDescription(name, kind, 0, latency_ns=latency_ns, timeout_ns=timeout_ns)
    return _can(name, table)


def _can(name: str, table: Table) -> BusDescription:
    rate = table.integer(
        "bitrate_bit_s", low=1_000, high=1_000_000, unit="bit/s", example="1_000_000"
    )
    if _SECOND_NS % rate:
        raise table.error(
            "bitrate_bit_s",
            f"a bit of {rate} bit/s is not a whole number of nanoseconds",
            "usual: 1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000",
        )
    data_rate = _data_bitrate(table, rate)
    messages = read_messages(table, rate, data_rate)
    nodes, silent = read_nodes(table), silent_nodes(table)
    return BusDescription(name, CAN, rate, messages, nodes, silent, data_bitrate_bit_s=data_rate)


def _data_bitrate(table: Table, rate: int) -> int | None:
    key = "data_bitrate_bit_s"
    if not table.has(key):
        return None
    data_rate = table.integer(key, low=rate, high=_DATA_RATE_MAX, unit="bit/s")
    if _SECOND_NS % data_rate:
        raise table.error(
            key,
            f"a bit of {data_rate} bit/s is not a whole number of nanoseconds",
            "usual: 8_000_000, 5_000_000, 4_000_000, 2_000_000, 1_000_000",
        )
    return data_rate


def address_key(bus: BusDescription) -> str:
    """Return the key of the address of this bus's controllers."""
    return "unit" if bus.is_line else "node_id"


def read_address(table: Table, bus: BusDescription) -> int | None:
    """Return the address of a controller (or of a motor's) on the bus, or None without one.

    Raises:
        RigError: the address is out of range, or has the key of another kind of bus.
    """
    key = address_key(bus)
    other = "node_id" if bus.is_line else "unit"
    if table.has(other):
        of = "Modbus controllers have a unit" if bus.is_line else "a CAN bus has node-IDs"
        raise table.error(other, f'bus "{bus.name}" is of kind {bus.kind}: {of}', f"write {key}")
    if not table.has(key):
        return None
    low, high = (1, UNIT_MAX) if bus.is_line else (0, NODE_MAX)
    return table.integer(key, low=low, high=high, example="1")
