"""Decoded frames and ADUs: a sentence, and facts for comparison."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, final

Value = int | float | str | bytes


@final
class Kind(Enum):
    """The purpose of a frame."""

    NMT = "nmt"
    SYNC = "sync"
    TIME = "time"
    EMERGENCY = "emcy"
    HEARTBEAT = "heartbeat"
    BOOT = "boot-up"
    TPDO = "tpdo"
    RPDO = "rpdo"
    SDO_REQUEST = "sdo request"
    SDO_RESPONSE = "sdo response"
    BUS_ERROR = "error frame"
    MODBUS_REQUEST = "modbus request"
    MODBUS_RESPONSE = "modbus response"
    OTHER = "other"


PERIODIC: Final = (Kind.SYNC, Kind.TIME, Kind.HEARTBEAT, Kind.TPDO, Kind.RPDO)


FOREIGN: Final = "id "
"""Prefix of the subject of a frame of no known service; the identifier follows."""
CONTROLLER: Final = "CAN controller"
"""Prefix of the subject of an error message, which is not traffic.

The subject is "CAN controller" for its state, or "CAN controller's errors". The origin follows, if
it is not a node.
"""


@final
class Fact(NamedTuple):
    """One known fact about a node.

    Attributes:
        subject: the subject ("6041h", "NMT state", "register 6002h").
        value: the value as a number, text or bytes.
        text: the value in words.
        told_to: True for a command to the node, False for a report by it.
        motion: True for a measured or demanded quantity, which varies from run to run.
    """

    subject: str
    value: Value
    text: str
    told_to: bool = False
    motion: bool = False


@final
@dataclass(slots=True)  # not frozen: making a frozen one takes four times as long
class DecodedEvent:
    """The decoded content of a frame. Nobody changes it.

    Attributes:
        kind: its purpose.
        node: its source or destination; None: none, or all nodes.
        text: a sentence.
        facts: the resulting facts; for a transfer in several frames, when it is complete.
        index: of the object of an SDO; None: none, or unknown.
        subindex: of the same object.
    """

    kind: Kind
    node: int | None
    text: str
    facts: tuple[Fact, ...] = ()
    index: int | None = None
    subindex: int | None = None
