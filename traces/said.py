"""What one frame or ADU says: in a sentence, and as facts that a machine can compare."""

from dataclasses import dataclass
from enum import Enum
from typing import Final, final

Value = int | float | str | bytes


@final
class Kind(Enum):
    """What a frame is for."""

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
"""How the subject begins of a frame that is of no service: its identifier follows."""
CONTROLLER: Final = "CAN controller"
"""How the subject begins of an error message, which is no traffic: the state that it tells, or
"CAN controller's errors"; then whose it is, if that is no node.
"""


@final
@dataclass(frozen=True, slots=True)
class Fact:
    """One thing that is now known of a node.

    Attributes:
        subject: of what ("6041h", "NMT state", "register 6002h").
        value: as a number, text or bytes.
        text: the value in words.
        told_to: whether it was told to the node (a command), else by it.
        motion: whether it is a measured or demanded quantity, which varies from run to run.
    """

    subject: str
    value: Value
    text: str
    told_to: bool = False
    motion: bool = False


@final
@dataclass(frozen=True, slots=True)
class Said:
    """What a frame says.

    Attributes:
        kind: what it is for.
        node: whose it is, or whom it is for; None: nobody's, or all nodes'.
        text: a sentence.
        facts: what is known by it; of a transfer in several frames, when it is complete.
        index: of the object an SDO is about; None: of none, or it is not known.
        subindex: of the same.
    """

    kind: Kind
    node: int | None
    text: str
    facts: tuple[Fact, ...] = ()
    index: int | None = None
    subindex: int | None = None
