"""Costs of servo ticks in several uses, and time to rest."""

from collections.abc import Callable
from dataclasses import replace
from time import process_time

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.flags import PROFILE_ACTIVE
from motorhil.emulators.firmware.servo_tables import ServoGains, tables_of
from motorhil.emulators.plant.nonlinear import NO_EXTRAS, PlantExtras
from motorhil.emulators.plant.presets import WHEEL_60W

MS = 1_000_000
TICKS = 10_000
STEPS = 10
FAR = 10**9


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    off, held = ticks_to_rest()
    return [
        ("tick of a moving axis, 10 current steps, 10,000 in one go", best(batch), "us"),
        ("tick near the top speed, voltage clipped in every step", best(clipped), "us"),
        ("tick of a moving axis with heat, DC link, one body", best(one_body), "us"),
        ("tick of a moving axis with backlash, two bodies", best(two_bodies), "us"),
        ("tick of a moving axis, looked at every tick", best(singly), "us"),
        ("tick of a moving axis, waking for its events only", best(events), "us"),
        ("tick of a moving axis, waking for events, seen at 50 Hz", best(seen), "us"),
        ("cycle of 1 ms with a cyclic demand, read and followed", best(cyclic), "us"),
        ("hour of 100 axes at rest, each looked at once", best(resting), "ms"),
        ("making an axis, the first of its kind", best(making), "ms"),
        ("ticks from a move's end to exact rest, held", held, "ticks"),
        ("ticks from power off to exact rest, from standstill", off, "ticks"),
    ]


def best(measure: Callable[[], float]) -> float:
    """Return the least of several measurements; other load only adds time."""
    return min(measure() for _ in range(7))


def make(velocity_inc_s: float = 100_000.0, extras: PlantExtras = NO_EXTRAS) -> Axis:
    """Return an enabled axis at 1 s, moving at that velocity unless it is 0."""
    plant = replace(WHEEL_60W, extras=extras)
    axis = Axis(plant, ServoGains.tuned(plant, MS, STEPS), MS, STEPS)
    axis.power(True)
    axis.at(10 * MS)
    if velocity_inc_s:
        axis.move_to(FAR, velocity_inc_s, 300_000.0, 300_000.0)
    axis.at(1_000 * MS)
    return axis


def per_tick_us(seconds: float) -> float:
    return seconds / TICKS * 1e6


def batch() -> float:
    axis = make()
    start = process_time()
    axis.at((1_000 + TICKS) * MS)
    return per_tick_us(process_time() - start)


def one_body() -> float:
    heat = PlantExtras(
        thermal_resistance_winding_housing_k_w=1.7,
        thermal_resistance_housing_ambient_k_w=6.0,
        thermal_time_constant_winding_s=16.2,
        thermal_time_constant_motor_s=714.0,
        source_resistance_ohm=0.2,
    )
    return with_extras(heat)


def two_bodies() -> float:
    return with_extras(PlantExtras(backlash_rad=0.01))


def with_extras(extras: PlantExtras) -> float:
    axis = make(extras=extras)
    start = process_time()
    axis.at((1_000 + TICKS // 10) * MS)
    return per_tick_us(process_time() - start) * 10


def clipped() -> float:
    axis = make(1e6)
    start = process_time()
    axis.at((1_000 + TICKS) * MS)
    return per_tick_us(process_time() - start)


def singly() -> float:
    axis = make()
    start = process_time()
    for k in range(1_000, 1_000 + TICKS):
        axis.at(k * MS)
    return per_tick_us(process_time() - start)


def events() -> float:
    axis = make()
    end = (1_000 + TICKS) * MS
    start = process_time()
    wake = axis.next_event_ns()
    while wake is not None and wake < end:
        axis.at(wake)
        wake = axis.next_event_ns()
    return per_tick_us(process_time() - start)


def seen() -> float:
    axis = make()
    end = (1_000 + TICKS) * MS
    start = process_time()
    wake = axis.next_event_ns()
    look = 1_013 * MS
    while look < end:
        if wake is not None and wake < look:
            axis.at(wake)
        else:
            axis.at(look)
            look += 20 * MS
        wake = axis.next_event_ns()
    return per_tick_us(process_time() - start)


def cyclic() -> float:
    axis = make(0.0)
    start = process_time()
    for k in range(1_000, 1_000 + TICKS):
        axis.at(k * MS)  # its own wake-up
        axis.next_event_ns()
        axis.at(k * MS + 300_000)  # SYNC: status is read, a demand takes effect
        axis.position_inc()
        axis.follow(30 * (k - 1_000), MS)
        axis.next_event_ns()
    return per_tick_us(process_time() - start)


def resting() -> float:
    axes = [make(0.0) for _ in range(100)]
    start = process_time()
    for axis in axes:
        axis.at(3_600_000 * MS)
        axis.next_event_ns()
    return (process_time() - start) * 1e3


def making() -> float:
    gains = ServoGains.tuned(WHEEL_60W, MS, STEPS)
    tables_of.cache_clear()
    start = process_time()
    Axis(WHEEL_60W, gains, MS, STEPS)
    return (process_time() - start) * 1e3


def ticks_to_rest() -> tuple[float, float]:
    """Return the ticks to rest after power off, and at the end of a held move."""
    axis = make(0.0)
    axis.move_to(100_000, 100_000.0, 300_000.0, 300_000.0)
    tick = 1_000
    while axis.flags & PROFILE_ACTIVE:
        tick += 1
        axis.at(tick * MS)
    held = _until_rest(axis, tick)
    axis.power(False)
    return _until_rest(axis, tick + held), held


def _until_rest(axis: Axis, tick: int) -> int:
    """Return the number of ticks until no event is due."""
    ticks = 0
    wake = axis.next_event_ns()
    while wake is not None:
        axis.at(wake)
        ticks = wake // MS - tick
        wake = axis.next_event_ns()
    return ticks
