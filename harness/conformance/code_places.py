"""Where in the code something happened, as whoever mends it needs to know: "file:line"."""

import os
import sys
from collections.abc import Iterable, Sequence
from types import FrameType, TracebackType
from typing import Final

from harness.conformance import clause

_KIT: Final = str(clause.__file__)  # where `expect` raises; what it was told stands in its caller

Line = tuple[str, int]
"""(file, line)."""


def home_of(module: str) -> str:
    """The folder of the whole package that the loaded module is of; the file if it is of none."""
    package = sys.modules.get(module.partition(".")[0])
    file: str | None = getattr(package, "__file__", None)
    if file is None:
        return ""
    return os.path.dirname(file) + os.sep if hasattr(package, "__path__") else file


def raised_at(error: BaseException, home: str = "") -> str:
    """Where it, or what caused it, was raised: the last line in `home`, else the last of all."""
    while error.__cause__ is not None:
        error = error.__cause__
    return place_in(list(_lines_of(error.__traceback__)), home)


def called_at(frame: FrameType | None) -> str:
    """Where this frame is now."""
    return "" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"


def place_in(lines: Sequence[Line], home: str = "") -> str:
    """The last of the lines, outermost first, that is in `home`; else the last; "" if none is."""
    lines = [line for line in lines if line[0] != _KIT] or lines
    own = [line for line in lines if home and line[0].startswith(home)]
    chosen = own or lines
    return f"{chosen[-1][0]}:{chosen[-1][1]}" if chosen else ""


def _lines_of(traceback: TracebackType | None) -> Iterable[Line]:
    while traceback is not None:
        yield traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
        traceback = traceback.tb_next
