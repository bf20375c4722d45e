"""What `--on` says: which bus, where it is, and what it is called in a recording."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

_NAME: Final = re.compile(r"[\w.-]+")
_INTERFACE_MAX: Final = 15  # IFNAMSIZ of linux/if.h, without the zero that ends it


class PlaceError(Exception):
    """A bus cannot be reached, or not as it was asked for; the message says why and what to do."""


@final
class Kind(Enum):
    """How a bus is reached."""

    SOCKETCAN = "SocketCAN"
    HUB = "hub"
    PYTHON_CAN = "python-can"


@final
@dataclass(frozen=True, slots=True)
class Place:
    """A bus to record from or to send to.

    Attributes:
        text: as it was asked for.
        kind: how it is reached.
        interface: of python-can; "" for others.
        channel: the SocketCAN interface, the hub's socket (PATH or PATH#BUS), or python-can's.
        name: what it shall be called; "" if that was not said.
    """

    text: str
    kind: Kind
    interface: str
    channel: str
    name: str


def parse_place(text: str) -> Place:
    """The place that `[NAME=]WHERE` names.

    WHERE is a SocketCAN interface (`vcan0`), the socket of `motorhil serve --socket` (anything with
    a slash; `PATH#can1` for another bus than its first), or `interface:channel` of python-can.

    Raises:
        PlaceError: it names nothing.
    """
    before, equals, where = text.partition("=")
    name = before if equals and _NAME.fullmatch(before) else ""
    if not name:
        where = text
    if "/" in where.partition(":")[0]:
        return Place(text, Kind.HUB, "", where, name)
    interface, colon, channel = where.partition(":")
    if colon:
        if not interface or not channel:
            raise PlaceError(f"--on {text}: write interface:channel, as in --on pcan:PCAN_USBBUS1")
        return Place(text, Kind.PYTHON_CAN, interface, channel, name)
    if not where or "=" in where or len(where) > _INTERFACE_MAX or " " in where:
        raise PlaceError(
            f"--on {text}: names no bus; write a SocketCAN interface (vcan0), the path of a hub's "
            "socket (./hub), or interface:channel of python-can, each with NAME= before it or not"
        )
    return Place(text, Kind.SOCKETCAN, "", where, name)


def places_of_buses(texts: Sequence[str], buses: Sequence[str]) -> dict[str, Place]:
    """Where recorded buses are sent: the places of `[BUS=]WHERE`, by bus; one bus needs no name.

    Args:
        texts: what `--on` was told.
        buses: of the recording, at least one.

    Raises:
        PlaceError: one names nothing, or it is not clear for which bus it is.
    """
    found: dict[str, Place] = {}
    for place in map(parse_place, texts):
        name = place.name or (buses[0] if len(buses) == 1 else "")
        if name not in buses or name in found:
            what = f"{name} is sent elsewhere already"
            if name not in found:
                what = f"there are frames of {', '.join(buses)}"
            raise PlaceError(f"--on {place.text}: {what}; write --on {buses[0]}=WHERE")
        found[name] = place
    return found


def topic_name(text: str) -> str:
    """The text as a bus may be called in a recording: letters, digits, `_`, `-` and `.` only."""
    return "_".join(_NAME.findall(text)) or "can"


def refuse_twice(names: Sequence[str], places: Sequence[Place]) -> None:
    """Raises PlaceError: two buses have one name, or are one."""
    known: dict[str, Place] = {}
    for name, place in zip(names, places, strict=True):
        other = known.setdefault(name, place)
        if other is not place:
            raise PlaceError(
                f"--on {place.text}: {other.text} is called {name} already; give it another name: "
                f"--on NAME={place.text.rpartition('=')[2]}"
            )
