"""Numbers on the command line: what is none, or out of range, is told with its limits and unit."""

import argparse
import math
from collections.abc import Callable
from typing import Final

_NS: Final = 1_000_000_000
_NS_MAX: Final = 2**64 - 1  # MCAP's log time


def real(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """For argparse's `type`: a finite number from `low` to `high` [unit]."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise _wrong(text, "a number", low, high, unit)
        return value

    return read


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """For argparse's `type`: a whole number from `low` to `high` [unit]."""

    def read(text: str) -> int:
        value = int(text) if text.isdecimal() and text.isascii() else -1
        if not low <= value <= high:
            raise _wrong(text, "a whole number", low, high, unit)
        return value

    return read


def identifier(text: str) -> int:
    """For argparse's `type`: a CAN identifier in hexadecimal, with an h behind it or not."""
    digits = text.lower().removesuffix("h")
    try:
        value = int(digits, 16) if digits.isalnum() else -1
    except ValueError:
        value = -1
    if not 0 <= value <= 0x1FFFFFFF:
        raise argparse.ArgumentTypeError(f"{text!r} is no identifier; say 0 to 1FFFFFFF, as 181")
    return value


def time_ns(text: str) -> int:
    """For argparse's `type`: seconds, exactly as they are written, as ns."""
    whole_s, _, part = text.partition(".")
    digits = (whole_s or "0") + (part or "0")
    if text in ("", ".") or not (digits.isascii() and digits.isdecimal()) or len(part) > 9:
        raise _no_time(text)
    value = int(whole_s or "0") * _NS + int(part.ljust(9, "0"))
    if value > _NS_MAX:
        raise _no_time(text)
    return value


def _no_time(text: str) -> argparse.ArgumentTypeError:
    limit = f"0 to {_NS_MAX / _NS:.0f} s, with 9 digits behind the point at most"
    return argparse.ArgumentTypeError(f"{text!r} is no time; say {limit}")


def _wrong(text: str, what: str, low: float, high: float, unit: str) -> argparse.ArgumentTypeError:
    words = f"{text!r} is not {what} from {low:g} to {high:g} {unit}".rstrip()
    return argparse.ArgumentTypeError(words)
