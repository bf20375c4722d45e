"""Which motorhil this is: its version, whether its cores are compiled, and from which source."""

import hashlib
from functools import cache
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import emulators

_PACKAGES: Final = ("motorapi", "emulators", "traces", "harness")
_A_CORE: Final = "emulators.event_queue"  # compiled wherever any core is


def version() -> str:
    """The installed version; "unknown" when it runs from a folder that was never installed."""
    return version_of("motorhil") or "unknown"


@cache
def version_of(distribution: str) -> str:
    """The installed version of any distribution; "" if it is not installed. Read once."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def cores_are_compiled() -> bool:
    """Whether the emulator cores run as machine code."""
    spec = find_spec(_A_CORE)
    origin = "" if spec is None or spec.origin is None else spec.origin
    return origin.endswith(tuple(EXTENSION_SUFFIXES))


@cache
def source_digest() -> str:
    """A short digest of the packages' source files: names and contents, in order of names.

    Read once in a process: what runs does not change with the files.
    """
    root = _root()
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def cores() -> str:
    """Which cores run, in words."""
    return "compiled cores" if cores_are_compiled() else "pure Python cores"


def describe() -> str:
    """All of it, in one line."""
    return f"motorhil {version()}, {cores()}, source {source_digest()} in {_root()}"


def _root() -> Path:
    return Path(emulators.__file__).parent.parent
