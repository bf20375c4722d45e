"""`[bus.NAME]` tables of a rig: CAN buses and Modbus lines.

kind = "can"          bitrate_bit_s, data_bitrate_bit_s (CAN FD), [[bus.NAME.message]],
                      [bus.NAME.node.NAME]
kind = "modbus_rtu"   a serial line: baud_bit_s, parity, stop_bits
kind = "modbus_tcp"   a gateway: latency_s, timeout_s

`[bus.NAME.node.NAME]` tables of a rig: settings of CAN controllers.

queue = "fifo"            or "priority": which of its pending frames competes
frames = "classical"      or "fd_tolerant", "fd": frames that it supports; hosts on a bus with a
                          data bit rate are "fd"
one_shot = false          true: no retransmission after an error or a lost arbitration
recovery_s = 0.0          delay after bus-off before it counts the 128 x 11 recessive bits;
                          or "command"
error_reporting = false   true: reports every error, not only changes of its state
oscillator_ppm = 0.0      clock error of its CAN controller, positive if fast; default: the
                          `oscillator` of the controller's own table
time_quanta = 16          per bit time; with sample_point = 14 and jump_width = 1 of them
silent = false            true: not a controller of the rig, but a node that only acknowledges
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, final

from motorhil.emulators.can.controller_config import (
    USUAL_TIMING,
    BitTiming,
    CanNode,
    FrameSupport,
    QueueOrder,
)
from motorhil.emulators.simulation.can_network import HOST
from motorhil.harness.rig.config.bus_load import read_messages
from motorhil.harness.rig.config.toml import Source, Table

if TYPE_CHECKING:
    from motorhil.motorapi.synchronization.bus_load import PeriodicMessage

_TIMING: Final = ("time_quanta", "sample_point", "jump_width")
NODE_KEYS: Final = (
    *("queue", "frames", "one_shot", "recovery_s", "error_reporting", "oscillator_ppm"),
    *_TIMING,
    "silent",
)
PPM_MAX: Final = 100_000.0
QUANTA_MAX: Final = 400
QUEUES: Final = tuple(order.value for order in QueueOrder)
SUPPORTS: Final = tuple(support.value for support in FrameSupport)
BY_COMMAND: Final = "command"
RECOVERY_MAX_S: Final = 1e6


def read_nodes(bus: Table) -> Mapping[str, CanNode]:
    """Read the CAN controllers that a bus's table configures, by node.

    Raises:
        RigError: the first error in them.
    """
    tables = bus.table("node")
    fd = bus.has("data_bitrate_bit_s")
    chips = {name: _chip(name, tables.table(name), fd) for name in tables.values}
    return MappingProxyType(chips)


def silent_nodes(bus: Table) -> tuple[str, ...]:
    """Return the nodes that are not controllers of the rig and only acknowledge.

    Raises:
        RigError: the host's interface is declared silent, or a name is reserved.
    """
    tables = bus.table("node")
    silent = [name for name in tables.values if tables.table(name).flag("silent", False)]
    if HOST in silent:
        raise tables.table(HOST).error("silent", "applications send through it", "take it out")
    for name in silent:
        tables.refuse_no_name(name)
        if name.startswith(f"{HOST}-"):
            raise tables.error(name, "is reserved for ports of applications", "rename it")
    return tuple(silent)


def refuse_strangers(
    source: Source,
    bus: str,
    nodes: Mapping[str, CanNode],
    silent: Sequence[str],
    known: Sequence[str],
) -> None:
    """Raise RigError for the first of a bus's `nodes` that is neither `known` nor `silent`."""
    for name in nodes:
        path = ("bus", bus, "node", name)
        if name in silent and name in known:
            raise source.error((*path, "silent"), f'"{name}" is a controller', "take it out")
        if name not in known and name not in silent:
            raise source.no_such(path, name, known, "controller")


def _chip(name: str, table: Table, has_data_rate: bool) -> CanNode:
    table.refuse_unknown(NODE_KEYS)
    usual = FrameSupport.FD if name == HOST and has_data_rate else FrameSupport.CLASSICAL
    recovery_ns: int | None = 0
    if table.values.get("recovery_s") == BY_COMMAND:
        recovery_ns = None
    elif table.has("recovery_s"):
        example = f'0.1, or "{BY_COMMAND}"'
        high = RECOVERY_MAX_S
        recovery_s = table.number("recovery_s", low=0.0, high=high, unit="s", example=example)
        recovery_ns = round(recovery_s * 1e9)
    ppm = table.number("oscillator_ppm", 0.0, low=-PPM_MAX, high=PPM_MAX, unit="ppm")
    return CanNode(
        queue=QueueOrder(table.one_of("queue", QUEUES, "queue", default=QueueOrder.FIFO.value)),
        frames=FrameSupport(
            table.one_of("frames", SUPPORTS, "kind of CAN controller", default=usual.value)
        ),
        one_shot=table.flag("one_shot", False),
        recovery_ns=recovery_ns,
        error_reporting=table.flag("error_reporting", False),
        shared=name == HOST,
        clock_error_1e12=round(ppm * 1e6),
        timing=_timing(table),
    )


def _timing(table: Table) -> BitTiming:
    quanta = table.integer("time_quanta", USUAL_TIMING.quanta, low=4, high=QUANTA_MAX)
    last = quanta - 1
    sample = USUAL_TIMING.sample
    if table.has("sample_point"):
        sample = table.integer("sample_point", low=2, high=last, unit="quanta")
    elif sample > last:
        raise table.error(
            "time_quanta",
            f"{quanta} quanta leave no room for the usual sample point, {sample}",
            f"write sample_point = {quanta * 7 // 8}",  # CiA 301 recommends 87.5 %
        )
    high = quanta - sample
    unit = "quanta behind the sample point"
    jump = table.integer("jump_width", USUAL_TIMING.jump, low=1, high=high, unit=unit)
    return BitTiming(quanta, sample, jump)


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
