"""Fuzzing of emulated drives with millions of frames, as the attack `drive` of `make fuzz`.

python -m tests.properties.fuzz [--seed N] [--frames N]     new frames, the same for the same seed
python -m tests.properties.fuzz --again FILE                failed ones, as kept in FILE
"""

import argparse
import sys
import time
import traceback
from pathlib import Path
from typing import Final

from tests.properties.fuzz.target import EPISODE, Reached, endure, episode, fails, shrunk

OUT: Final = Path("out")
MAX_GROWTH_MB: Final = 64
WARM_UP: Final = 20
"""Number of episodes after which memory should no longer grow."""


def resident_mb() -> float:
    """Return the resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def main() -> int:
    """Run the command; return 0 (passed), 1 (failed) or 2 (wrong usage)."""
    parser = argparse.ArgumentParser(prog="python -m tests.properties.fuzz")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--again", type=Path, metavar="FILE")
    options = parser.parse_args()
    if options.again is not None:
        return again(options.again)
    return fuzz(options.seed, options.frames)


def again(file: Path) -> int:
    """Repeat the steps in the file; return the exit status."""
    from tests.properties.fuzz.frames import steps_in

    error = fails(steps_in(file.read_text().splitlines()))
    if error is None:
        print(f"{file}: passed")
        return 0
    traceback.print_exception(error)
    return 1


def fuzz(seed: int, frames: int) -> int:
    """Send this many frames of the seed, to one drive after another; return the exit status."""
    reached = Reached()
    begun = time.perf_counter()
    warm_mb = 0.0
    episodes = -(-frames // EPISODE)
    for number in range(episodes):
        if number == WARM_UP:
            warm_mb = resident_mb()
        try:
            endure(episode(seed, number, min(EPISODE, frames - number * EPISODE)), reached)
        except Exception as error:
            return keep(seed, number, error)
        if sys.stderr.isatty() and number % 10 == 0:
            print(f"\r{reached.frames} frames", end="", file=sys.stderr)
    took_s = time.perf_counter() - begun
    print(f"seed {seed}: {reached.frames} frames, {reached.frames / took_s:.0f} frames/s")
    print(reached.table())
    if warm_mb:
        growth_mb = resident_mb() - warm_mb
        print(f"memory: {growth_mb:+.1f} MB over {episodes - WARM_UP} drives")
        if growth_mb > MAX_GROWTH_MB:
            print(f"FAILED: memory grows without end (more than {MAX_GROWTH_MB} MB)")
            return 1
    return 0


def keep(seed: int, number: int, error: Exception) -> int:
    """Write a minimal failing sequence to a file, print the command that repeats it, return 1."""
    from tests.properties.fuzz.frames import line_of

    traceback.print_exception(error)
    steps = shrunk(list(episode(seed, number)))
    OUT.mkdir(exist_ok=True)
    file = OUT / f"fuzz-{seed}-{number}.txt"
    file.write_text("".join(line_of(step) + "\n" for step in steps))
    print(f"FAILED: seed {seed}, drive {number}: {type(error).__name__}: {error}")
    print(f"again, with {len(steps)} steps: python -m tests.properties.fuzz --again {file}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
