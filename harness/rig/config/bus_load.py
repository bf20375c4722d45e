"""Traffic of a rig's buses: declarations, and its own controllers.

`[[bus.NAME.message]]` declares a message that others send. `message = []` declares that there are
no others. With a declaration the traffic on that bus is known, and motorapi can bound the delay of
a start. A declaration does not send anything.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.harness.rig.config.toml import Table
from motorhil.motorapi.synchronization.bus_load import (
    FD_LENGTHS,
    CanTraffic,
    PeriodicMessage,
    worst_of,
)
from motorhil.motorapi.synchronization.can_response_time import BusLoad, Message
from motorhil.settings import REQUIRED, Items, SettingError, TableOf, flag, number, text, whole

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription

_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_CLASSICAL_MAX: Final = 8
_BOOT_UP_S: Final = 1.0  # between two boots of a node without heartbeat
_HEARTBEAT_ID: Final = 0x700
_HEARTBEAT_TIME: Final = 0x1017
_SYNC_COB_ID: Final = 0x1005
_SYNC_PERIOD: Final = 0x1006
_SYNC_COUNTER: Final = 0x1019
_SENDS_SYNC: Final = 1 << 30


@final
@dataclass(frozen=True, kw_only=True)
class MessageTable:
    """Frames with one identifier, of one sender."""

    identifier: int = whole(REQUIRED, 0, _EFF_MAX, "", "11 bits, or 29.", example="0x181")
    length: int = whole(REQUIRED, 0, FD_LENGTHS[-1], "bytes", "Data length.", example="8")
    period_s: float = number(
        REQUIRED, 1e-6, 1e6, "s", "Shortest time between two of them.", example="0.01"
    )
    jitter_s: float = number(0.0, 0.0, 1e6, "s", "Largest delay before one is queued.")
    extended: bool = flag(False, "The identifier has 29 bits.")
    deadline_s: float | None = number(
        None, 1e-6, 1e6, "s", "Largest permitted response time; absent: the period."
    )
    sender: str | None = text(
        None, "Node in whose queue it waits; absent: a queue of its own.", example='"battery"'
    )
    fd: bool = flag(False, "A CAN FD frame.")
    bit_rate_switch: bool = flag(False, "Its data have the data bit rate (BRS).")

    SCHEMA: ClassVar = {
        "if": {"properties": {"fd": {"const": True}}, "required": ["fd"]},
        "then": {"properties": {"length": {"enum": list(FD_LENGTHS)}}},
        "else": {
            "properties": {
                "length": {"maximum": _CLASSICAL_MAX},
                "bit_rate_switch": {"const": False},
            }
        },
        "anyOf": [
            {"properties": {"identifier": {"maximum": _SFF_MAX}}},
            {"properties": {"extended": {"const": True}}, "required": ["extended"]},
        ],
    }

    def __post_init__(self) -> None:
        """Refuse what no frame can be (SettingError)."""
        if self.identifier > _SFF_MAX and not self.extended:
            message = f"{self.identifier} is out of range"
            remedy = f"allowed: 0 to {_SFF_MAX}, or extended = true"
            raise SettingError(("identifier",), message, remedy)
        if self.bit_rate_switch and not self.fd:
            message = "only CAN FD frames can switch the bit rate"
            raise SettingError(("bit_rate_switch",), message, "write fd = true, or remove it")
        if self.length > _CLASSICAL_MAX and not self.fd:
            message = f"{self.length} bytes is out of range; allowed: 0 to {_CLASSICAL_MAX} bytes"
            raise SettingError(("length",), message, "with fd = true (CAN FD) up to 64 bytes")
        if self.length not in FD_LENGTHS:
            padded = next(one for one in FD_LENGTHS if one > self.length)
            message = f"CAN FD frames cannot have {self.length} bytes"
            raise SettingError(
                ("length",), message, f"the frame is padded: write length = {padded}"
            )

    def message(self) -> PeriodicMessage:
        """Return the message as motorapi uses it."""
        return PeriodicMessage(
            can_id=self.identifier,
            length=self.length,
            period_s=self.period_s,
            jitter_s=self.jitter_s,
            extended=self.extended,
            fd=self.fd,
            bit_rate_switch=self.bit_rate_switch,
        )


MESSAGES: Final = Items(TableOf(MessageTable), unique=False)


def check_messages(
    bus: Table, tables: Sequence[MessageTable], bitrate_bit_s: int, data_bitrate_bit_s: int | None
) -> tuple[PeriodicMessage, ...]:
    """Return the messages that others send on a bus.

    Args:
        bus: the bus's table.
        tables: its messages.
        bitrate_bit_s: the nominal bit rate.
        data_bitrate_bit_s: the bit rate of the data of CAN FD frames; None on a classical bus.

    Raises:
        RigError: two messages are the same, or one does not fit the bus.
    """
    messages: list[PeriodicMessage] = []
    load = BusLoad("", bitrate_bit_s, (), data_bitrate_bit_s)
    busy = 0.0
    for index, message in enumerate(one.message() for one in tables):
        path = (*bus.path, "message", index)
        if message.fd and data_bitrate_bit_s is None:
            problem = f'bus "{bus.path[-1]}" is classical CAN'
            remedy = "give it a data_bitrate_bit_s, or remove fd"
            raise bus.source.error((*path, "fd"), problem, remedy)
        for place, other in enumerate(messages):
            if other.rank == message.rank:
                line = bus.source.line((*bus.path, "message", place))
                raise bus.source.error(
                    (*path, "identifier"),
                    f"{message.name} is already declared (line {line})",
                    "declare it once, with the shorter period and the greater length",
                )
        messages.append(message)
        busy += load.takes_ns(Message.of(message)) / (message.period_s * 1e9)
        if busy > 1.0:
            raise bus.source.error(
                (*path, "period_s"),
                f"the messages up to this one take {busy:.0%} of the bus",
                "use a longer period, or a higher bit rate",
            )
    return tuple(messages)


@final
@dataclass(frozen=True, slots=True)
class Declared:
    """A declared message, with data that only the response-time analysis needs.

    Attributes:
        message: the message as motorapi uses it.
        deadline_s: largest permitted response time [s]; default: its period.
        sender: node in whose queue it waits; "" for a queue of its own.
    """

    message: PeriodicMessage
    deadline_s: float
    sender: str


def declared(description: "RigDescription", bus: str) -> tuple[Declared, ...] | None:
    """Return the declared messages of others on a bus, or None if there is no declaration.

    Raises:
        RigError: the first error in them.
    """
    table = description.source.root().table("bus").table(bus)
    if not table.has("message"):
        return None
    with table.source.with_lines():
        tables = MESSAGES.read(table.values["message"], (*table.path, "message"))
    return tuple(
        Declared(
            one.message(),
            one.period_s if one.deadline_s is None else one.deadline_s,
            one.sender or "",
        )
        for one in tables
    )


def traffic_of(description: "RigDescription", bus: str) -> CanTraffic | None:
    """Return a bus's traffic apart from what motors configure, or None if undeclared.

    A controller that no motor has configured contributes its boot-up message, and heartbeat and
    SYNC if its table enables them.
    """
    described = description.buses[bus]
    if described.messages is None:
        return None
    own = heartbeats(description, bus) + [sync for _, sync in syncs(description, bus)]
    return CanTraffic(
        described.bitrate_bit_s,
        worst_of([*described.messages, *own]),
        data_bitrate_bit_s=described.data_bitrate_bit_s,
    )


def heartbeats(description: "RigDescription", bus: str) -> list[PeriodicMessage]:
    """Return the heartbeat and boot-up messages of a bus's unconfigured controllers."""
    return [
        PeriodicMessage(_HEARTBEAT_ID + node.node_id, 1, _heartbeat_s(node))
        for node in description.controllers.values()
        if node.bus == bus and node.node_id
    ]


