"""Axes for tests, at rest or holding their position."""

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.servo_tables import ServoGains
from motorhil.emulators.plant.presets import WHEEL_60W

MS = 1_000_000
GAINS = ServoGains.tuned(WHEEL_60W, MS, 10)


def new_axis(initial_position_inc: int = 0) -> Axis:
    return Axis(WHEEL_60W, GAINS, MS, 10, initial_position_inc)


def powered_axis(initial_position_inc: int = 0) -> Axis:
    axis = new_axis(initial_position_inc)
    axis.power(True)
    axis.at(50 * MS)
    return axis


def tick_by_tick(axis: Axis, start_ms: int, flag: int, becomes: bool, within_ms: int = 5000) -> int:
    """Return the first tick from `start_ms` on at which the flag has this state."""
    for k in range(start_ms, start_ms + within_ms):
        axis.at(k * MS)
        if (axis.flags & flag != 0) is becomes:
            return k
    raise AssertionError(f"flag {flag} never became {becomes}")
