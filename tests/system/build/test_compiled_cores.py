"""Compiled cores equal pure cores, in wheels too (issues 2, 9).

Issue 2, item 10; issue 9, item 5. `make compiled` builds them into .venv-compiled, unless a build
of these sources exists.
"""

import os
import re
import subprocess
import sys
import sysconfig
import venv

import pytest

from motorhil.harness.version import source_digest
from tests.support.building import LEVEL, clone, demo, digest_in, make, nobody_else_builds
from tests.support.checkout import CHECKOUT

pytestmark = [pytest.mark.compiled, pytest.mark.timeout(1800)]

PLATFORM = sysconfig.get_platform().replace("-", "_").replace(".", "_")
INTERPRETER = f"cp{sys.version_info.major}{sys.version_info.minor}"
TAGS = {"pure": "py3-none-any", "compiled": f"{INTERPRETER}-{INTERPRETER}-{PLATFORM}"}
CORES = {"pure": "pure Python cores", "compiled": "compiled cores"}
COMPILED = CHECKOUT / ".venv-compiled" / "bin"


@pytest.fixture(scope="module")
def built():
    """Build these sources, and prevent other builds meanwhile."""
    with nobody_else_builds():
        status, printed = make("compiled", LEVEL)
        assert status == 0, printed[-6000:]
        yield


def run(program, folder, hash_seed, *words):
    folder.mkdir()
    return subprocess.run(
        [program, *words],
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout


def test_version_names_compiled_cores_and_their_source(built, tmp_path):
    said = run(COMPILED / "motorhil", tmp_path / "here", 0, "--version")
    assert "compiled cores" in said
    assert f"source {source_digest()} in {CHECKOUT / '.venv-compiled'}" in said


def test_hot_modules_are_compiled_outside_the_sources(built, tmp_path):
    names = [
        f"motorhil.{name}"
        for name in (
            *("emulators.simulation.event_queue", "emulators.simulation.world"),
            *("emulators.can.bus.bus", "emulators.firmware.servo", "emulators.plant.dc_motor"),
            *("emulators.canopen.node", "emulators.cia402.drive"),
            *("harness.virtual_time.runtime", "traces.protobuf"),
        )
    ]
    code = f"from importlib import import_module\nfor n in {names}:\n"
    code += "    print(import_module(n).__file__)"
    files = run(COMPILED / "python", tmp_path / "here", 0, "-c", code).split()
    assert len(files) == len(names)
    assert [file for file in files if not file.endswith(".so")] == []
    assert [
        path for name in ("emulators", "harness") for path in CHECKOUT.glob(f"{name}/**/*.so")
    ] == []


def test_demo_runs_compiled_cores_unless_pure_is_requested(built, tmp_path):
    folder = clone(tmp_path, "motorhil")
    (folder / ".venv-compiled").symlink_to(CHECKOUT / ".venv-compiled")
    compiled, pure = demo(folder, LEVEL), demo(folder, LEVEL, "PURE=1")
    assert "seconds per second, compiled cores" in compiled
    assert "seconds per second, pure Python cores" in pure
    assert digest_in(compiled) == digest_in(pure)


# --- wheels


@pytest.fixture(scope="module")
def dist(built, tmp_path_factory):
    """Return the folder of the wheels."""
    folder = tmp_path_factory.mktemp("dist")
    status, printed = make("wheel", LEVEL, f"DIST={folder}")
    assert status == 0, printed[-6000:]
    return folder


@pytest.fixture(scope="module")
def installed(dist, tmp_path_factory):
    """Return a fresh environment for each wheel, with the dependencies of this one."""
    places = {}
    for kind, tag in TAGS.items():
        place = places[kind] = tmp_path_factory.mktemp(kind)
        venv.create(place, symlinks=True)
        site = place / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
        (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
        (wheel,) = dist.glob(f"motorhil-*-{tag}.whl")
        words = ["install", "--quiet", "--no-deps", "--no-index", "--ignore-installed", wheel]
        subprocess.run([place / "bin" / "python", "-m", "pip", *words], check=True)
    return places


def said_by(place, *words):
    return subprocess.run(
        [place / "bin" / "motorhil", *words],
        cwd=place,
        capture_output=True,
        text=True,
        check=True,
    ).stdout


def test_dist_has_the_sources_and_a_wheel_of_each_kind(dist):
    names = sorted(re.sub(r"motorhil-[\d.]+\d", "", path.name) for path in dist.iterdir())
    assert names == sorted([".tar.gz", *(f"-{tag}.whl" for tag in TAGS.values())])


@pytest.mark.parametrize("kind", TAGS)
def test_wheel_names_its_cores_and_needs_no_checkout(installed, kind):
    said = said_by(installed[kind], "--version")
    assert CORES[kind] in said
    assert f"source {source_digest()} in {installed[kind]}" in said
    assert list(installed[kind].glob("lib/**/event_queue*.so")) == (
        [] if kind == "pure" else [installed_core(installed[kind])]
    )


def installed_core(place):
    (site,) = place.glob("lib/python3*/site-packages")
    folder = site / "motorhil" / "emulators" / "simulation"
    return folder / f"event_queue{sysconfig.get_config_var('EXT_SUFFIX')}"


def test_every_wheel_runs_the_same_demo(installed):
    said = {kind: said_by(installed[kind], "demo") for kind in TAGS}
    assert {kind: CORES[kind] in said[kind] for kind in TAGS} == {"pure": True, "compiled": True}
    assert digest_in(said["pure"]) == digest_in(said["compiled"])
