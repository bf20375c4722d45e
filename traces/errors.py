"""The error class of this package."""

from typing import final


@final
class TraceError(Exception):
    """A recording cannot be written or read.

    Attributes:
        path: the file.
        what: the problem.
        offset: the byte concerned; None: the whole file.
        remedy: what to do; "" if there is nothing.
    """

    def __init__(self, path: str, what: str, *, remedy: str = "", offset: int | None = None):
        self.path = path
        self.what = what
        self.remedy = remedy
        self.offset = offset
        where = "" if offset is None else f" at byte {offset}"
        super().__init__(f"{path}: {what}{where}" + (f"; {remedy}" if remedy else ""))
