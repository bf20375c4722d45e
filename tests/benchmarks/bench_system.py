"""System figures: demo, long run, short rigs, csp at 1 kHz, rest, and SDO uploads.

Each workload runs in a process of its own, with the pure cores and, after `make compiled`, with the
compiled ones. The demo and csp grow with simulated time and drives, the rig at rest with heartbeats
only.
"""

import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from tests.benchmarks.bench_adaptations import RIG
from tests.benchmarks.bench_canopen import _peer_uploads_per_s

WORKLOADS = Path(__file__).with_name("workloads.py")
COMPILED = Path(__file__).parents[2] / ".venv-compiled" / "bin" / "python"
UPLOADS = 2_000
ROUNDS = 5

Figures = list[tuple[str, float, str]]


def _workload(python: str | Path, cores: str, name: str) -> Figures:
    command = [str(python), "-P", str(WORKLOADS), name]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    figures = [line.split("\t") for line in lines]
    return [(f"{cores}: {what}", float(figure), unit) for what, figure, unit in figures]


def _uploads_per_s() -> float:
    """Return SDO uploads per second of CPU by canopen's client, over the emulated bus."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(RIG)
        with Rig.open(path) as rig:
            hardware = Cia402HwMotor(rig.bus("can0"), 3)
            rig.runtime.run_for(0.35)
            hardware.connect()
            best = 0.0
            for _ in range(ROUNDS):
                begun = time.process_time()
                for _ in range(UPLOADS):
                    hardware.upload(0x6064)
                best = max(best, UPLOADS / (time.process_time() - begun))
            hardware.close()
    return best


def run() -> Figures:
    """Return the figures as (name, figure, unit)."""
    # CPU time of all threads: other load would make the peer's threads wait for one another.
    ours, peer = _uploads_per_s(), _peer_uploads_per_s(time.process_time)
    figures = [
        ("SDO uploads by canopen's client, drive and bus physics", ours, "1/s"),
        ("the same from canopen's LocalNode, python-can virtual", peer, "1/s"),
        ("ours against that", ours / peer, "x"),
    ]
    for python, cores in ((sys.executable, "pure"), (COMPILED, "compiled")):
        if Path(python).exists():
            for name in ("demo", "long", "suite", "drives", "csp", "rest"):
                figures += _workload(python, cores, name)
    return figures
