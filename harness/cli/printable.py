"""Standard streams that cannot control a terminal.

Names and texts in files, and in frames of a bus, may be anybody's. A control character in them
would move the cursor, colour or hide lines, or answer to the shell.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, TextIO, cast, final

# C0 without tab and line feed, C1, and the marks that turn the direction of text round
_CONTROL: Final = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


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

    def __getattr__(self, name: str) -> Any:  # Any: whatever the stream has
        return getattr(self._stream, name)


@contextmanager
def printable_streams() -> Iterator[None]:
    """Print to stdout and stderr as `printable` returns it."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast("TextIO", _Printable(stream)) for stream in before)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
