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
from motorhil.harness.version import describe, source_digest, version
from tests.benchmarks import kept

FELT = ("bench_system", "bench_start", "bench_locks", "bench_modbus", "bench_canopen")


def modules(wanted: list[str], every: bool) -> list[str]:
    """Return the names of the benchmarks to run."""
    names = sorted(one.name for one in pkgutil.iter_modules(tests.benchmarks.__path__))
    known = [name for name in names if name.startswith("bench_")]
    if wanted:
        return [name for name in known if any(one in name for one in wanted)]
    return known if every else [name for name in known if name in FELT]


def figures(names: list[str]) -> Iterator[tuple[str, float, list[kept.Figure]]]:
    """Yield each benchmark with the loop's time beside it [ms], and its figures.

    The speed of a virtual machine may change within seconds, so each benchmark has a loop of its
    own, before and after it.
    """
    for name in names:
        run = importlib.import_module(f"tests.benchmarks.{name}").run
        before = kept.loop_ms()
        some = list(kept.named(run()))
        yield name.removeprefix("bench_"), min(before, kept.loop_ms()), some


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
        begun_s = time.monotonic()
        for room, loop, some in figures(names):
            print(f"\n{room}, beside a loop of {loop:.1f} ms")
            for name, figure, unit in some:
                key = f"{room}: {name}"
                scaled = kept.scaled(figure, unit, loop)
                runs.setdefault(key, (unit, []))[1].append(scaled)
                moved = kept.told(before.get(key), scaled, unit)
                print(f"  {name:<66} {figure:>12,.3f} {unit:<12} {moved}".rstrip(), flush=True)
        print(f"\n{time.monotonic() - begun_s:.0f} s")
    if options.keep:
        now = {name: kept.kept_of(unit, some) for name, (unit, some) in runs.items()}
        kept.write({**before, **now}, f"motorhil {version()}, source {source_digest()}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
