"""Fairness: which oracles may judge a world, and which errors may end it.

A disturbance can break a promise by itself: a load that is stronger than the motor moves it at
rest, and a lost frame is a request without an answer. A delayed statusword reports the state or the
target of before. A delayed command arrives after a fault that its sender had not heard of. A
program that starts again and again after the same fault sends its SYNCs in equal times, so they
look cyclic until it gives up. Such an oracle does not judge such a world.

A load may push a motor out of the limits of its model. The motor then refuses each further motion,
because it does not begin within them.
"""

from collections.abc import Collection, Mapping
from typing import Final

from motorhil.harness.oracles.judge import IDS
from motorhil.harness.swarm.worlds.disturbance import FRAME_KINDS
from motorhil.motorapi.errors import LimitError

_LOST: Final = (*FRAME_KINDS, "cut", "noise", "power")
_PUSHED: Final = ("load", "stall", "power", "supply", "fault", "heat")
EXCUSES: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("limit-position", "limit-velocity", "limit-acceleration"), _PUSHED),
    **dict.fromkeys(("limit-torque", "following-bounded", "rest-when-told"), _PUSHED),
    "arrival-true": (*_PUSHED, "quirk", "delay"),
    "pds-legal": ("quirk", "delay"),
    **dict.fromkeys(("mode-signs", "errors-listed", "one-sender"), ("quirk",)),
    **dict.fromkeys(("sdo-answered", "sdo-refusals"), (*_LOST, "quirk")),
    **dict.fromkeys(("heartbeat-kept", "no-reboot"), (*_LOST, "quirk", "clock", "kill")),
    **dict.fromkeys(("drive-answered", "one-drive"), (*_LOST, "quirk")),
    "sync-period": (*_LOST, *_PUSHED, "quirk", "clock"),
    **dict.fromkeys(("tpdo-times", "error-states", "fault-told"), (*_LOST, "quirk", "clock")),
    **dict.fromkeys(("commands-obeyed", "nmt-obeyed"), (*_LOST, "quirk")),
    "fault-heeded": ("delay",),
}
"""By oracle: the kinds of disturbances that can break its promise by themselves."""


_PUSHES: Final = frozenset(("load", "stall"))
_WHERE_IT_IS: Final = "initial "
"""Quantities that tell where a motor is, not where it should go, begin with this."""


def is_pushed_out(error: BaseException, kinds: Collection[str]) -> bool:
    """Return whether a motor refuses to move because a load has pushed it out of its limits.

    Args:
        error: what ended the program.
        kinds: the kinds of disturbances of the world.
    """
    is_outside = isinstance(error, LimitError) and error.quantity.startswith(_WHERE_IT_IS)
    return is_outside and not _PUSHES.isdisjoint(kinds)


def fair(kinds: Collection[str]) -> tuple[str, ...]:
    """Return the ids of the oracles that may judge a world with these kinds of disturbances."""
    return tuple(one for one in IDS if not frozenset(kinds).intersection(EXCUSES.get(one, ())))
