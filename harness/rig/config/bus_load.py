"""`[[bus.NAME.message]]` tables of a rig: declared traffic of others.

`[[bus.NAME.message]]` declares a message that others send. `message = []` declares that there are
no others. With a declaration the traffic on that bus is known, and motorapi can bound the delay of
a start. A declaration does not send anything.
"""

from collections.abc import Mapping, Sequence
from typing import ClassVar, Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import Table
from motorhil.motorapi.synchronization.bus_load import (
    FD_LENGTHS,
    PeriodicMessage,
)
from motorhil.motorapi.synchronization.can_response_time import BusLoad, Message
from motorhil.settings import REQUIRED, Items, SettingError, TableOf, flag, number, text, whole

_SFF_MAX: Final = 0x7FF
_EFF_MAX: Final = 0x1FFF_FFFF
_CLASSICAL_MAX: Final = 8
_PERIOD_S: Final = (1e-5, 600.0)


@final
@frozen(kw_only=True, slots=False)
class MessageTable:
    """Frames with one identifier, of one sender."""

    identifier: int = whole(REQUIRED, 0, _EFF_MAX, "", "11 bits, or 29.", example="0x181")
    length: int = whole(REQUIRED, 0, FD_LENGTHS[-1], "bytes", "Data length.", example="8")
    period_s: float = number(
        REQUIRED,
        1e-6,
        1e6,
        "s",
        "Shortest time between two of them.",
        example="0.01",
        plausible=_PERIOD_S,
    )
    jitter_s: float = number(
        0.0, 0.0, 1e6, "s", "Largest delay before one is queued.", plausible=_PERIOD_S
    )
    extended: bool = flag(False, "The identifier has 29 bits.")
    deadline_s: float | None = number(
        None,
        1e-6,
        1e6,
        "s",
        "Largest permitted response time; absent: the period.",
        plausible=_PERIOD_S,
    )
    sender: str | None = text(
        None, "Node in whose queue it waits; absent: a queue of its own.", example='"battery"'
    )
    fd: bool = flag(False, "A CAN FD frame.")
    bit_rate_switch: bool = flag(False, "Its data have the data bit rate (BRS).")

    SCHEMA: ClassVar[Mapping[str, object]] = {
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
