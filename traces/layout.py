"""Layouts of values in bytes, as text: most of a decoder of frames.

    Layout("temperature i8 C; +1; voltage u16/10 V; @6 errors u16")

has a value per part: its name; its type, i (signed), u or f (float) with its bits; a divisor (/) or
factor (*), if any; its unit, if any. Values follow one another; `+1` leaves out so many bytes, `@6`
goes to that byte. `layouts` reads a table of messages.
"""

import re
from collections.abc import Iterator
from struct import Struct
from typing import Final, Literal, NamedTuple, final

Order = Literal["little", "big"]

_PART: Final = re.compile(
    r"\+(?P<skip>\d+)|(?:@(?P<at>\d+) )?(?P<name>.+?) (?P<type>[iuf])(?P<bits>\d+)"
    r"(?P<scale>[/*]\S+)?(?: (?P<unit>.+))?"
)


@final
class Signal(NamedTuple):
    """A signal of a CAN message: its name, its value in the unit, or by name, and the unit."""

    name: str
    value: int | float | str
    unit: str


@final
class Item(NamedTuple):
    """A value: its place and size in bytes, its name, type, scale ("/10", "*0.1", "") and unit."""

    at: int
    size: int
    name: str
    type: str
    scale: str
    unit: str


@final
class Layout:
    """The values in the bytes of a frame.

    Args:
        text: the parts, separated by semicolons.
        order: the order of bytes.

    Attributes:
        items: the values by their first byte.
        size: the bytes up to the end of the last value.

    Raises:
        ValueError: a part is not of this form.
    """

    def __init__(self, text: str, order: Order = "little") -> None:
        self.items: Final[dict[int, Item]] = {}
        self.size: int = 0
        self._order: Final = order
        for part in filter(None, map(str.strip, text.split(";"))):
            found = _PART.fullmatch(part)
            if found is None:
                raise ValueError(f'layout: "{part}" is not a value; expected "name u16/10 unit"')
            if found["skip"]:
                self.size += int(found["skip"])
                continue
            at, size = int(found["at"] or self.size), int(found["bits"]) // 8
            words = found["name"], found["type"], found["scale"] or "", found["unit"] or ""
            self.items[at] = Item(at, size, *words)
            self.size = at + size

    def value(self, item: Item, data: bytes) -> int | float:
        """Return the value of an item; missing bytes count as 0."""
        raw = data[item.at : item.at + item.size].ljust(item.size, b"\0")
        value: int | float = int.from_bytes(raw, self._order, signed=item.type == "i")
        if item.type == "f":
            kind = {2: "e", 4: "f", 8: "d"}[item.size]
            (value,) = Struct(("<" if self._order == "little" else ">") + kind).unpack(raw)
        if not item.scale:
            return value
        number = float(item.scale[1:])
        if item.scale[0] == "/":
            return value / number
        return value * (int(number) if number.is_integer() else number)

    def signals(self, data: bytes) -> Iterator[Signal]:
        """Yield the values."""
        for item in self.items.values():
            yield Signal(item.name, self.value(item, data), item.unit)


def layouts(
    text: str, order: Order = "little", base: int = 10
) -> dict[int, tuple[str, tuple[Layout, ...]]]:
    """Return name and layouts of each message of a table.

    A line has "number name: layout", or more layouts with | between them (request and answer); a
    line with an indent continues the one before.

    Args:
        text: the table.
        order: the order of bytes.
        base: the base of the numbers.

    Raises:
        ValueError: a line is not of this form.
    """
    found = {}
    for line in re.sub(r"\n +", " ", text.strip()).splitlines():
        head, _, parts = line.partition(":")
        number, _, name = head.partition(" ")
        own = tuple(Layout(part, order) for part in parts.split("|"))
        found[int(number, base)] = name, own
    return found
