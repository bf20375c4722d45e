"""Programs that are not Python: what they are, and the library that gives them the rig's time.

The library is preloaded, so it needs a dynamically linked program of this machine. A wheel with
compiled cores contains it. Elsewhere it is built once, in less than a second, by a C compiler.
"""

import hashlib
import mmap
import os
import shutil
import stat
import struct
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final, final

LIBRARY: Final = "libmotorhil_clock.so"
SOURCES: Final = Path(__file__).parent / "preload"
_PACKAGE: Final = Path(__file__).parents[2]
_FLAGS: Final = (
    *("-shared", "-fPIC", "-O2", "-std=gnu11", "-fvisibility=hidden"),
    *("-Wall", "-Wextra", "-Werror"),
)
_BUILD_S: Final = 120.0
_ELF: Final = b"\x7fELF"
_ENDS: Final = {1: "<", 2: ">"}  # EI_DATA: little-endian, big-endian
_HEAD_64: Final = "HHIQQQIHHH"  # type, machine, version, entry, program headers, ..., size, count
_HEAD_32: Final = "HHIIIIIHHH"
_INTERPRETER: Final = 3  # PT_INTERP
_MACHINES: Final = {3: "x86", 40: "Arm", 62: "x86-64", 183: "AArch64", 243: "RISC-V"}
_GO: Final = b"\xff Go buildinf:"
_SCRIPT: Final = b"#!"


@final
class BinaryError(Exception):
    """A program cannot have the rig's time.

    Attributes:
        problem: which file, and what is wrong with it.
        remedy: what to do instead.
    """

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.problem = problem
        self.remedy = remedy


def preload(word: str, folder: Path, environment: Mapping[str, str]) -> str:
    """Return LD_PRELOAD for the program of a command, "" for Python, which needs none.

    A program that does not exist gets none, either: it cannot be started.

    Args:
        word: the first word of the command.
        folder: where it runs.
        environment: what it will have.

    Raises:
        BinaryError: it cannot have the rig's time, or the library cannot be built.
    """
    found = shutil.which(word, path=environment.get("PATH")) if "/" not in word else folder / word
    if found is None or not Path(found).is_file() or _is_python(Path(word)):
        return ""
    for path in _interpreters(Path(found)):
        if _is_python(path):
            return ""
        _require_dynamic(path)
    place = str(library())
    if set(place) & set(" :"):
        raise BinaryError(
            f"{place}: LD_PRELOAD cannot name a path with a space or colon", "install it elsewhere"
        )
    return ":".join(filter(None, (place, environment.get("LD_PRELOAD", ""))))


def _interpreters(path: Path) -> list[Path]:
    """Return the program that runs a script, after `env` if that is used; or the program itself."""
    with path.open("rb") as file:
        line = file.readline(256)
    if not line.startswith(_SCRIPT):
        return [path]
    words = [word for word in os.fsdecode(line[len(_SCRIPT) :]).split() if word != "-S"]
    if len(words) > 1 and Path(words[0]).name == "env":
        words[0] = shutil.which(words[1]) or words[1]
    return [Path(words[0])] if words and Path(words[0]).is_file() else []


def _is_python(path: Path) -> bool:
    return any(one.name.startswith("python") for one in (path, path.resolve()))


def _require_dynamic(path: Path) -> None:
    beside = "joins = false lets it run beside the rig"
    facts, own = _facts(path), _facts(Path(sys.executable))
    if facts is None or own is None:
        return  # the operating system will tell what is wrong with it
    machine, interpreter = facts
    if machine != own[0]:
        name = _MACHINES.get(machine[1], f"machine {machine[1]}")
        raise BinaryError(f"{path} is for {name}", f"expected one for this machine; {beside}")
    if not interpreter:
        raise BinaryError(f"{path} is statically linked", f"link it dynamically; {beside}")
    if "musl" in interpreter and "musl" not in own[1]:
        raise BinaryError(f"{path} uses another C library", f"build it with glibc; {beside}")
    if _is_of_go(path):
        raise BinaryError(f"{path} is a Go program, which waits without the C library", beside)
    found = path.stat()
    if found.st_mode & stat.S_ISUID and found.st_uid != os.geteuid():
        raise BinaryError(f"{path} runs as another user", f"remove its set-user-ID bit; {beside}")


def _is_of_go(path: Path) -> bool:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return data.find(_GO) >= 0


def _facts(path: Path) -> tuple[tuple[int, int], str] | None:
    """Return (class, machine) and the dynamic linker, "" without one; None for no ELF file."""
    with path.open("rb") as file:
        head = file.read(64)
        if not head.startswith(_ELF) or len(head) < 64:
            return None
        is_64, end = head[4] == 2, _ENDS.get(head[5], "<")
        fields = struct.unpack_from(end + (_HEAD_64 if is_64 else _HEAD_32), head, 16)
        machine, place, size, count = fields[1], fields[4], fields[8], fields[9]
        for number in range(count):
            file.seek(place + number * size)
            entry = file.read(size)
            if len(entry) < size or struct.unpack_from(f"{end}I", entry)[0] != _INTERPRETER:
                continue
            start = struct.unpack_from(f"{end}{'Q' if is_64 else 'I'}", entry, 8 if is_64 else 4)[0]
            file.seek(start)
            return (head[4], machine), os.fsdecode(file.read(256).partition(b"\0")[0])
        return (head[4], machine), ""


# ---- the library -------------------------------------------------------------------------------


def library() -> Path:
    """Return the library: that of the installation, or one that is built now or was before.

    Raises:
        BinaryError: there is no compiler, or it fails.
    """
    shipped = SOURCES / LIBRARY
    if shipped.is_file():
        return shipped
    digest = hashlib.sha256()
    for source in sorted((*SOURCES.glob("*.c"), *SOURCES.glob("*.h"))):
        digest.update(source.read_bytes())
    target = _cache() / digest.hexdigest()[:16] / LIBRARY
    if not target.is_file():
        build(target)
    return target


def _cache() -> Path:
    """Return `build` of a checkout; elsewhere the user's cache."""
    checkout = _PACKAGE.resolve().parent
    if (checkout / "setup.py").is_file():
        return checkout / "build" / "preload"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "motorhil"


def build(target: Path) -> None:
    """Build the library.

    Raises:
        BinaryError: there is no compiler, or it fails.
    """
    compiler = os.environ.get("CC", "cc").split()
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.{os.getpid()}")  # another process may build it, too
    sources = [str(path) for path in sorted(SOURCES.glob("*.c"))]
    command = [*compiler, *_FLAGS, *sources, "-o", str(part), "-ldl", "-lpthread"]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_BUILD_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BinaryError(
            f"{LIBRARY} cannot be built: {error}",
            "install a C compiler, or a wheel with compiled cores",
        ) from None
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower()]
        raise BinaryError(
            f"{LIBRARY} cannot be built: {(lines or ['no reason given'])[0]}",
            f"see the errors of: {' '.join(command)}",
        )
    part.replace(target)
