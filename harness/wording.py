"""Wording of keys, names and values in messages: short, one line."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Final

from harness.toml_lines import BARE_KEY, KeyPath

_SHOWN_MAX: Final = 60


def dotted(path: KeyPath) -> str:
    """Return the path as people write it: keys joined by dots, list items in brackets."""
    text = ""
    for key in path:
        if isinstance(key, int):
            text += f"[{key}]"
        else:
            quoted = key if BARE_KEY.fullmatch(key) else repr(key)
            text += f".{quoted}" if text else quoted
    return text


def listed(names: Iterable[str]) -> str:
    """Return the names separated by commas, or "none"."""
    return ", ".join(names) or "none"


def nearest(name: str, known: Sequence[str]) -> str:
    """Return a remedy: the known name most similar to `name`, or to remove it."""
    for candidate in known:  # a missing unit is the likeliest mistake
        if candidate.startswith(f"{name}_"):
            return f"did you mean {candidate}?"
    found = difflib.get_close_matches(name.lower(), [k.lower() for k in known], 1, 0.6)
    for candidate in known:
        if found and candidate.lower() == found[0]:
            return f"did you mean {candidate}?"
    return "take it out, or use one of these"


def kind_of(value: object) -> str:
    """Return TOML's word for the type of this value, with its article."""
    if isinstance(value, bool):
        return "a boolean"
    for kind, name in _KINDS:
        if isinstance(value, kind):
            return name
    return "a date or time"


def a_kind_of(value: object) -> str:
    """Return Python's word for it, with its article: "None", "the class Motor", "a 'str'"."""
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
    """Return a value as TOML writes it, shortened."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict | list):
        return "1 entry" if len(value) == 1 else f"{len(value)} entries"
    text = f'"{value}"' if isinstance(value, str) else str(value)
    return text if len(text) <= _SHOWN_MAX else text[: _SHOWN_MAX - 3] + "..."


def one_line(text: str) -> str:
    """Return the text with every non-printable character as an escape."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
