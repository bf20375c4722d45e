"""Location of the sources, also beside an installed build."""

import os
from pathlib import Path

import motorhil

CHECKOUT = Path(os.environ.get("MOTORHIL_CHECKOUT", Path(__file__).parents[2]))
CORES = Path(motorhil.__file__).absolute().parents[1]
"""The folder with the package motorhil that this process has imported."""
PACKAGES = ("motorapi", "emulators", "traces", "harness")


def sources() -> list[Path]:
    """Return every module of the four packages, in order."""
    return [path for name in PACKAGES for path in sorted((CHECKOUT / name).rglob("*.py"))]
