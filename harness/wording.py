"""How keys, names and values are written in messages: short, and never more than one line."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Final

from harness.toml_lines import BARE_KEY, KeyPath

_SHOWN_MAX: Final = 60


def dotted(path: KeyPath) -> str:
    """The path as a person writes it: keys joined by dots, items of lists in brackets."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            quoted = key if BARE_KEY.fullmatch(key) else repr(key)
            text += f".{quoted}" if text else quoted
    return text


def listed(names: Iterable[str]) -> str:
    """Names with commas between them, or "none"."""
    return ", ".join(names) or "none"


def nearest(name: str, known: Sequence[str]) -> str:
    """A remedy: the known name that is most like `name`; else to take this one out."""
    for candidate in known:  # a unit left out is the likeliest mistake of all
        if candidate.startswith(f"{name}_"):
            return f"did you mean {candidate}?"
    found = difflib.get_close_matches(name.lower(), [k.lower() for k in known], 1, 0.6)
    for candidate in known:
        if found and candidate.lower() == found[0]:
            return f"did you mean {candidate}?"
    return "take it out, or use one of these"


def kind_of(value: object) -> str:
    """What TOML calls a value of this type, with its article."""
    if isinstance(value, bool):
        return "a boolean"
    for kind, name in _KINDS:
        if isinstance(value, kind):
            return name
    return "a date or time"


def a_kind_of(value: object) -> str:
    """What Python calls it, with an article: "None", "the class Motor", "a 'str'"."""
    if value is None:
        return "None"
    return (
        f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__!r}"
    )


_KINDS: Final = (
    (str, "a string"),
    (int, "an integer"),
    (float, "a float"),
    (dict, "a table"),
    (list, "an array"),
)


def shown(value: object) -> str:
    """A value as TOML writes it, cut short."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict | list):
        return "1 entry" if len(value) == 1 else f"{len(value)} entries"
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 3] + "..."


def one_line(text: str) -> str:
    """The text with everything that is not printable written as an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
