"""`make bench`: performance figures of this machine, compared with peers.

python -m tests.benchmarks [NAME ...]      only benchmarks whose name contains one of these
"""

import importlib
import pkgutil
import sys

import tests.benchmarks
from motorhil.harness.version import describe


def main(wanted: list[str]) -> int:
    """Print one line per figure."""
    print(describe())
    for module in sorted(m.name for m in pkgutil.iter_modules(tests.benchmarks.__path__)):
        if not module.startswith("bench_") or (wanted and not any(w in module for w in wanted)):
            continue
        print(f"\n{module.removeprefix('bench_')}")
        for name, figure, unit in importlib.import_module(f"tests.benchmarks.{module}").run():
            print(f"  {name:<66} {figure:>12,.3f} {unit}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
