"""Compiled cores of a clone, which its command `motorhil` takes in place of the pure ones.

`make compiled` builds them into `.venv-compiled` beside the sources. It leaves a proof of the
sources there: the names, sizes and times of all files. The proof takes 4 ms, where a digest of the
contents would take 50 ms at each start. `python -m motorhil.compiled` prints it.
"""

import os
import sys
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Final

PURE: Final = "MOTORHIL_PURE"
"""Environment variable; 1: keep the pure cores."""

_BUILD: Final = ".venv-compiled"
_FILES: Final = ("setup.py", "pyproject.toml", "requirements.lock")


def proof(clone: Path) -> str:
    """Return a digest of the names, sizes and times of all that the cores are built from."""
    facts = [_fact(name, (clone / name).stat()) for name in _FILES]
    facts.extend(_facts(str(clone / "motorhil"), "motorhil"))
    return blake2b("\n".join(sorted(facts)).encode(), digest_size=16).hexdigest()


def _facts(folder: str, name: str) -> Iterator[str]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                if entry.name != "__pycache__":
                    yield from _facts(entry.path, f"{name}/{entry.name}")
            elif not entry.name.endswith(".pyc"):
                yield _fact(f"{name}/{entry.name}", entry.stat())


def _fact(name: str, found: os.stat_result) -> str:
    return f"{name} {found.st_size} {found.st_mtime_ns}"


def is_current(clone: Path) -> bool:
    """Return True if the clone has compiled cores, and its sources have not changed since."""
    build = clone / _BUILD
    try:
        made_from = (build / ".proof").read_text().strip()
    except OSError:
        return False
    return made_from == proof(clone) and _python(clone).exists()


def run_compiled(clone: Path) -> None:
    """Replace this process by the same command with the compiled cores of the clone.

    Return if there are none, or if `MOTORHIL_PURE` is 1. Say so if the sources have changed since.
    """
    build = clone / _BUILD
    if os.environ.get(PURE) == "1" or not build.is_dir() or Path(sys.prefix) == build:
        return  # PYTHONPATH can lead from the compiled cores to the sources
    if is_current(clone):
        python = _python(clone)
        os.execv(python, [str(python), *sys.orig_argv[1:]])
    sys.stderr.write(
        "motorhil: pure Python cores; the sources have changed since `make compiled`;"
        f" run it again, or set {PURE}=1\n"
    )


def _python(clone: Path) -> Path:
    return clone / _BUILD / "bin" / "python"


if __name__ == "__main__":
    print(proof(Path()))
