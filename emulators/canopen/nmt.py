"""NMT slave (CiA 301, 7.3.2.2): the four states and what may be done in each."""

from enum import IntEnum, unique
from typing import final


@final
@unique
class NmtState(IntEnum):
    """The states; the value is what a heartbeat carries."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F
