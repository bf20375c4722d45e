"""Standard streams that cannot control a terminal.

Names and texts in files, and in frames of a bus, may be anybody's. A control character in them
would move the cursor, colour or hide lines, or answer to the shell.
"""

import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TextIO, cast, final

# C0 without tab and line feed, C1, the marks that turn the direction of text round, and the bytes
# of file names that are not UTF-8 (PEP 383)
_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")

_GOOD, _BAD, _OPEN = "32", "31", "33"  # green, red, yellow: ECMA-48, 8.3.117 (SGR)
_COLOURS: Final = {
    **dict.fromkeys(("held", "passed"), _GOOD),
    **dict.fromkeys(("broken", "failed", "crashed", "hung", "left behind"), _BAD),
    **dict.fromkeys(("could not judge", "not applicable"), _OPEN),
}


def printable(text: str) -> str:
    """Return the text with every control character as an escape, except tab and line feed."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


@final
class _Printable:
    """A text stream in front of another one; everything but writing is that one's."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text, printable."""
        return self._stream.write(printable(text))

    def write_as_is(self, text: str) -> int:
        """Write a text that is printable already, but for colours of ours."""
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:  # Any: whatever the stream has
        return getattr(self._stream, name)


def teller(verb: str) -> Callable[[str], None]:
    """Return a function that prints a sentence on stderr at once, in the name of this verb."""

    def tell(text: str) -> None:
        print(f"motorhil {verb}:", text, file=sys.stderr, flush=True)

    return tell


def has_colours(choice: str, stream: TextIO) -> bool:
    """Return True if verdicts on the stream get colours.

    Args:
        choice: of the option --color; "auto" follows NO_COLOR and FORCE_COLOR, then the terminal.
        stream: standard output.

    Source: no-color.org and force-color.org: the variables count if they are not empty.
    """
    if choice != "auto":
        return choice == "always"
    if os.environ.get("NO_COLOR"):
        return False
    if os.environ.get("FORCE_COLOR"):
        return True
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def coloured(word: str, shown: str) -> str:
    """Return the text shown for a verdict, with the colour of the verdict if it has one."""
    colour = _COLOURS.get(word)
    return shown if colour is None else f"\x1b[{colour}m{printable(shown)}\x1b[0m"


def print_as_is(line: str) -> None:
    """Print a line that is printable already, but for texts of `coloured`."""
    write = getattr(sys.stdout, "write_as_is", sys.stdout.write)
    write(f"{line}\n")


@contextmanager
def printable_streams() -> Iterator[None]:
    """Print to stdout and stderr as `printable` returns it."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast("TextIO", _Printable(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