def _heartbeat_s(controller: "ControllerDescription") -> float:
    period_ms = _object(controller, _HEARTBEAT_TIME)
    return min(_BOOT_UP_S, period_ms / 1e3) if period_ms > 0 else _BOOT_UP_S


def syncs(description: "RigDescription", bus: str) -> list[tuple[str, PeriodicMessage]]:
    """Return SYNC with its sender's name for controllers whose table enables it (CiA 301)."""
    found: list[tuple[str, PeriodicMessage]] = []
    for node in description.controllers.values():
        cob_id, period_us = _object(node, _SYNC_COB_ID), _object(node, _SYNC_PERIOD)
        if node.bus == bus and cob_id & _SENDS_SYNC and period_us > 0:
            length = 1 if _object(node, _SYNC_COUNTER) else 0
            message = PeriodicMessage(cob_id & _SFF_MAX, length, period_us / 1e6)
            found.append((node.name, message))
    return found


def _object(controller: "ControllerDescription", index: int) -> int:
    """Return a power-on value that the controller's table sets, or 0."""
    objects = controller.settings.get("objects")
    if isinstance(objects, Mapping):
        for key in (f"{index:04X}h", f"{index:04X}"):
            value = objects.get(key)
            if isinstance(value, int):
                return value
    return 0
