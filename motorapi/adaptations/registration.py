"""Helpers for every `build` function: reading settings and sharing hardware.

Third parties may use them for adaptations of their own.
"""

from collections.abc import Callable, Collection, Hashable, Mapping
from difflib import get_close_matches
from typing import Final, Generic, Protocol, TypeVar, cast, final
from weakref import WeakValueDictionary

from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import UsageError


class Hardware(Protocol):
    """A hardware object, as far as sharing is concerned.

    Attributes:
        users: the number of motors built on it from settings; the last one closes it.
    """

    users: int

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""

    def close(self) -> None:
        """Close the hardware; no motor can use it afterwards."""


HardwareT = TypeVar("HardwareT", bound=Hardware)


@final
class _Built:
    """The hardware objects on one bus that were built from settings, by kind and place."""

    def __init__(self) -> None:
        self.hardware: Final[WeakValueDictionary[Hashable, Hardware]] = WeakValueDictionary()


@final
class Shared(Generic[HardwareT]):
    """One kind of hardware built from settings; motors on the same hardware share one object.

    The objects are kept with their bus, line or runtime.

    Args:
        noun: the word for such hardware in messages ("drive").
    """

    def __init__(self, noun: str) -> None:
        self._noun = noun

    def get(
        self,
        home: object,
        place: Hashable,
        make: Callable[[], HardwareT],
        has_settings: Callable[[HardwareT], bool],
    ) -> HardwareT:
        """Return the hardware object at this place, made on first use, and count one more user.

        Args:
            home: the bus or line of the hardware; its runtime if it has no bus.
            place: identifies the hardware there.
            make: makes the hardware object.
            has_settings: returns whether an existing object has the requested settings.

        Raises:
            UsageError: the existing object has other settings.
        """
        built = context_of(home).medium.part(_Built).hardware
        hardware = cast("HardwareT | None", built.get((self, place)))
        if hardware is None or hardware.is_closed:
            hardware = make()
            built[self, place] = hardware
        elif not has_settings(hardware):
            raise UsageError(
                f"{self._noun} {hardware.label} is used with other settings already; motors "
                "that share it must have the same settings"
            )
        hardware.users += 1
        return hardware

    def give_back(self, hardware: HardwareT) -> None:
        """Count one user less; the last one closes the hardware."""
        hardware.users -= 1
        if hardware.users == 0:
            hardware.close()


def refuse_unknown(table: Mapping[str, object], known: Collection[str], what: str) -> None:
    """Raise UsageError if a key is not known; `what` names the kind of key in the message."""
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
            raise UsageError(f"{key} is not a {what}; {hint}")


def as_name(value: object) -> str | None:
    """Return the name of a motor in a table, or None if none is given."""
    return None if value is None else str(value)


def number(key: str, value: object) -> float:
    """Return the number of this key, integer or not.

    Raises:
        UsageError: the value is not a number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"{key} = {value!r}: must be a number")
    return value
