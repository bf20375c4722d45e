"""A drive between limit switches, with a home switch; positions in encoder counts."""

from dataclasses import dataclass
from math import pi

from tests.support.cia402.bench import MS, Bench

TURN = 2_000  # increments per motor turn
GEAR = 66.0
RAD = 2.0 * pi / (TURN * GEAR)  # one increment, at the output
IN_PROGRESS, INTERRUPTED, ATTAINED, DONE = 0x0000, 0x0400, 0x1000, 0x1400
ERROR_MOVING, ERROR_AT_REST = 0x2000, 0x2400


@dataclass(frozen=True, kw_only=True)
class Track:
    """Positions of the switches; None: no switch, or it extends to the end of travel."""

    negative: int | None = -6_000
    positive: int | None = 6_000
    home: tuple[int | None, int | None] | None = (-300, 400)
    index: int | None = 700

    def table(self) -> dict[str, object]:
        table: dict[str, object] = {}
        if self.negative is not None:
            table["negative_limit_rad"] = self.negative * RAD
        if self.positive is not None:
            table["positive_limit_rad"] = self.positive * RAD
        if self.home is not None:
            for key, place in zip(("home_from_rad", "home_to_rad"), self.home, strict=True):
                if place is not None:
                    table[key] = place * RAD
        if self.index is None:
            table["index_pulse"] = False
        else:
            table["index_rad"] = self.index % TURN * 2.0 * pi / TURN
        return table


def bench_on(track: Track, start: int = 0, *, tick_s: float = 0.001, **objects: int) -> Bench:
    """Return an enabled drive in hm; objects are given by name, like o6098=17 or o6099_1=5000."""
    values = {
        "6099h:1": 20_000,
        "6099h:2": 2_000,
        "609Ah": 400_000,
        **{f"{name[1:5]}h{name[5:].replace('_', ':')}": value for name, value in objects.items()},
    }
    bench = Bench(
        initial_position_rad=(start + 0.25) * RAD,
        switches=track.table(),
        servo={"tick_s": tick_s},
        objects=values,
    )
    bench.enable(mode=6)
    bench.run(10 * MS)
    return bench


def status(bench: Bench) -> int:
    return bench.drive._power_drive.statusword() & 0x3400


def home(bench: Bench, within_s: float = 20.0) -> int:
    """Start homing and wait for its end; return statusword & 3400h."""
    bench.controlword(0x0F)
    bench.controlword(0x1F)
    return finish(bench, within_s)


def finish(bench: Bench, within_s: float = 20.0) -> int:
    end = bench.now + int(within_s * 1e9)
    while status(bench) not in (DONE, ERROR_AT_REST) and bench.now < end:
        due = bench.drive.next_deadline_ns()
        bench.run_until(end if due is None else min(due, end))
    return status(bench)


def home_count(bench: Bench) -> int:
    """Return the count that now has position 0."""
    return bench.drive.axis.count() - bench.drive.axis.position_inc()
