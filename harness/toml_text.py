"""A rig file with another table in it: what a record tells of the rig that ran is its text."""

import re
from collections.abc import Collection


def with_table(text: str, table: str, lines: str, without: Collection[str]) -> str:
    """The text with these lines in `[table]`, and without what it says there of the keys `without`.

    The table must stand in the text by its own header, each of its keys on one line.
    """
    head = f"[{table}]\n"
    before, found, rest = text.partition(head)
    assert found, f"no {head.strip()} in a file that is ours"
    end = re.search(r"^\[", rest, re.MULTILINE)
    body, behind = (rest[: end.start()], rest[end.start() :]) if end else (rest, "")
    kept = [
        line
        for line in body.splitlines(keepends=True)
        if line.partition("=")[0].strip() not in without
    ]
    return before + head + lines + "".join(kept) + behind
