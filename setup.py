"""Only for the compiled build: with MOTORHIL_COMPILE=1 the hot cores become C extensions (mypyc).

Everything else about the distribution stands in pyproject.toml. Build it with `make compiled`, into
an environment of its own, from a copy of the sources: an edited .py beside its .so would be ignored
without a word.
"""

import os
import sys
from pathlib import Path

from setuptools import setup

# All that a frame passes on its way, from plant to record and application: what calls what there
# should be compiled together. Left out are modules that talk to the outside (sockets,
# files), that applications or third parties inherit from, or that inherit from others' libraries.
HOT = (
    "emulators/event_queue.py",
    "emulators/can_segment.py",
    "emulators/line_segment.py",
    "emulators/segment.py",
    "emulators/world.py",
    "emulators/media/*.py",
    "emulators/plant/*.py",
    "emulators/firmware/*.py",
    "emulators/canopen/*.py",
    "emulators/cia401/*.py",
    "emulators/cia402/*.py",
    "harness/bus_ears.py",
    "harness/parties.py",
    "harness/virtual_time.py",
    "harness/recorder.py",
    "harness/rig_recording.py",
    "traces/chunk.py",
    "traces/fields.py",
    "traces/protobuf.py",
    "motorapi/waiting.py",
    "motorapi/adaptations/canopen_link.py",
    "motorapi/adaptations/cia402_objects.py",
    "motorapi/adaptations/cia402_units.py",
    "motorapi/adaptations/drive_node.py",
    "motorapi/adaptations/drive_reader.py",
    "motorapi/adaptations/motion_watch.py",
    "motorapi/adaptations/software_axis.py",
    "motorapi/adaptations/software_courses.py",
    "motorapi/adaptations/software_cycle.py",
    "motorapi/adaptations/software_servo.py",
    "motorapi/adaptations/turn_lock.py",
)
INTERPRETED = ("__init__.py", "factory.py", "settings.py")


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
    if os.environ.get("MOTORHIL_COMPILE") != "1" or "dist_info" in sys.argv:
        return []  # what the distribution is called depends on no compiler
    from mypyc.build import mypycify

    # One rounding per operation, on every machine: or the digest would depend on the processor.
    os.environ["CFLAGS"] = os.environ.get("CFLAGS", "") + " -ffp-contract=off"
    level = os.environ.get("MOTORHIL_OPTIMISE", "2")
    return list(mypycify(["--config-file=", *hot_modules()], opt_level=level, debug_level="0"))


setup(ext_modules=extensions())
