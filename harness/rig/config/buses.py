"""`[bus.NAME]` tables of a rig: CAN buses, Modbus lines and other serial lines.

The keys are declared here; `docs/reference/rig-file.md` lists them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.emulators.can.controller_config import (
    HOST,
    USUAL_TIMING,
    BitTiming,
    CanNode,
    FrameSupport,
    QueueOrder,
)
from motorhil.frozen import frozen
from motorhil.harness.rig.config.bus_load import MESSAGES, MessageTable, check_messages
from motorhil.harness.rig.config.toml import Source, Table
from motorhil.settings import (
    Rule,
    SettingError,
    TableOf,
    TablesByKey,
    flag,
    number,
    setting,
    text,
    whole,
    word,
)

if TYPE_CHECKING:
    from motorhil.motorapi.synchronization.bus_load import PeriodicMessage

CAN: Final = "can"
MODBUS_RTU: Final = "modbus_rtu"
MODBUS_TCP: Final = "modbus_tcp"
SERIAL: Final = "serial"
"""A serial line whose protocol delimits its packets itself, such as Dynamixel's."""
BUS_KINDS: Final = (CAN, MODBUS_RTU, MODBUS_TCP, SERIAL)
LINES: Final = (MODBUS_RTU, MODBUS_TCP, SERIAL)
PARITIES: Final = ("E", "O", "N")
BY_COMMAND: Final = "command"

NODE_MAX: Final = 255  # kinds of drives have their own, lower limits
UNIT_MAX: Final = 247
ID_MAX: Final = 252
"""The highest unit on a serial line that is not a Modbus line."""

PORT_MAX: Final = 65_535
"""The highest port of a gateway's address."""
_MODBUS_PORT: Final = 502
_SECOND_NS: Final = 1_000_000_000


@final
@frozen(kw_only=True, slots=False)
class CanNodeTable:
    """Settings of a node's CAN controller."""

    queue: str = word(
        "fifo", [one.value for one in QueueOrder], "queue", "Order in which its frames compete."
    )
    frames: str | None = word(
        None,
        [one.value for one in FrameSupport],
        "kind of CAN controller",
        "Frames that it supports; absent: classical, and fd for hosts on a bus with a data bit"
        " rate.",
    )
    one_shot: bool = flag(False, "No retransmission after an error or a lost arbitration.")
    recovery_s: float | str = number(
        0.0,
        0.0,
        1e6,
        "s",
        "Delay after bus-off before it counts the 128 x 11 recessive bits.",
        example="0.1",
        word=BY_COMMAND,
        plausible=(1e-4, 60.0),
    )
    error_reporting: bool = flag(False, "It reports every error, not only changes of its state.")
    oscillator_ppm: float = number(
        0.0, -100_000.0, 100_000.0, "ppm", "Clock error; absent: that of the controller's table."
    )
    time_quanta: int = whole(USUAL_TIMING.quanta, 4, 400, "", "Time quanta per bit time.")
    sample_point: int | None = whole(
        None, 2, 399, "quanta", f"Sample point; absent: {USUAL_TIMING.sample}."
    )
    jump_width: int = whole(
        USUAL_TIMING.jump, 1, 398, "quanta", "Synchronisation jump width, within the rest."
    )
    silent: bool = flag(
        False, "It is not a controller of the rig, but a node that only acknowledges."
    )

    def __post_init__(self) -> None:
        """Refuse a bit timing that does not add up (SettingError)."""
        last = self.time_quanta - 1
        sample = USUAL_TIMING.sample if self.sample_point is None else self.sample_point
        if sample > last and self.sample_point is None:
            raise SettingError(
                ("time_quanta",),
                f"{self.time_quanta} quanta leave no room for the usual sample point, {sample}",
                f"write sample_point = {self.time_quanta * 7 // 8}",  # CiA 301: 87.5 %
            )
        if sample > last:
            message = f"{sample} quanta is out of range"
            raise SettingError(("sample_point",), message, f"allowed: 2 to {last} quanta")
        rest = self.time_quanta - sample
        if self.jump_width > rest:
            unit = "quanta behind the sample point"
            message = f"{self.jump_width} {unit} is out of range"
            raise SettingError(("jump_width",), message, f"allowed: 1 to {rest} {unit}")

    def can_node(self, name: str, has_data_rate: bool) -> CanNode:
        """Return the node of this name, on a bus with or without a data bit rate."""
        usual = FrameSupport.FD if name == HOST and has_data_rate else FrameSupport.CLASSICAL
        sample = USUAL_TIMING.sample if self.sample_point is None else self.sample_point
        recovery_s = self.recovery_s
        return CanNode(
            queue=QueueOrder(self.queue),
            frames=usual if self.frames is None else FrameSupport(self.frames),
            one_shot=self.one_shot,
            recovery_ns=None if isinstance(recovery_s, str) else round(recovery_s * 1e9),
            error_reporting=self.error_reporting,
            shared=name == HOST,
            clock_error_1e12=round(self.oscillator_ppm * 1e6),
            timing=BitTiming(self.time_quanta, sample, self.jump_width),
        )


