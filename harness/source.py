"""Digest of the source files: what `motorhil --version` and every recording tell.

The build of a wheel runs this module alone, and puts the digest into the wheel.
"""

import hashlib
from pathlib import Path
from typing import Final

FILE: Final = "harness/source.sha256"
"""The digest in an installed wheel, relative to the package `motorhil`."""
_PACKAGES: Final = ("motorapi", "emulators", "traces", "harness")


def digest_of(root: Path) -> str:
    """Return a short digest of the names and contents of the source files below `root`."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
