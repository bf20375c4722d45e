"""Fragment of a rig file: the disturbances of one world, in a file or in a recording.

A recording holds the fragment with which it was made, and each act of a hand, as metadata. Thus
they do not change its messages. An act is the table that the rig file would have had.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from motorhil.harness.rig.config.toml import RigError, Source, read_source
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.records import is_recording

WORLD: Final = "world"
"""Metadata with the fragment with which a recording was made."""
HAND: Final = re.compile(r"hand ([1-9][0-9]*)")
"""Metadata with one act of a hand; the name is also that of its fault."""
_TABLE, _OF, _UNTIL = "toml", "of", "until_s"
Metadata = Mapping[str, Mapping[str, str]]


def table_of(text: str) -> dict[str, str]:
    """Return the metadata of a fragment, or of an act that is this table of it."""
    return {_TABLE: text}


def end_of(fault: str, at_s: float) -> dict[str, str]:
    """Return the metadata of an act that ends the fault of this name."""
    return {_OF: fault, _UNTIL: repr(at_s)}


def fragment_in(metadata: Metadata) -> str:
    """Return the fragment that repeats a recording without hands; "": the rig file suffices."""
    texts = {WORLD: metadata.get(WORLD, {}).get(_TABLE, "")}
    for name in sorted(filter(HAND.fullmatch, metadata), key=number_of):
        act = metadata[name]
        if _TABLE in act:
            texts[name] = act[_TABLE]
        elif act.get(_OF) in texts:
            texts[act[_OF]] += f"{_UNTIL} = {act.get(_UNTIL)}\n"
    return "\n".join(filter(None, texts.values()))


def number_of(name: str) -> int:
    """Return the number of an act of a hand; 0 for another name."""
    found = HAND.fullmatch(name)
    return 0 if found is None else int(found[1])


def read_fragment(path: Path) -> Source:
    """Return the fragment in a file, or that of a recording.

    Raises:
        RigError: the file cannot be read, or the recording has no fragment.
    """
    if not is_recording(path):
        return read_source(path, "name a fragment of `motorhil swarm`, or a recording")
    try:
        with read_trace(path) as trace:
            text = fragment_in(trace.metadata)
    except TraceError as error:
        raise RigError(error.path, error.what, error.remedy) from None
    if not text:
        raise RigError(path, "has no acts by hand, and no fragment", "run the rig without --world")
    return Source(path, text)
