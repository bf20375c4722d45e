"""Reader for rows of car loggers: milliseconds, "x", identifier, data.

  000000ADx089A0C020000000000000000

All numbers are hexadecimal; only the value of an identifier shows if it has 11 or 29 bits.

Source: recordings of UW Formula Motorsports (../shared/data/traffic/INDEX.md).
"""

import re
from collections.abc import Sequence
from typing import Final, final

from traces import traffic
from traces.traffic import Findings, Frame

_ROW: Final = re.compile(r"([0-9A-Fa-f]{8})x([0-9A-Fa-f]{8})((?:[0-9A-Fa-f]{2}){0,8})$")


def looks_like_sd_rows(line: str) -> bool:
    """Return True for such a row."""
    return _ROW.match(line.strip()) is not None


@final
class SdRowReader:
    """Reader of such rows."""

    name = "sd-rows"

    def take(self, line: str, findings: Findings) -> Sequence[Frame]:
        """Return the frame of a line. Raises ValueError with the reason if it is unreadable."""
        stripped = line.strip()
        if not stripped:
            return ()
        match = _ROW.match(stripped)
        if match is None:
            raise ValueError("not a frame")
        findings.note(
            "identifiers up to 7FFh are read as 11 bits; the rows do not state the format"
        )
        can_id = int(match[2], 16)
        if can_id > traffic.EFF_MASK:
            raise ValueError(f"identifier {match[2]} has more than 29 bits")
        if can_id > traffic.SFF_MASK:
            can_id |= traffic.EFF
        frame = traffic.classic(can_id, bytes.fromhex(match[3]))
        return (Frame(int(match[1], 16) * 1_000_000, "can0", frame),)
