"""Identity of the running motorhil: version, compiled or pure cores, source digest."""

from functools import cache
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from motorhil import emulators
from motorhil.harness.source import FILE, digest_of

_A_CORE: Final = "motorhil.emulators.simulation.event_queue"  # compiled whenever any core is


def version() -> str:
    """Return the installed version, or "unknown" in a folder that was never installed."""
    return version_of("motorhil") or "unknown"


@cache
def version_of(distribution: str) -> str:
    """Return the installed version of a distribution, or "" without one. Cached."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def cores_are_compiled() -> bool:
    """Return True if the emulator cores run as machine code."""
    spec = find_spec(_A_CORE)
    origin = "" if spec is None or spec.origin is None else spec.origin
    return origin.endswith(tuple(EXTENSION_SUFFIXES))


@cache
def source_digest() -> str:
    """Return a short digest of the names and contents of the packages' source files.

    An installed wheel contains it, because it takes 30 ms. Cached: the running code does not change
    when the files do.
    """
    root = _root()
    try:
        return (root / FILE).read_text("ascii").strip()
    except OSError:
        return digest_of(root)


def cores() -> str:
    """Return in words which cores run."""
    return "compiled cores" if cores_are_compiled() else "pure Python cores"


def describe() -> str:
    """Return version, cores, source digest and location in one line."""
    return f"motorhil {version()}, {cores()}, source {source_digest()} in {_root()}"


def _root() -> Path:
    return Path(emulators.__file__).parent.parent
