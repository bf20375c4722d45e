"""Things of a rig by name."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Generic, TypeVar, final

T = TypeVar("T")


@final
class NoSuchName(KeyError):  # noqa: N818 -- it says what happened, as the errors of motorapi
    """A rig has no such motor, controller, bus or group; the message names the known ones."""

    def __str__(self) -> str:
        return str(self.args[0])


@final
class Named(Mapping[str, T], Generic[T]):
    """Things of a rig by name, each created on first use, in the order of the file."""

    def __init__(self, what: str, names: Iterable[str], make: Callable[[str], T]) -> None:
        self._kind = what
        self._names = tuple(names)
        self._make = make
        self._made: dict[str, T] = {}

    def __getitem__(self, name: str) -> T:
        """Return the thing of this name.

        Raises:
            NoSuchName: the name is unknown; a KeyError that names the known ones.
        """
        if name not in self._made:
            if name not in self._names:
                known = ", ".join(self._names) or "none"
                raise NoSuchName(f"this rig has no {self._kind} {name!r} (known: {known})")
            self._made[name] = self._make(name)
        return self._made[name]

    def __repr__(self) -> str:
        return f"<{self._kind}s of the rig: {', '.join(self._names) or 'none'}>"

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
