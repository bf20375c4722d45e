"""What a recording means, for verbs that compare; that it is cut is told."""

import sys
from os import PathLike

from traces.meaning import Meaning, meaning_of
from traces.reader import read_trace


def meaning_in(path: str | PathLike[str], verb: str) -> Meaning:
    """What it means, as far as it goes; where it is cut is told on stderr, by that verb.

    Raises:
        TraceError: it cannot be read, or is damaged.
    """
    with read_trace(path) as trace:
        meaning = meaning_of(trace)
        if trace.cut is not None:
            print(f"motorhil {verb}: {path}: {trace.cut}", file=sys.stderr)
    return meaning
