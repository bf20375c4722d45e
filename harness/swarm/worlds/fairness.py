"""Fairness: which oracles may judge a world.

A disturbance can break a promise by itself: a load that is stronger than the motor moves it at
rest, and a lost frame is a request without an answer. A delayed statusword reports the state or the
target of before. A program that starts again and again after the same fault sends its SYNCs in
equal times, so they look cyclic until it gives up. Such an oracle does not judge such a world.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

from motorhil.harness.oracles.judge import IDS
from motorhil.harness.rig.fragment import read_fragment
from motorhil.harness.swarm.worlds.disturbance import FRAME_KINDS, World, kinds_in

_LOST: Final = (*FRAME_KINDS, "cut", "noise", "power")
_PUSHED: Final = ("load", "stall", "power", "supply", "fault", "heat")
EXCUSES: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(("limit-position", "limit-velocity", "limit-acceleration"), _PUSHED),
    **dict.fromkeys(("limit-torque", "following-bounded", "rest-when-told"), _PUSHED),
    "arrival-true": (*_PUSHED, "quirk", "delay"),
    "pds-legal": ("quirk", "delay"),
    **dict.fromkeys(("mode-signs", "errors-listed"), ("quirk",)),
    **dict.fromkeys(("sdo-answered", "sdo-refusals"), (*_LOST, "quirk")),
    **dict.fromkeys(("heartbeat-kept", "no-reboot"), (*_LOST, "quirk", "clock", "kill")),
    **dict.fromkeys(("drive-answered", "one-drive"), (*_LOST, "quirk")),
    "sync-period": (*_LOST, *_PUSHED, "quirk", "clock"),
    **dict.fromkeys(("tpdo-times", "error-states", "fault-told"), (*_LOST, "quirk", "clock")),
    **dict.fromkeys(("commands-obeyed", "nmt-obeyed"), (*_LOST, "quirk")),
}
"""By oracle: the kinds of disturbances that can break its promise by themselves."""


def fair(world: World) -> tuple[str, ...]:
    """Return the ids of the oracles that may judge a world."""
    return _fair({one.kind for one in world})


def fair_in(file: Path) -> tuple[str, ...]:
    """Return the ids of the oracles that may judge the world of a fragment."""
    return _fair(kinds_in(read_fragment(file).text))


def _fair(kinds: Collection[str]) -> tuple[str, ...]:
    kinds = frozenset(kinds)
    return tuple(one for one in IDS if not kinds.intersection(EXCUSES.get(one, ())))
