"""Only for the compiled build: with MOTORHIL_COMPILE=1 the hot cores become C extensions (mypyc).

Everything else about the distribution stands in pyproject.toml. Build it with `make compiled`, into
an environment of its own, from a copy of the sources: an edited .py beside its .so would be ignored
without a word.
"""

import os
from pathlib import Path

from setuptools import setup

# Whole folders: what calls what on the hot paths should be compiled together. Left out are modules
# that talk to the outside (sockets, files) and those that others inherit from or patch in tests.
HOT = (
    "emulators/event_queue.py",
    "emulators/world.py",
    "emulators/media/*.py",
    "emulators/plant/*.py",
    "emulators/firmware/*.py",
    "emulators/canopen/*.py",
    "emulators/cia402/*.py",
    "harness/virtual_time.py",
    "traces/fields.py",
)
INTERPRETED = ("__init__.py", "eds.py", "factory.py", "settings.py")


def hot_modules() -> list[str]:
    """The files to compile, in a fixed order."""
    return [
        str(path)
        for pattern in HOT
        for path in sorted(Path().glob(pattern))
        if path.name not in INTERPRETED
    ]


def extensions() -> list[object]:
    """The extension modules, or none."""
    if os.environ.get("MOTORHIL_COMPILE") != "1":
        return []
    from mypyc.build import mypycify

    # One rounding per operation, on every machine: or the digest would depend on the processor.
    os.environ["CFLAGS"] = os.environ.get("CFLAGS", "") + " -ffp-contract=off"
    return list(mypycify(["--config-file=", *hot_modules()], opt_level="2", debug_level="0"))


setup(ext_modules=extensions())
