"""Which layer a workload's time is spent in, by the pure cores: a table.

    python -m tests.benchmarks.shares [demo | csp | rest]

By cProfile: what Python itself does (dictionaries, struct, heapq) counts for whoever asked for it.
Calls cost more while they are counted, so layers of many short functions look dearer than they
are; what the compiled cores spend where, only a profiler of the system can tell.
"""

import argparse
import cProfile
import pstats
import threading
from collections import Counter
from typing import Final

from tests.benchmarks.workloads import WORKLOADS

_LAYERS: Final = (  # the first whose part stands in a file's path
    ("plant", ("/emulators/plant/",)),
    ("firmware", ("/emulators/firmware/",)),
    ("drive protocol", ("/emulators/canopen/", "/emulators/cia401/", "/emulators/cia402/")),
    ("bus", ("/emulators/media/", "/emulators/can_segment.py", "/emulators/segment.py")),
    ("event queue, world", ("/emulators/",)),
    ("recorder", ("/traces/", "/harness/recorder.py", "/harness/rig_recording.py", "/zstandard/")),
    ("virtual time", ("/harness/virtual_time.py", "/harness/parties.py", "/harness/bus_ears.py")),
    ("rig, application, workload", ("/harness/", "/tests/benchmarks/")),
    ("motor interface", ("/motorapi/",)),
    ("host libraries", ("/canopen/", "/can/", "/pymodbus/")),
)
_REST: Final = "Python and its library"


_WAITING: Final = "<method 'acquire' of '_thread.lock' objects>"  # while another party works


class _Profiles:
    """One profile of each thread, for parties are threads."""

    def __init__(self) -> None:
        self._all: list[cProfile.Profile] = []

    def begin(self, *_: object) -> None:
        """The thread that calls it is profiled from now on."""
        profile = cProfile.Profile()
        self._all.append(profile)
        profile.enable()

    def stats(self) -> pstats.Stats:
        """What all of them did."""
        self._all[0].disable()
        return pstats.Stats(*self._all)


def shares(stats: pstats.Stats) -> Counter[str]:
    """Seconds by layer."""
    out: Counter[str] = Counter()
    # (calls that count once, calls, own time, time with callees, the same by caller)
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
    """The layer that a source file belongs to."""
    for layer, parts in _LAYERS:
        if any(part in file for part in parts):
            return layer
    return _REST


def main() -> None:
    """Prints the shares, the largest first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("workload", nargs="?", default="demo", choices=sorted(WORKLOADS))
    workload = WORKLOADS[parser.parse_args().workload]
    profiles = _Profiles()
    threading.setprofile(profiles.begin)  # of threads begun from now on
    profiles.begin()
    workload()
    threading.setprofile(None)  # type: ignore[arg-type]  # as its documentation has it
    spent = shares(profiles.stats())
    whole_s = sum(spent.values())
    for layer, layer_s in spent.most_common():
        print(f"{layer:<28} {100 * layer_s / whole_s:5.1f} %")


if __name__ == "__main__":
    main()
