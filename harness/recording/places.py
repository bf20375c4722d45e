"""The `--on` option: which bus, where it is, and its recorded name."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

_NAME: Final = re.compile(r"[\w.-]+")
_INTERFACE_MAX: Final = 15  # IFNAMSIZ of linux/if.h, without the terminating zero


class PlaceError(Exception):
    """An unreachable or wrongly specified bus; the message gives the reason and the remedy."""


@final
class Kind(Enum):
    """The way in which a bus is reached."""

    SOCKETCAN = "SocketCAN"
    HUB = "hub"
    PYTHON_CAN = "python-can"


@final
@dataclass(frozen=True, slots=True)
class Place:
    """A bus to record from or to send to.

    Attributes:
        text: the option's value as given.
        kind: the way in which it is reached.
        interface: python-can's interface name; "" for other kinds.
        channel: the SocketCAN interface, the hub's socket (PATH or PATH#BUS), or python-can's
            channel.
        name: the requested name of the bus; "" if none was given.
    """

    text: str
    kind: Kind
    interface: str
    channel: str
    name: str


def parse_place(text: str) -> Place:
    """Parse `[NAME=]WHERE` into a place.

    WHERE is a SocketCAN interface (`vcan0`), the socket of `motorhil serve --socket` (any text with
    a slash; `PATH#can1` selects a bus other than the first), or `interface:channel` of python-can.

    Raises:
        PlaceError: the text names no bus.
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
            raise PlaceError(
                f"--on {text}: incomplete python-can bus; write "
                "interface:channel, as in --on pcan:PCAN_USBBUS1"
            )
        return Place(text, Kind.PYTHON_CAN, interface, channel, name)
    if not where or "=" in where or len(where) > _INTERFACE_MAX or " " in where:
        raise PlaceError(
            f"--on {text}: names no bus; write a SocketCAN interface (vcan0), the path of a "
            "hub's socket (./hub), or interface:channel of python-can, each optionally after "
            "NAME="
        )
    return Place(text, Kind.SOCKETCAN, "", where, name)


def places_of_buses(texts: Sequence[str], buses: Sequence[str]) -> dict[str, Place]:
    """Return the place for each recorded bus, from `[BUS=]WHERE`; a single bus needs no name.

    Args:
        texts: the values of `--on`.
        buses: the buses of the recording, at least one.

    Raises:
        PlaceError: a value names no bus, or does not identify one recorded bus.
    """
    found: dict[str, Place] = {}
    for place in map(parse_place, texts):
        name = place.name or (buses[0] if len(buses) == 1 else "")
        if name not in buses or name in found:
            what = f"{name} has a destination already"
            if name not in found:
                what = f"the recording has frames of {', '.join(buses)}"
            raise PlaceError(f"--on {place.text}: {what}; write --on {buses[0]}=WHERE")
        found[name] = place
    return found


def topic_name(text: str) -> str:
    """Return the text as a valid bus name: only letters, digits, `_`, `-` and `.`."""
    return "_".join(_NAME.findall(text)) or "can"


def refuse_twice(names: Sequence[str], places: Sequence[Place]) -> None:
    """Check that all buses are distinct.

    Raises:
        PlaceError: two buses have the same name or are the same bus.
    """
    known: dict[str, Place] = {}
    for name, place in zip(names, places, strict=True):
        other = known.setdefault(name, place)
        if other is not place:
            raise PlaceError(
                f"--on {place.text}: the name {name} is used already, by {other.text}; give it "
                f"another name: --on NAME={place.text.rpartition('=')[2]}"
            )
