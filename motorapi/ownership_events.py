"""Events of the ownership of a physical motor, for listeners.

An owner is described by its activity ("reserve() of pan"), as in errors. Another process is known
only by what it has published.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import final


@final
class LockAction(IntEnum):
    """The kind of event. Each acquisition is one of TAKEN, BROKEN and TAKEN_OVER."""

    TAKEN = 1
    RELEASED = 2
    WAITING = 3
    REFUSED = 4
    BROKEN = 5
    """Acquired from an owner that died with it."""
    TAKEN_OVER = 6
    """Acquired from a living owner."""
    LOST = 7
    """Noticed by the former owner of a takeover."""


@final
@dataclass(frozen=True, slots=True)
class OwnershipEvent:
    """One event of an ownership.

    Attributes:
        action: the kind of event.
        owner: the acting owner, in words; for LOST: the former owner.
        holder: the present or previous owner, if another one; "" if unknown or none.
        purpose: the purpose, in words.
        token: token of the owner; for WAITING and REFUSED: 0.
        time_ns: time of the event, by the runtime.
        waited_s: time for which the owner had waited [s].
        held_s: time for which the owner had held it [s]: RELEASED and LOST; and TAKEN, if reported
            late.
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
"""Called in the thread of the event, without any lock held; it must not wait."""
