"""Decoded frames and ADUs: a sentence, and facts for comparison.

Most sentences are never read, so words that cost more than the fact itself are made when they are.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

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
@dataclass(slots=True)  # not frozen: making a frozen one takes four times as long
class Fact:
    """One known fact about a node. Nobody changes it.

    Attributes:
        subject: the subject ("6041h", "NMT state", "register 6002h").
        value: the value as a number, text or bytes.
        words: the value in words, or the function that returns them.
        told_to: True for a command to the node, False for a report by it.
        motion: True for a measured or demanded quantity, which varies from run to run.
    """

    subject: str
    value: Value
    words: str | Callable[[Value], str]
    told_to: bool = False
    motion: bool = False

    @property
    def text(self) -> str:
        """The value in words."""
        words = self.words
        return words if isinstance(words, str) else words(self.value)


@final
@dataclass(slots=True)  # as above
class DecodedEvent:
    """The decoded content of a frame. Nobody changes it.

    Attributes:
        kind: its purpose.
        node: its source or destination; None: none, or all nodes.
        words: a sentence, or the function that returns it.
        facts: the resulting facts; for a transfer in several frames, when it is complete.
        index: of the object of an SDO; None: none, or unknown.
        subindex: of the same object.
    """

    kind: Kind
    node: int | None
    words: str | Callable[[], str]
    facts: tuple[Fact, ...] = ()
    index: int | None = None
    subindex: int | None = None

    @property
    def text(self) -> str:
        """The content as a sentence."""
        words = self.words
        return words if isinstance(words, str) else words()

    def __str__(self) -> str:
        return self.text
