"""Places in the code, as "file:line", for failure reports."""

import os
import sys
from collections.abc import Iterable, Sequence
from types import FrameType, TracebackType
from typing import Final

from harness.conformance import clause

_KIT: Final = str(clause.__file__)  # `expect` raises here; the caller is the interesting place

Line = tuple[str, int]
"""(file, line)."""


def home_of(module: str) -> str:
    """Return the top-level package folder of a loaded module, or its file if it has no package."""
    package = sys.modules.get(module.partition(".")[0])
    file: str | None = getattr(package, "__file__", None)
    if file is None:
        return ""
    return os.path.dirname(file) + os.sep if hasattr(package, "__path__") else file


def raised_at(error: BaseException, home: str = "") -> str:
    """Return where the error or its cause was raised: the last line in `home`, or the last line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return place_in(list(_lines_of(error.__traceback__)), home)


def called_at(frame: FrameType | None) -> str:
    """Return the current place of a frame."""
    return "" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"


def place_in(lines: Sequence[Line], home: str = "") -> str:
    """Return the last line that is in `home`, or the last line of all; "" if there is none.

    The outermost line is the first.
    """
    lines = [line for line in lines if line[0] != _KIT] or lines
    own = [line for line in lines if home and line[0].startswith(home)]
    chosen = own or lines
    return f"{chosen[-1][0]}:{chosen[-1][1]}" if chosen else ""


def _lines_of(traceback: TracebackType | None) -> Iterable[Line]:
    while traceback is not None:
        yield traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
        traceback = traceback.tb_next