def _of(keys: tuple[str, ...], *kinds: str) -> Rule:
    named = " or ".join(f'"{kind}"' for kind in kinds)
    return Rule(
        "kind",
        kinds,
        otherwise=True,
        refused=keys,
        message=f"belongs to kind {named}",
        remedy=f"take it out, or write kind = {named}",
    )


@final
@frozen(kw_only=True, slots=False)
class BusTable:
    """A CAN bus, a serial line (Modbus RTU, or others), or a gateway to Modbus controllers."""

    kind: str = word(CAN, BUS_KINDS, "bus kind", "Its kind.")
    bitrate_bit_s: int | None = whole(
        None,
        1_000,
        1_000_000,
        "bit/s",
        "Nominal bit rate; a bit lasts a whole number of nanoseconds.",
        example="1_000_000",
        plausible=(10_000, 1_000_000),  # CiA 301, lowest and highest bit rate
    )
    data_bitrate_bit_s: int | None = whole(
        None,
        1_000,
        20_000_000,
        "bit/s",
        "Bit rate of CAN FD data, likewise, not below bitrate_bit_s; absent: classical CAN.",
        plausible=(100_000, 20_000_000),
    )
    message: tuple[MessageTable, ...] | None = setting(
        None,
        MESSAGES,
        "Messages that others send. With it, or with an empty list, the traffic is declared and"
        " the delay of a start can be bounded. A declaration does not send anything.",
    )
    node: Mapping[str, CanNodeTable] = setting(
        {},
        TablesByKey(TableOf(CanNodeTable)),
        'CAN controllers with special settings, by controller name or "host".',
    )
    baud_bit_s: int = whole(
        19_200, 300, 10_000_000, "bit/s", "Bit rate of the line.", plausible=(1200, 10_000_000)
    )
    parity: str | None = word(
        None, PARITIES, "parity", "Even, odd or none; absent: E on modbus_rtu, N on serial."
    )
    stop_bits: int = whole(1, 1, 2, "", "Stop bits of a character.")
    latency_s: float = number(
        50e-6, 0.0, 10.0, "s", "Delay from sending to arrival.", plausible=(1e-7, 2.0)
    )
    timeout_s: float = number(
        1.0,
        0.01,
        3600.0,
        "s",
        "How long the gateway waits for a unit before it answers itself with exception 0Bh.",
        plausible=(0.01, 60.0),
    )
    address: str | None = text(
        None,
        "Where unmodified programs in virtual time find the line: HOST:PORT of a gateway (absent:"
        " NAME:502), else the path of a serial port (absent: /dev/NAME).",
        example='"192.168.1.20:502"',
    )

    RULES: ClassVar = (
        _of(("bitrate_bit_s", "data_bitrate_bit_s", "message", "node"), CAN),
        _of(("baud_bit_s", "parity", "stop_bits"), MODBUS_RTU, SERIAL),
        _of(("latency_s", "timeout_s"), MODBUS_TCP),
        _of(("address",), *LINES),
        Rule(
            "kind",
            (CAN,),
            required=("bitrate_bit_s",),
            remedy="write bitrate_bit_s = 1_000_000",
        ),
    )
    SCHEMA: ClassVar[Mapping[str, object]] = {
        "if": {"not": {"required": ["data_bitrate_bit_s"]}},
        "then": {"properties": {"message": {"items": {"properties": {"fd": {"const": False}}}}}},
    }

    def __post_init__(self) -> None:
        """Refuse addresses of no line, and bit rates without whole ns or out of order."""
        _check_address(self.kind, self.address)
        rate, data_rate = self.bitrate_bit_s or 1, self.data_bitrate_bit_s
        if _SECOND_NS % rate:
            raise SettingError(
                ("bitrate_bit_s",),
                f"a bit of {rate} bit/s is not a whole number of nanoseconds",
                "usual: 1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000,"
                " 10_000",
            )
        if data_rate is not None and data_rate < rate:
            message = f"{data_rate} bit/s is out of range"
            remedy = f"allowed: {rate} to 20000000 bit/s"
            raise SettingError(("data_bitrate_bit_s",), message, remedy)
        if data_rate is not None and _SECOND_NS % data_rate:
            raise SettingError(
                ("data_bitrate_bit_s",),
                f"a bit of {data_rate} bit/s is not a whole number of nanoseconds",
                "usual: 8_000_000, 5_000_000, 4_000_000, 2_000_000, 1_000_000",
            )


def host_and_port(address: str) -> tuple[str, int] | None:
    """Return the parts of `HOST:PORT`, the host without brackets; None: it is no such address.

    An IPv6 address is written in brackets. Port 0 is a part, too; it stands for any free port.
    """
    host, _, port = address.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    elif ":" in host:
        return None
    if not host or not (port.isascii() and port.isdigit()) or len(port) > 5:
        return None
    return (host, int(port)) if int(port) <= PORT_MAX else None


