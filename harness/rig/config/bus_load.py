"""Traffic of a rig's buses: declarations, and its own controllers.

`[[bus.NAME.message]]` declares a message that others send. `message = []` declares that there are
no others. With a declaration the traffic on that bus is known, and motorapi can bound the delay of
a start. A declaration does not send anything.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.rig.config.toml import Table
from motorhil.motorapi.synchronization.bus_load import (
    FD_LENGTHS,
    CanTraffic,
    PeriodicMessage,
    worst_of,
)
from motorhil.motorapi.synchronization.can_response_time import BusLoad, Message

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription

MESSAGE_KEYS: Final = (
    *("identifier", "length", "period_s", "jitter_s", "extended", "deadline_s", "sender"),
    *("fd", "bit_rate_switch"),
)
_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_PERIOD_MIN_S: Final = 1e-6
_TIME_MAX_S: Final = 1e6
_CLASSICAL_MAX: Final = 8
_BOOT_UP_S: Final = 1.0  # between two boots of a node without heartbeat
_HEARTBEAT_ID: Final = 0x700
_HEARTBEAT_TIME: Final = 0x1017
_SYNC_COB_ID: Final = 0x1005
_SYNC_PERIOD: Final = 0x1006
_SYNC_COUNTER: Final = 0x1019
_SENDS_SYNC: Final = 1 << 30


def read_messages(
    bus: Table, bitrate_bit_s: int, data_bitrate_bit_s: int | None
) -> tuple[PeriodicMessage, ...] | None:
    """Read the messages that others send on a bus; None if its traffic is not declared.

    Args:
        bus: its table.
        bitrate_bit_s: bit rate of the bus [bit/s].
        data_bitrate_bit_s: bit rate of its CAN FD data [bit/s]; None for classical CAN.

    Raises:
        RigError: the first error in them.
    """
    if not bus.has("message"):
        return None
    messages: list[PeriodicMessage] = []
    load = BusLoad("", bitrate_bit_s, (), data_bitrate_bit_s)
    busy = 0.0
    for table in bus.listed_tables("message"):
        message = _declared(table).message
        if message.fd and data_bitrate_bit_s is None:
            raise table.error(
                "fd",
                f'bus "{bus.path[-1]}" is classical CAN',
                "give it a data_bitrate_bit_s, or remove fd",
            )
        for place, other in enumerate(messages):
            if other.rank == message.rank:
                line = bus.source.line((*bus.path, "message", place))
                raise table.error(
                    "identifier",
                    f"{message.name} is already declared (line {line})",
                    "declare it once, with the shorter period and the greater length",
                )
        messages.append(message)
        busy += load.takes_ns(Message.of(message)) / (message.period_s * 1e9)
        if busy > 1.0:
            raise table.error(
                "period_s",
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
    return tuple(_declared(one) for one in table.listed_tables("message"))


def _declared(table: Table) -> Declared:
    message = _message(table)
    deadline_s = table.number(
        "deadline_s", message.period_s, low=_PERIOD_MIN_S, high=_TIME_MAX_S, unit="s"
    )
    sender = table.text("sender", example='"battery"') if table.has("sender") else ""
    return Declared(message, deadline_s, sender)


def _message(table: Table) -> PeriodicMessage:
    table.refuse_unknown(MESSAGE_KEYS)
    extended = table.flag("extended", False)
    high = _EFF_MAX if extended else _SFF_MAX
    fd, switched = table.flag("fd", False), table.flag("bit_rate_switch", False)
    if switched and not fd:
        message = "only CAN FD frames can switch the bit rate"
        raise table.error("bit_rate_switch", message, "write fd = true, or remove it")
    return PeriodicMessage(
        can_id=table.integer("identifier", low=0, high=high, example="0x181"),
        length=_length(table, fd),
        period_s=table.number(
            "period_s", low=_PERIOD_MIN_S, high=_TIME_MAX_S, unit="s", example="0.01"
        ),
        jitter_s=table.number("jitter_s", 0.0, low=0.0, high=_TIME_MAX_S, unit="s"),
        extended=extended,
        fd=fd,
        bit_rate_switch=switched,
    )


def _length(table: Table, fd: bool) -> int:
    length = table.integer("length", low=0, high=FD_LENGTHS[-1], unit="bytes", example="8")
    if length > _CLASSICAL_MAX and not fd:
        message = f"{length} bytes is out of range; allowed: 0 to {_CLASSICAL_MAX} bytes"
        raise table.error("length", message, "with fd = true (CAN FD) up to 64 bytes")
    if length not in FD_LENGTHS:
        padded = next(one for one in FD_LENGTHS if one > length)
        message = f"CAN FD frames cannot have {length} bytes"
        raise table.error("length", message, f"the frame is padded: write length = {padded}")
    return length


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
