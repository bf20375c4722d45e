"""Changes of one table in a rig's text, which recordings contain."""

import re
from collections.abc import Collection


def with_table(text: str, table: str, lines: str, without: Collection[str]) -> str:
    """Return the text with these lines in `[table]`, and without that table's keys `without`.

    The table must have a header of its own in the text, and each of its keys must be on one line.
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
