"""A third-party package with motorhil's wheel, in its own environment.

The checkout is not on the path there. Everything that the package uses must be in the wheel, and be
found by entry points. The dependencies are those of this environment. The wheel is that of the
cores of this process.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import can
import pytest

from motorhil.compiled import is_current
from motorhil.harness.conformance.kit import all_clauses
from motorhil.harness.version import cores_are_compiled
from tests.support.checkout import CHECKOUT
from tests.support.outsider_source import OUTSIDER

OTHERS = ("pyproject.toml", "setup.py", "README.md", "LICENSE")
CLAUSES = list(all_clauses())
SLICES = [3, pytest.param(1, marks=pytest.mark.nightly)]
"""How many clauses there are for each one that is tried."""
OFFLINE = ("--quiet", "--disable-pip-version-check", "--no-index", "--no-deps")


def run(*command, **more):
    """Run a command that must succeed, and return its output."""
    kept = {
        k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "MOTORHIL_", "CAN_"))
    }
    done = subprocess.run(
        [str(word) for word in command],
        env=kept,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=240,
        check=False,
        **more,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def sources_in(folder):
    """Copy what a wheel is built from into this new folder, and return it."""
    shutil.copytree(CHECKOUT / "motorhil", folder / "motorhil", ignore=IGNORED)
    for name in OTHERS:
        shutil.copy(CHECKOUT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def venv(tmp_path_factory):
    """An environment with both wheels and the dependencies installed here."""
    folder = tmp_path_factory.mktemp("outsider")
    shutil.copytree(OUTSIDER, folder / "outsider", ignore=IGNORED)
    wanted = [folder / "outsider"]
    if cores_are_compiled() and is_current(CHECKOUT):
        wanted.extend((CHECKOUT / "build" / "compiled" / "wheel").glob("*.whl"))
    else:
        wanted.append(sources_in(folder / "motorhil"))
    pip = (sys.executable, "-m", "pip")
    run(
        *(*pip, "wheel", *OFFLINE, "--no-build-isolation", "--wheel-dir", folder / "wheels"),
        *wanted,
    )
    wheels = sorted((folder / "wheels").glob("*.whl"))
    assert [wheel.name.split("-")[0] for wheel in wheels] == ["motorhil", "motorhil_odrive"]
    run(sys.executable, "-m", "venv", "--without-pip", folder / "venv")
    python = folder / "venv" / "bin" / "python"
    run(*pip, "--python", python, "install", *OFFLINE, *wheels)
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    places = sorted({Path(module.__file__).parents[1] for module in (can, pytest)})
    (site / "dependencies.pth").write_text("".join(f"{place}\n" for place in places))
    return folder / "venv" / "bin"


IGNORED = shutil.ignore_patterns("__pycache__", "*.egg-info", "build", "*.so")


def test_environment_has_only_the_wheels(venv):
    code = (
        "import motorhil, motorhil_odrive, sys; print(motorhil.__file__, motorhil_odrive.__file__)"
    )
    for path in run(venv / "python", "-c", code, cwd=venv).split():
        assert Path(path).is_relative_to(venv.parent), path


def test_plugins_are_found_by_entry_points(venv):
    for what in ("controllers", "adaptations"):
        rows = run(venv / "motorhil", "list", what, cwd=venv).splitlines()
        assert any(row.split()[0] == "odrive" and "motorhil-odrive 0.1.0" in row for row in rows)


def test_installed_decoder_tells_the_frames_of_a_rig(venv, tmp_path):
    code = (
        "from pathlib import Path; import motorhil_odrive\n"
        "from motorhil.harness.rig.rig import Rig\n"
        "path = Path(motorhil_odrive.__file__).parent / 'rig.toml'\n"
        "with Rig.open(path, record='a.mcap') as rig:\n"
        "    rig.runtime.wait_until(lambda: False, 0.6)\n"
    )
    run(venv / "python", "-c", code, cwd=tmp_path)
    printed = run(venv / "motorhil", "show", "a.mcap", "--id", "29", cwd=tmp_path)  # 1 << 5 | 9
    assert printed.splitlines()[-1].endswith(
        "can0      Get_Encoder_Estimates: Pos_Estimate = 0 rev, Vel_Estimate = 0 rev/s"
    )


def test_outsider_tests_pass(venv):
    folder = venv.parents[1] / "outsider"
    printed = run(venv / "python", "-m", "pytest", "-p", "no:cacheprovider", cwd=folder)
    assert " passed" in printed
    assert " skipped" not in printed


def conform(venv, folder, adaptation, names):
    """Return how many of these clauses this adaptation passes; it must fail none."""
    asked = [word for name in names for word in ("--clause", name)]
    printed = run(venv / "motorhil", "conform", "--adaptation", adaptation, *asked, cwd=folder)
    told = re.search(rf"^{len(names)} clauses: (\d+) passed, \d+ not applicable;", printed, re.M)
    assert told, printed
    return int(told[1])


@pytest.mark.parametrize("each", SLICES)
def test_outsider_conforms(venv, tmp_path, each):
    passed = conform(venv, tmp_path, "odrive", CLAUSES[1::each])
    assert passed >= 155 // each  # of a package that claims no less than it does


@pytest.mark.parametrize("each", SLICES)
def test_new_drive_passes_its_tests_and_the_kit_at_once(venv, tmp_path, each):
    """`motorhil new --drive` and its package need nothing but the wheel."""
    name = f"acme_{each}"
    printed = run(venv / "motorhil", "new", "--drive", name, cwd=tmp_path).splitlines()
    package = tmp_path / f"motorhil-{name}"
    assert f"motorhil-{name}/src/motorhil_{name}/host.py" in printed
    assert not any("ydrive" in one.read_text() for one in package.rglob("*") if one.is_file())
    pip = (sys.executable, "-m", "pip", "--python", venv / "python", "install", *OFFLINE)
    run(*pip, "--no-build-isolation", package)
    assert " passed" in run(venv / "python", "-m", "pytest", "-p", "no:cacheprovider", cwd=package)
    assert conform(venv, tmp_path, name, CLAUSES[2::each]) >= 100 // each
