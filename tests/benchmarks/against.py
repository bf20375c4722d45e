"""Comparison of this revision's speed with another revision's.

    python -m tests.benchmarks.against REV [--rounds N] [--cores pure | compiled] [WORKLOAD ...]

Builds REV once, in build/against, and runs the workloads of each with its own Python. Figures that
both know are compared, so a workload must keep its meaning as long as its name. Figures
are CPU times, each the best of its process. Each line has the cost here divided by the cost there
(1.05: 5 % more here): for the best of all rounds, and as the range over single rounds.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Final

from tests.benchmarks.workloads import WORKLOADS

ROOT: Final = Path(__file__).parents[2]
SCRIPT: Final = "tests/benchmarks/workloads.py"
MAX: Final = 1.05  # largest acceptable cost ratio
_PYTHON: Final = {"pure": ".venv", "compiled": ".venv-compiled"}
_GROWS_WITH_COST: Final = {"us": True, "s": True, "x real time": False}  # other units are not costs

Costs = dict[str, float]


def built(revision: str) -> Path:
    """Return the folder of the revision with its sources and both builds; build them if absent."""
    asked = ["git", "-C", str(ROOT), "rev-parse", "--short=12", f"{revision}^{{commit}}"]
    name = subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()
    folder = ROOT / "build" / "against" / name
    done = folder / ".built"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        packed = subprocess.run(
            ["git", "-C", str(ROOT), "archive", name], check=True, capture_output=True
        )
        subprocess.run(["tar", "-x", "-C", str(folder)], input=packed.stdout, check=True)
        subprocess.run(["make", "-C", str(folder), "compiled"], check=True, stdout=sys.stderr)
        done.touch()
    return folder


def costs(folder: Path, cores: str, workload: str) -> Costs:
    """Return the cost of each figure of the workload in that folder."""
    python = folder / _PYTHON[cores] / "bin" / "python"
    ran = subprocess.run(
        [str(python), "-P", str(folder / SCRIPT), workload],
        check=True,
        capture_output=True,
        text=True,
    )
    found = {}
    for line in ran.stdout.splitlines():
        name, figure, unit = line.split("\t")
        if unit in _GROWS_WITH_COST:
            found[name] = float(figure) if _GROWS_WITH_COST[unit] else 1.0 / float(figure)
    return found


def told(name: str, here: list[float], there: list[float]) -> str:
    """Return one line: the ratio of the best costs, and the range of single rounds."""
    ratio = min(here) / min(there)
    single = [mine / other for mine, other in zip(here, there, strict=True)]
    mark = f"  more than {MAX}" if ratio > MAX else ""
    return f"{name:<58} {ratio:6.3f}  ({min(single):.3f} to {max(single):.3f}){mark}"


def main() -> None:
    """Print one line per figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("revision", metavar="REV")
    parser.add_argument("workloads", nargs="*", metavar="WORKLOAD", help=", ".join(WORKLOADS))
    parser.add_argument("--rounds", type=int, default=5, metavar="N")
    parser.add_argument("--cores", choices=sorted(_PYTHON), action="append")
    options = parser.parse_args()
    if options.rounds < 1 or not set(options.workloads) <= set(WORKLOADS):
        parser.error(f"--rounds from 1; WORKLOAD one of {', '.join(WORKLOADS)}")
    folder = built(options.revision)
    for cores in options.cores or sorted(_PYTHON):
        for workload in options.workloads or ("demo", "csp", "bus"):
            pairs = []
            for turn in range(options.rounds):
                first, second = (ROOT, folder) if turn % 2 else (folder, ROOT)
                one, other = costs(first, cores, workload), costs(second, cores, workload)
                pairs.append((one, other) if first is ROOT else (other, one))
            for name in pairs[0][0]:
                if name in pairs[0][1]:
                    line = told(name, [h[name] for h, _ in pairs], [t[name] for _, t in pairs])
                    print(f"{cores:<9} {line}", flush=True)


if __name__ == "__main__":
    main()
