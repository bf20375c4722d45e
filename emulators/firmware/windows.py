"""Windows of the axis' flags, their times in servo ticks, and the gate."""

from typing import Final

from emulators.firmware.servo import Windows

NO_LIMIT: Final = 1e300


def default_windows(tick_ns: int) -> Windows:
    """Return the defaults: target 10 inc, no following error, 500 and 2000 inc/s for 10 ms.

    The 500 inc/s are the speed threshold, the 2000 inc/s the velocity window.
    """
    tick_s = tick_ns / 1e9
    return (
        *(10.0, NO_LIMIT, 500.0 * tick_s, 2000.0 * tick_s),
        *(in_a_row(0, 0, tick_ns), in_a_row(0, 0, tick_ns)),
        *(in_a_row(10_000_000, 0, tick_ns), in_a_row(10_000_000, 0, tick_ns)),
        *(-NO_LIMIT, NO_LIMIT),
    )


def with_gate(windows: Windows, low: float, high: float) -> Windows:
    """Return the windows with another gate."""
    return (*windows[:8], low, high)


def in_a_row(time_ns: int | None, before: int, tick_ns: int) -> int:
    """Return the consecutive ticks for a condition of `time_ns`; None: `before`."""
    return before if time_ns is None else -(-time_ns // tick_ns) + 1
