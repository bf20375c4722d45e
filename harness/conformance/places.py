"""Places in the code, as "file:line": where an error was raised, or where a program hangs."""

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Final

from motorhil.harness.conformance import clause

_HERE: Final = Path(__file__).parent
CLAUSES: Final = (str(_HERE / "clauses"), str(_HERE / "drives" / "clauses"))
"""The folders of all clauses."""
_SHARED: Final = (str(clause.__file__), os.path.join(CLAUSES[0], "helpers.py"))
"""Files whose functions raise for their callers; a place in the calling clause is preferred."""

Line = tuple[str, int]
"""(file, line)."""


def home_of(module: str) -> str:
    """Return the top-level package folder of a loaded module, or its file if it has no package."""
    parts = module.split(".")
    package = sys.modules.get(".".join(parts[: 2 if parts[0] == "motorhil" else 1]))
    file: str | None = getattr(package, "__file__", None)
    if file is None:
        return ""
    return os.path.dirname(file) + os.sep if hasattr(package, "__path__") else file


def raised_at(error: BaseException, home: str | tuple[str, ...] = "") -> str:
    """Return where the error or its cause was raised: the last line in `home`, or the last line."""
    while error.__cause__ is not None:
        error = error.__cause__
    return place_in(list(_lines_of(error.__traceback__)), home)


def called_at(frame: FrameType | None) -> str:
    """Return the current place of a frame."""
    return "" if frame is None else f"{frame.f_code.co_filename}:{frame.f_lineno}"


def place_in(lines: Sequence[Line], home: str | tuple[str, ...] = "") -> str:
    """Return the last line that is in `home`, or the last line of all; "" if there is none.

    The outermost line is the first.
    """
    lines = [line for line in lines if line[0] not in _SHARED] or lines
    own = [line for line in lines if home and line[0].startswith(home)]
    chosen = own or lines
    return f"{chosen[-1][0]}:{chosen[-1][1]}" if chosen else ""


def _lines_of(traceback: TracebackType | None) -> Iterable[Line]:
    while traceback is not None:
        yield traceback.tb_frame.f_code.co_filename, traceback.tb_lineno
        traceback = traceback.tb_next
