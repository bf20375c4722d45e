"""Compiled build: with MOTORHIL_COMPILE=1 the hot cores become C extensions (mypyc).

Everything else about the distribution is in pyproject.toml. Build with `make compiled`, into a
separate environment, from a copy of the sources: Python would silently ignore an edited .py beside
its .so.
"""

import os
import runpy
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py
from setuptools.modified import newer_group

# The modules on a frame's way from plant to record and application, as profiles of the demo, csp,
# SDO, the host's servo and the conformance kit name them (tests/benchmarks/shares.py). Modules that
# call one another often are compiled together. A new module of these folders is compiled as well.
COMPILED = (
    "emulators/simulation/*.py",
    "emulators/media/*.py",
    "emulators/can/*.py",
    "emulators/can/*/*.py",
    "emulators/plant/*.py",
    "emulators/firmware/*.py",
    "emulators/canopen/*.py",
    "emulators/canopen/files/*.py",
    "emulators/cia401/*.py",
    "emulators/cia402/*.py",
    "emulators/cia402/*/*.py",
    "emulators/gateways/loop.py",
    "emulators/gateways/modbus_tcp.py",
    "emulators/leadshine_pr/drive.py",
    "emulators/modbus/*.py",
    "emulators/oriental_az/drive.py",
    "harness/virtual_time/runtime.py",
    "harness/shared_time/participant.py",
    "harness/shared_time/records.py",
    "harness/shared_time/remote_runtime.py",
    "harness/python_can/receive_queue.py",
    "harness/recording/recorder.py",
    "harness/rig/recording.py",
    "traces/schema.py",
    "traces/can_frame.py",
    "traces/mcap/chunk.py",
    "traces/protobuf.py",
    "motorapi/runtime/api.py",
    "motorapi/adaptations/canopen/emcy.py",
    "motorapi/runtime/can_link.py",
    "motorapi/adaptations/canopen/node.py",
    "motorapi/adaptations/cia402/csp.py",
    "motorapi/adaptations/cia402/measurements.py",
    "motorapi/adaptations/cia402/motion_status.py",
    "motorapi/adaptations/cia402/node.py",
    "motorapi/adaptations/cia402/objects.py",
    "motorapi/adaptations/cia402/units.py",
    "motorapi/adaptations/host_servo/axis.py",
    "motorapi/adaptations/host_servo/cycle.py",
    "motorapi/adaptations/host_servo/demand.py",
    "motorapi/adaptations/host_servo/servo.py",
)
# Modules of these folders that stay interpreted: compiling them costs more than they spend.
READ_AT_START = (  # once, when a rig opens
    "emulators/cia401/settings.py",
    "emulators/cia402/settings.py",
    "emulators/canopen/files/eds.py",
    "emulators/canopen/files/parameter_storage.py",
    "emulators/firmware/servo_tables.py",
    "emulators/modbus/settings.py",
    "emulators/plant/presets.py",
)
RARE = (  # messages that a run may not have at all
    "emulators/canopen/lss.py",
    "emulators/simulation/ownership_notice.py",
)


def hot_modules() -> list[str]:
    """Return the files to compile, in a fixed order."""
    root = Path("motorhil")
    interpreted = {root / name for name in READ_AT_START + RARE}
    return [
        str(path)
        for pattern in COMPILED
        for path in sorted(root.glob(pattern))
        if path.name != "__init__.py" and path not in interpreted
    ]


def extensions() -> list[Extension]:
    """Return the extension modules, or none."""
    if os.environ.get("MOTORHIL_COMPILE") != "1" or "dist_info" in sys.argv or "sdist" in sys.argv:
        return []  # name and sources of the distribution do not depend on a compiler
    from mypyc.build import mypycify

    # One rounding per operation on every machine; otherwise the digest would depend on the
    # processor. Modules call one another within one library, so hidden symbols avoid the
    # indirection that exported symbols need.
    flags = " -ffp-contract=off -fvisibility=hidden"
    os.environ["CFLAGS"] = os.environ.get("CFLAGS", "") + flags
    level = os.environ.get("MOTORHIL_OPTIMISE", "2")
    words = ["--config-file=", *hot_modules()]
    return list(mypycify(words, opt_level=level, debug_level="0", multi_file=True))


class EveryCore(build_ext):
    """A build command that compiles C files in parallel, one per core, and then links them."""

    def build_extensions(self) -> None:
        """Build the libraries and report progress."""
        stale = [ext for ext in self.extensions if self._stale(ext)]
        works = [(ext, source) for ext in stale for source in ext.sources]
        works.sort(key=lambda work: -Path(work[1]).stat().st_size)  # longest compilation first
        objects: dict[str, list[str]] = {}
        cores = self.parallel = len(os.sched_getaffinity(0))  # for linking as well
        if works:
            self._precompile_header(works[0][0])
        with ThreadPoolExecutor(cores) as pool:
            for source, made in pool.map(self._compiled, works):
                objects[source] = made
                if len(objects) % 25 == 0 or len(objects) == len(works):
                    print(f"{len(objects)} of {len(works)} C files compiled", flush=True)
        for ext in stale:
            ext.extra_objects = [made for source in ext.sources for made in objects[source]]
            ext.depends, ext.sources = ext.sources, []  # compiled already
        super().build_extensions()
        self._build_preloaded()

    def _build_preloaded(self) -> None:
        """Build the library that gives binaries the rig's time, with no module of the package."""
        binaries = runpy.run_path("motorhil/harness/shared_time/binaries.py")
        place = "motorhil/harness/shared_time/preload"
        binaries["build"](Path(self.build_lib) / place / binaries["LIBRARY"])

    def _stale(self, ext: Extension) -> bool:
        return newer_group(ext.sources + ext.depends, self.get_ext_fullpath(ext.name), "newer")

    def _precompile_header(self, ext: Extension) -> None:
        """Let GCC read what every C file includes once; it takes the result in its place."""
        (header,) = Path("build").glob("__native_internal_*.h")
        self._included = ["-include", str(header)]
        flags = [f"-I{folder}" for folder in self.compiler.include_dirs + ext.include_dirs]
        command = [*self.compiler.compiler_so, *flags, *ext.extra_compile_args]
        self.spawn([*command, "-x", "c-header", "-c", str(header), "-o", f"{header}.gch"])

    def _compiled(self, work: tuple[Extension, str]) -> tuple[str, list[str]]:
        ext, source = work
        return source, self.compiler.compile(
            [source],
            output_dir=self.build_temp,
            include_dirs=ext.include_dirs,
            extra_postargs=[*ext.extra_compile_args, *self._included],
            depends=ext.depends,
        )


class WithDigest(build_py):
    """A build command that adds the digest of the sources to a wheel."""

    def run(self) -> None:
        """Copy the modules; in an editable installation they change, and are read when asked."""
        super().run()
        if not self.editable_mode:
            source = runpy.run_path("motorhil/harness/source.py")
            place = Path(self.build_lib) / "motorhil" / source["FILE"]
            place.write_text(source["digest_of"](Path("motorhil")) + "\n", "ascii")


if __name__ == "__main__":  # not if tests read the lists above
    setup(ext_modules=extensions(), cmdclass={"build_ext": EveryCore, "build_py": WithDigest})
