"""The windows of the axis' flags: how near, and for how many servo ticks in a row; the gate."""

from typing import Final

from emulators.firmware.servo import Windows

NO_LIMIT: Final = 1e300


def default_windows(tick_ns: int) -> Windows:
    """Target 10 increments, no following error, speed 500 inc/s, velocity 2000 inc/s for 10 ms."""
    tick_s = tick_ns / 1e9
    return (
        *(10.0, NO_LIMIT, 500.0 * tick_s, 2000.0 * tick_s),
        *(in_a_row(0, 0, tick_ns), in_a_row(0, 0, tick_ns)),
        *(in_a_row(10_000_000, 0, tick_ns), in_a_row(10_000_000, 0, tick_ns)),
        *(-NO_LIMIT, NO_LIMIT),
    )


def with_gate(windows: Windows, low: float, high: float) -> Windows:
    """The same with another gate."""
    return (*windows[:8], low, high)


def in_a_row(time_ns: int | None, before: int, tick_ns: int) -> int:
    """How many ticks in a row say that something has been so for this time; None: as before."""
    return before if time_ns is None else -(-time_ns // tick_ns) + 1
