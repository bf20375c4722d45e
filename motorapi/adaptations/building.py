"""What every `build` of this package does: it reads a table of settings, and shares hardware.

Third parties may use it for adaptations of their own.
"""

from collections.abc import Callable, Collection, Hashable, Mapping
from difflib import get_close_matches
from typing import Generic, Protocol, TypeVar, final
from weakref import WeakValueDictionary

from motorapi.errors import UsageError


class Hardware(Protocol):
    """A hardware object, as far as sharing it goes.

    Attributes:
        users: how many motors were built on it by settings; the last one closes it.
    """

    users: int

    @property
    def label(self) -> str:
        """Its name for people."""

    @property
    def is_closed(self) -> bool:
        """Whether it can be used no more."""

    def close(self) -> None:
        """It is used no more."""


HardwareT = TypeVar("HardwareT", bound=Hardware)


@final
class Shared(Generic[HardwareT]):
    """The hardware objects that were built from settings; motors that name the same share one.

    Args:
        noun: what messages call the thing: "drive".
    """

    def __init__(self, noun: str) -> None:
        self._noun = noun
        self._built: WeakValueDictionary[Hashable, HardwareT] = WeakValueDictionary()

    def get(
        self,
        key: Hashable,
        make: Callable[[], HardwareT],
        has_settings: Callable[[HardwareT], bool],
    ) -> HardwareT:
        """The hardware object of this key, with one user more; made if there is none.

        Args:
            key: tells one thing from all others.
            make: makes it.
            has_settings: whether one that exists has the settings that are asked for.

        Raises:
            UsageError: it has not.
        """
        hardware = self._built.get(key)
        if hardware is None or hardware.is_closed:
            hardware = self._built[key] = make()
        elif not has_settings(hardware):
            raise UsageError(
                f"{self._noun} {hardware.label} is used with other settings already; motors that"
                " share it share its settings"
            )
        hardware.users += 1
        return hardware

    def give_back(self, hardware: HardwareT) -> None:
        """One user less; the last one closes it."""
        hardware.users -= 1
        if hardware.users == 0:
            hardware.close()


def refuse_unknown(table: Mapping[str, object], known: Collection[str], what: str) -> None:
    """Raises UsageError if a key is not among the known ones; `what`: what none of them is."""
    for key in table:
        if key not in known:
            near = get_close_matches(key, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"
            raise UsageError(f"{key} is no {what}; {hint}")


def as_name(value: object) -> str | None:
    """The name of a motor in a table; None: none is given."""
    return None if value is None else str(value)


def number(key: str, value: object) -> float:
    """The number of this key, whole or not.

    Raises:
        UsageError: it is none.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"{key} = {value!r}: must be a number")
    return value
