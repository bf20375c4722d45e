"""Fairness: which oracles may judge a world.

A disturbance can break a promise by itself: a load that is stronger than the motor moves it at
rest, and a lost frame is a request without an answer. A program that starts again and again after
the same fault sends its SYNCs in equal times, so they look cyclic until it gives up. Such an oracle
does not judge such a world.
"""

from collections.abc import Mapping
from typing import Final

from motorhil.harness.oracles.judge import IDS
from motorhil.harness.swarm.worlds.disturbance import FRAME_KINDS, World

_LOST: Final = (*FRAME_KINDS, "cut", "noise", "power")
_PUSHED: Final = ("load", "stall", "power", "supply", "fault", "heat")
EXCUSES: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("limit-position", "limit-velocity", "limit-acceleration"), _PUSHED),
    **dict.fromkeys(("limit-torque", "following-bounded", "rest-when-told"), _PUSHED),
    "arrival-true": (*_PUSHED, "quirk"),
    **dict.fromkeys(("mode-signs", "errors-listed", "pds-legal"), ("quirk",)),
    **dict.fromkeys(("sdo-answered", "sdo-refusals"), (*_LOST, "quirk")),
    **dict.fromkeys(("heartbeat-kept", "no-reboot"), (*_LOST, "quirk", "clock")),
    **dict.fromkeys(("drive-answered", "one-drive"), (*_LOST, "quirk")),
    "sync-period": (*_LOST, *_PUSHED, "quirk", "clock"),
    **dict.fromkeys(("tpdo-times", "error-states", "fault-told"), (*_LOST, "quirk", "clock")),
    **dict.fromkeys(("commands-obeyed", "nmt-obeyed"), (*_LOST, "quirk")),
}
"""By oracle: the kinds of disturbances that can break its promise by themselves."""


def fair(world: World) -> tuple[str, ...]:
    """Return the ids of the oracles that may judge a world."""
    kinds = {one.kind for one in world}
    return tuple(one for one in IDS if not kinds.intersection(EXCUSES.get(one, ())))
