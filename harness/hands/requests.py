"""Requests of a page: what a hand asks for, checked like the tables of a rig file."""

from collections.abc import Mapping
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.settings import (
    REQUIRED,
    SettingError,
    nearest,
    number,
    parse_toml,
    read,
    text,
)

STEP_S: Final = 0.01
_KEYS_MAX: Final = 1_000  # characters


@final
@frozen(kw_only=True, slots=False)
class Stop:
    """Let time stand still."""


@final
@frozen(kw_only=True, slots=False)
class Continue:
    """Let time pass again."""


@final
@frozen(kw_only=True, slots=False)
class Step:
    """Let a duration pass, and then stop time."""

    for_s: float = number(STEP_S, 1e-6, 60.0, "s", "How long.")


@final
@frozen(kw_only=True, slots=False)
class Speed:
    """Let time pass at another pace."""

    pace: float | None = number(
        None, 1e-3, 1e6, "", "Seconds of the rig in one second; absent: no limit.", example="10"
    )


@final
@frozen(kw_only=True, slots=False)
class Stimulate:
    """Set an input of a controller."""

    controller: str = text(REQUIRED, "The controller.")
    name: str = text(REQUIRED, "The input.")
    value: float = number(REQUIRED, -1e12, 1e12, "", "Its value from now on.")


@final
@frozen(kw_only=True, slots=False)
class Inject:
    """Begin a fault of a bus; its further keys are TOML, as in a rig file."""

    bus: str = text(REQUIRED, "The bus or line.")
    kind: str = text(REQUIRED, "The kind of fault.")
    keys: str | None = text(None, "Further keys, with commas between.")

    def further(self) -> dict[str, object]:
        """Return the further keys.

        Raises:
            SettingError: they are not keys of TOML, or are the hand's own.
        """
        example, line = "write them as identifier = 0x181, limit = 1", self.keys or ""
        if "\n" in line or "\r" in line or len(line) > _KEYS_MAX:
            raise SettingError(("keys",), "are not one line of up to 1000 characters", example)
        try:
            found = parse_toml(f"keys = {{ {line} }}")
        except (ValueError, RecursionError) as error:
            raise SettingError(("keys",), f"are not TOML: {error}", example) from None
        keys = found.pop("keys")
        assert isinstance(keys, dict)
        if found:
            raise SettingError(("keys",), "are not keys of one table", example)
        for key in ("bus", "kind", "name", "from_s", "until_s", "by_hand"):
            if key in keys:
                raise SettingError((key,), "is set by the page", "take it out")
        return keys


@final
@frozen(kw_only=True, slots=False)
class Mend:
    """End a fault that a hand began."""

    name: str = text(REQUIRED, "The fault, such as hand 1.")


ACTS: Final = (Stimulate, Inject, Mend)
"""Requests that act on the rig, not only on its time."""
Request = Stop | Continue | Step | Speed | Stimulate | Inject | Mend
KINDS: Final[Mapping[str, type[Request]]] = {
    "stop": Stop,
    "continue": Continue,
    "step": Step,
    "pace": Speed,
    "stimulus": Stimulate,
    "fault": Inject,
    "mend": Mend,
}


def request_in(table: Mapping[str, object]) -> Request:
    """Return the request that a page has sent.

    Raises:
        SettingError: it is not a request; the message is for the page's reader.
    """
    kind = table.get("act")
    if not isinstance(kind, str) or kind not in KINDS:
        known = list(KINDS)
        raise SettingError(("act",), f"unknown act {kind!r}", nearest(str(kind), known))
    rest = {key: value for key, value in table.items() if key != "act"}
    return read(KINDS[kind], rest)
