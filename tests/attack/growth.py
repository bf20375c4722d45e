"""Memory over long use: hours of one recorded rig, and many rigs in one process.

Bounds: hours of recording stay within 10 MB of the first hour; rigs within 20 MB of the first tenth
of their usual number, after which nothing should be new.
"""

import gc
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, TrapezoidalTrajectory
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.motors.drive_rigs import HEAD, drive
from tests.support.motors.kinds import EVERY

HOURS_MB: Final = 10.0
RIGS_MB: Final = 20.0
STEP_S: Final = 300.0
STEPS_AN_HOUR: Final = 12
MOVE_EVERY_S: Final = 10.0
RIGS_FIRST: Final = 100


def resident_mb() -> float:
    """Return the resident memory of this process [MB], without garbage."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


class Growth:
    """The memory after each step, compared with that after the first ones.

    Args:
        unit: the word for a step in the table.
        bound_mb: how much more than after the first steps is allowed [MB].
        measure: returns the memory [MB].
    """

    def __init__(
        self, unit: str, bound_mb: float, measure: Callable[[], float] = resident_mb
    ) -> None:
        self._unit, self._bound_mb, self._measure = unit, bound_mb, measure
        self._first_mb: float | None = None

    def note(self, number: int) -> None:
        """Print the memory after this number of units.

        Raises:
            AssertionError: it has grown beyond the bound.
        """
        now_mb = self._measure()
        first_mb = self._first_mb = now_mb if self._first_mb is None else self._first_mb
        print(f"{number:>8} {self._unit} {now_mb:>9.1f} MB {now_mb - first_mb:>+8.1f}", flush=True)
        assert now_mb - first_mb <= self._bound_mb, (
            f"memory grew by more than {self._bound_mb:g} MB"
        )


def turn(rig: Rig) -> None:
    """Move the first motor there and back, forth at every other call."""
    motor = next(iter(rig.motors.values()))
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.5 if motor.position() < 0.25 else -0.5))
    motor.start()
    motor.wait_until_done(10)


def begin_hours(seed: int) -> Attempt:
    """Return the attempts: five minutes each of one recorded rig; its motor moves cyclically."""
    keep = tempfile.TemporaryDirectory(prefix="motorhil-attack-")
    text = HEAD.replace("seed = 1", f"seed = {seed}") + drive("left", 1)
    description = parse_rig(Source(Path("it.toml"), text), installed_plugins())
    rig = Rig(description, record=Path(keep.name) / "hours.mcap")
    growth = Growth("hours", HOURS_MB)

    def attempt(number: int) -> Done:
        for _ in range(round(STEP_S / MOVE_EVERY_S)):
            end_ns = rig.runtime.now_ns() + round(MOVE_EVERY_S * 1e9)
            turn(rig)
            rig.runtime.run_for((end_ns - rig.runtime.now_ns()) / 1e9)
        if (number + 1) % STEPS_AN_HOUR == 0:
            growth.note((number + 1) // STEPS_AN_HOUR)
        return Done(1, b"", Counter({"simulated seconds": round(STEP_S)}))

    def end() -> None:
        rig.close()
        keep.cleanup()

    weakref.finalize(attempt, end)
    return attempt


def open_and_close(number: int, seed: int) -> None:
    """Use a rig of one kind of hardware: open it, move, close it."""
    kinds = list(EVERY.values())
    kind = kinds[number % len(kinds)]
    description = parse_rig(Source(Path(f"{kind.name}.toml"), kind.rig()), installed_plugins())
    with Rig(description, seed=seed + number) as rig:
        rig.motors["left"].enable()
        turn(rig)


def begin_rigs(seed: int) -> Attempt:
    """Return the attempts: one rig each, of one kind of hardware after another."""
    growth = Growth("rigs", RIGS_MB)

    def attempt(number: int) -> Done:
        open_and_close(number, seed)
        if (number + 1) % RIGS_FIRST == 0:
            growth.note(number + 1)
        return Done(1)

    return attempt


HOURS: Final = Attack("hours", "times five minutes", begin_hours)
RIGS: Final = Attack("rigs", "rigs", begin_rigs)
