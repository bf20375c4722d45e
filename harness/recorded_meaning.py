"""Meaning of a recording, for verbs that compare."""

import sys
from os import PathLike

from traces.meaning import Meaning, meaning_of
from traces.reader import read_trace


def meaning_in(path: str | PathLike[str], verb: str) -> Meaning:
    """Return the recording's meaning; report a cut recording on stderr in the verb's name.

    Raises:
        TraceError: the recording cannot be read, or is damaged.
    """
    with read_trace(path) as trace:
        meaning = meaning_of(trace)
        if trace.cut is not None:
            print(f"motorhil {verb}: {path}: {trace.cut}", file=sys.stderr)
    return meaning