def _check_address(kind: str, address: str | None) -> None:
    """Refuse an address that is not one of a line of this kind (SettingError)."""
    if address is None or kind not in LINES:
        return
    if kind == MODBUS_TCP:
        end = host_and_port(address)
        if end is None or end[1] == 0:
            message = f'"{address}" is not the address of a gateway'
            raise SettingError(("address",), message, 'write "HOST:PORT"')
    elif not address.startswith("/"):
        message = f'"{address}" is not the path of a serial port'
        raise SettingError(("address",), message, f'write "/dev/{address}"')


@final
@frozen
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
        address: of a line, where programs in virtual time find it: HOST:PORT, or a path.
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
    address: str = ""

    @property
    def is_line(self) -> bool:
        """True for a line, whose controllers have units instead of node-IDs."""
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
    own = table.read(BusTable)
    if own.kind in (MODBUS_RTU, SERIAL):
        parity = own.parity or ("E" if own.kind == MODBUS_RTU else "N")
        return BusDescription(
            *(name, own.kind, own.baud_bit_s),
            parity=parity,
            stop_bits=own.stop_bits,
            address=own.address or f"/dev/{name}",
        )
    if own.kind == MODBUS_TCP:
        latency_ns, timeout_ns = round(own.latency_s * 1e9), round(own.timeout_s * 1e9)
        return BusDescription(
            *(name, own.kind, 0),
            latency_ns=latency_ns,
            timeout_ns=timeout_ns,
            address=own.address or f"{name}:{_MODBUS_PORT}",
        )
    rate, data_rate = own.bitrate_bit_s, own.data_bitrate_bit_s
    assert rate is not None
    messages = None
    if own.message is not None:
        messages = check_messages(table, own.message, rate, data_rate)
    nodes = {node: one.can_node(node, data_rate is not None) for node, one in own.node.items()}
    return BusDescription(
        name,
        CAN,
        rate,
        messages,
        MappingProxyType(nodes),
        _silent_nodes(table.table("node"), own.node),
        data_bitrate_bit_s=data_rate,
    )


def _silent_nodes(tables: Table, nodes: Mapping[str, CanNodeTable]) -> tuple[str, ...]:
    """Return the nodes that are not controllers of the rig and only acknowledge."""
    silent = tuple(name for name, node in nodes.items() if node.silent)
    if HOST in silent:
        raise tables.table(HOST).error("silent", "applications send through it", "take it out")
    for name in silent:
        tables.refuse_no_name(name)
        if name.startswith(f"{HOST}-"):
            raise tables.error(name, "is reserved for ports of applications", "rename it")
    return silent


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


def refuse_shared_addresses(source: Source, buses: Mapping[str, BusDescription]) -> None:
    """Raise RigError for the first line that has the address of another one."""
    owners: dict[str, str] = {}
    for name, bus in buses.items():
        other = owners.setdefault(bus.address, name) if bus.is_line else name
        if other != name:
            raise source.error(
                ("bus", name, "address"), f'"{bus.address}" is that of "{other}"', "write another"
            )


ADDRESS_KEYS: Final = ("node_id", "unit")
"""The keys of addresses, of which a bus has one."""


def address_key(bus: BusDescription) -> str:
    """Return the key of the address of this bus's controllers."""
    return "unit" if bus.is_line else "node_id"


def address_max(bus: BusDescription) -> int:
    """Return the highest address of this bus's controllers."""
    if bus.kind == SERIAL:
        return ID_MAX
    return UNIT_MAX if bus.is_line else NODE_MAX


@frozen(kw_only=True, slots=False)
class AddressTable:
    """Where a controller is on its bus."""

    node_id: int | None = whole(None, 0, NODE_MAX, "", "Its node-ID on a CAN bus.", example="1")
    unit: int | None = whole(
        None, 0, ID_MAX, "", "Its server address (1 to 247) or id on a line.", example="1"
    )


def read_address(table: Table, bus: BusDescription) -> int | None:
    """Return the address of a controller (or of a motor's) on the bus, or None without one.

    Raises:
        RigError: the address is out of range, or has the key of another kind of bus.
    """
    key = address_key(bus)
    other = "node_id" if bus.is_line else "unit"
    if table.has(other):
        of = "its controllers have a unit" if bus.is_line else "a CAN bus has node-IDs"
        raise table.error(other, f'bus "{bus.name}" is of kind {bus.kind}: {of}', f"write {key}")
    own = table.part(AddressTable)
    unit = own.unit
    if bus.kind in (MODBUS_RTU, MODBUS_TCP) and unit is not None and not 1 <= unit <= UNIT_MAX:
        raise table.error("unit", f"{unit} is out of range", f"allowed: 1 to {UNIT_MAX}")
    return unit if bus.is_line else own.node_id
