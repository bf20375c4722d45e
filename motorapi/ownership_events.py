"""What happens to the ownership of a physical motor, told to whoever listens.

An owner is told of by what he does ("reserve() of pan"), as errors tell of him. Of another process
only that is known which it wrote itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import final


@final
class LockAction(IntEnum):
    """What happened. It is taken by TAKEN, BROKEN or TAKEN_OVER: by one of them each time."""

    TAKEN = 1
    RELEASED = 2
    WAITING = 3
    REFUSED = 4
    BROKEN = 5
    """Taken from one who had died with it."""
    TAKEN_OVER = 6
    """Taken from one who lives."""
    LOST = 7
    """The one it was taken over from has noticed."""


@final
@dataclass(frozen=True, slots=True)
class OwnershipEvent:
    """One thing that happened.

    Attributes:
        action: what.
        owner: who did it, in words; of LOST: who had it.
        holder: who has it, or had it before, if that is not the owner; "" if not known, or nobody.
        purpose: what for, in words.
        token: of the ownership: the owner's; of WAITING and REFUSED: 0.
        time_ns: when, of the runtime's time.
        waited_s: how long he had waited for it [s].
        held_s: how long he had had it [s]: RELEASED and LOST; and TAKEN, if it is told late.
        pid, program: the process of the owner.
    """

    action: LockAction
    owner: str
    holder: str
    purpose: str
    token: int
    time_ns: int
    waited_s: float = 0.0
    held_s: float = 0.0
    pid: int = 0
    program: str = ""


OwnershipListener = Callable[[OwnershipEvent], None]
"""Called in the thread to which it happened, while nothing is locked; it must not wait."""
