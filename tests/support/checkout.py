"""Location of the sources, also beside an installed build."""

import os
from pathlib import Path

CHECKOUT = Path(os.environ.get("MOTORHIL_CHECKOUT", Path(__file__).parents[2]))
PACKAGES = ("motorapi", "emulators", "traces", "harness")


def sources() -> list[Path]:
    """Return every module of the four packages, in order."""
    return [path for name in PACKAGES for path in sorted((CHECKOUT / name).rglob("*.py"))]
