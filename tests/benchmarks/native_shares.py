"""Shares of compiled cores' time by layer, sampled by perf.

The innermost function of ours counts for each sample, including the Python work that it causes.
Names of compiled functions contain their modules. Samples without a compiled function count as the
interpreter's, because perf does not see Python functions.
"""

import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

COLLECTOR: Final = "garbage collector"
INTERPRETED: Final = "interpreted: opening, motor interface, host libraries"
_SAMPLES_PER_S: Final = 500
_STACK_BYTES: Final = 16_384
_COMPILED: Final = re.compile(r"CPy(?:Def|Py|Global)_(.*)")
_COLLECTOR_NAME: Final = "gc_collect_main"
_INTERPRETER_NAME: Final = "_PyEval_EvalFrameDefault"
_PACKAGES: Final = ("emulators", "harness", "motorapi", "traces")


def native_shares(python: Path, command: list[str], layer_of: Callable[[str], str]) -> Counter[str]:
    """Return the number of samples by layer for a command run by that Python.

    Raises:
        OSError: perf is not installed.
        subprocess.CalledProcessError: perf or the command failed.
    """
    with TemporaryDirectory() as folder:
        data = str(Path(folder) / "perf.data")
        graph = f"dwarf,{_STACK_BYTES}"
        options = ["-q", "-e", "cpu-clock", "-F", str(_SAMPLES_PER_S), "--call-graph", graph]
        record = ["perf", "record", *options, "-o", data, str(python), *command]
        subprocess.run(record, check=True, stdout=sys.stderr)
        script = ["perf", "script", "-i", data, "-F", "ip,sym"]
        text = subprocess.run(script, check=True, capture_output=True, text=True).stdout
    modules = _modules(python)
    return Counter(_layer(stack, modules, layer_of) for stack in _stacks(text.splitlines()))


def _stacks(lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the function names of each sample, the innermost first."""
    stack: list[str] = []
    for line in lines:
        _, _, name = line.strip().partition(" ")
        if name:
            stack.append(name)
        elif stack:
            yield stack
            stack = []
    if stack:
        yield stack


def _layer(stack: list[str], modules: dict[str, str], layer_of: Callable[[str], str]) -> str:
    if any(name.startswith(_COLLECTOR_NAME) for name in stack):
        return COLLECTOR
    for name in stack:
        if name.startswith(_INTERPRETER_NAME):
            return INTERPRETED
        if found := _COMPILED.match(name):
            words = found[1].split("___")
            for count in range(len(words), 0, -1):
                file = modules.get("___".join(words[:count]))
                if file is not None:
                    return layer_of(file)
    return INTERPRETED  # Python's start and end


def _modules(python: Path) -> dict[str, str]:
    """Return files of compiled modules by mypyc's possible names: ends of the dotted name."""
    found: dict[str, str] = {}
    for library in sorted((python.parents[1] / "lib").rglob("*.so")):
        parts = [*library.parts[:-1], library.name.split(".")[0]]
        places = [place for place, part in enumerate(parts) if part in _PACKAGES]
        if places:
            words = parts[places[0] :]
            for count in range(1, len(words) + 1):
                found["___".join(words[-count:])] = f"/{'/'.join(words)}.py"
    return found
