"""`make bench`: performance figures of this machine, with peers and with the figures kept.

python -m tests.benchmarks             those that a user feels, in about three minutes
python -m tests.benchmarks NAME ...    benchmarks whose name contains one of these
python -m tests.benchmarks --all       every benchmark
python -m tests.benchmarks --keep 3    run three times, and keep the figures in kept.tsv
"""

import argparse
import importlib
import pkgutil
import time
from collections.abc import Iterator

import tests.benchmarks
from motorhil.harness.version import describe
from tests.benchmarks import kept

FELT = ("bench_system", "bench_start", "bench_locks", "bench_modbus", "bench_canopen")


def modules(wanted: list[str], every: bool) -> list[str]:
    """Return the names of the benchmarks to run."""
    names = sorted(one.name for one in pkgutil.iter_modules(tests.benchmarks.__path__))
    known = [name for name in names if name.startswith("bench_")]
    if wanted:
        return [name for name in known if any(one in name for one in wanted)]
    return known if every else [name for name in known if name in FELT]


def figures(names: list[str]) -> Iterator[tuple[str, kept.Figure]]:
    """Yield each figure with the benchmark that it belongs to, as they are measured."""
    for name in names:
        run = importlib.import_module(f"tests.benchmarks.{name}").run
        yield from ((name.removeprefix("bench_"), one) for one in kept.named(run()))


def main() -> int:
    """Print one line per figure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--keep", type=int, default=0, metavar="ROUNDS")
    options = parser.parse_args()
    if options.keep < 0:
        parser.error(f"--keep {options.keep}; expected 1 or more rounds")
    names = modules(options.names, options.all)
    if not names:
        parser.error(f"no benchmark is named {' or '.join(options.names)}")
    print(describe())
    before = kept.read()
    runs: dict[str, tuple[str, list[float]]] = {}
    for _ in range(max(1, options.keep)):
        begun_s, room = time.monotonic(), ""
        loop = kept.loop_ms()
        for where, (name, figure, unit) in figures(names):
            if where != room:
                room = where
                print(f"\n{room}")
            key = f"{room}: {name}"
            scaled = kept.scaled(figure, unit, loop)
            runs.setdefault(key, (unit, []))[1].append(scaled)
            moved = kept.told(before.get(key), scaled, unit)
            print(f"  {name:<66} {figure:>12,.3f} {unit:<12} {moved}".rstrip(), flush=True)
        print(f"\nloop of this machine: {loop:.1f} ms before, {kept.loop_ms():.1f} ms after")
        print(f"{time.monotonic() - begun_s:.0f} s")
    if options.keep:
        now = {name: kept.kept_of(unit, some) for name, (unit, some) in runs.items()}
        kept.write({**before, **now}, describe())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
