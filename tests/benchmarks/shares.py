"""Shares of a workload's time by layer, as a table.

    python -m tests.benchmarks.shares [demo | csp | rest | kit] [--compiled]

The pure cores are measured by cProfile; built-in work (dictionaries, struct, heapq) counts for its
caller. Profiling makes calls dearer, so layers of many short functions look more expensive than
they are. The compiled cores are measured by perf, if it is installed, which sees no Python
functions.
"""

import argparse
import cProfile
import pstats
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from tests.benchmarks.native_shares import native_shares
from tests.benchmarks.workloads import WORKLOADS

LAYERS: Final = (  # the first layer whose part is in a file's path counts
    ("plant", ("/emulators/plant/",)),
    ("firmware", ("/emulators/firmware/",)),
    ("drive protocol", ("/emulators/canopen/", "/emulators/cia401/", "/emulators/cia402/")),
    ("bus", ("/emulators/can/", "/emulators/media/", "/emulators/gateways/")),
    ("event queue, networks", ("/emulators/",)),
    ("recorder", ("/traces/", "/harness/recording/", "/harness/rig/recording.py", "/zstandard/")),
    ("virtual time", ("/harness/virtual_time/", "/harness/python_can/")),
    ("rig, application, workload", ("/harness/", "/tests/benchmarks/")),
    ("motor interface", ("/motorapi/",)),
    ("host libraries", ("/canopen/", "/can/", "/pymodbus/")),
)
_REST: Final = "Python and its library"
_SCRIPT: Final = Path(__file__).with_name("workloads.py")
_COMPILED: Final = Path(__file__).parents[2] / ".venv-compiled" / "bin" / "python"

_WAITING: Final = "<method 'acquire' of '_thread.lock' objects>"  # while another party works


class _Profiles:
    """One profile per thread, because parties are threads."""

    def __init__(self) -> None:
        self._all: list[cProfile.Profile] = []

    def begin(self, *_: object) -> None:
        """Profile the calling thread from now on."""
        profile = cProfile.Profile()
        self._all.append(profile)
        profile.enable()

    def stats(self) -> pstats.Stats:
        """Return the statistics of all threads."""
        self._all[0].disable()
        return pstats.Stats(*self._all)


def shares(stats: pstats.Stats) -> Counter[str]:
    """Return seconds by layer."""
    out: Counter[str] = Counter()
    # (primitive calls, calls, own time, time with callees, the same by caller)
    for (file, _, name), (_, _, own_s, _, callers) in stats.stats.items():  # type: ignore[attr-defined]  # not in typeshed
        if file != "~":
            out[layer_of(file)] += own_s
            continue
        if name == _WAITING:
            continue
        asked_s = 0.0
        for (caller, _, _), (_, _, part_s, _) in callers.items():
            out[layer_of(caller)] += part_s
            asked_s += part_s
        out[_REST] += own_s - asked_s
    return out


def layer_of(file: str) -> str:
    """Return the layer that a source file belongs to."""
    for layer, parts in LAYERS:
        if any(part in file for part in parts):
            return layer
    return _REST


def main() -> None:
    """Print the shares, the largest first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("workload", nargs="?", default="demo", choices=sorted(WORKLOADS))
    parser.add_argument("--compiled", action="store_true", help="by perf; after make compiled")
    options = parser.parse_args()
    if options.compiled:
        spent = native_shares(_COMPILED, ["-P", str(_SCRIPT), options.workload], layer_of)
    else:
        spent = _pure_shares(WORKLOADS[options.workload])
    whole = sum(spent.values())
    for layer, part in spent.most_common():
        print(f"{layer:<54} {100 * part / whole:5.1f} %")


def _pure_shares(workload: Callable[[], object]) -> Counter[str]:
    profiles = _Profiles()
    threading.setprofile(profiles.begin)  # of threads started from now on
    profiles.begin()
    workload()
    threading.setprofile(None)  # type: ignore[arg-type]  # as its documentation has it
    return shares(profiles.stats())


if __name__ == "__main__":
    main()
