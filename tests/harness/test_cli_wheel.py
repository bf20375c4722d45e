"""What a user installs carries everything the commands need."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
PACKAGES = ("motorapi", "emulators", "traces", "harness")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    for name in PACKAGES:
        ignored = shutil.ignore_patterns("__pycache__", "*.so")
        shutil.copytree(CHECKOUT / name, folder / name, ignore=ignored)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, folder)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "-w", str(folder), "."]
    subprocess.run(command, cwd=folder, check=True, timeout=50)
    return next(folder.glob("*.whl"))


def test_the_wheel_carries_every_file_that_is_no_program(wheel):
    wanted = {
        path.relative_to(CHECKOUT).as_posix()
        for name in PACKAGES
        for path in (CHECKOUT / name).rglob("*")
        if path.suffix in (".toml", ".json", ".eds", ".binpb") or path.name == "py.typed"
    }
    assert "harness/rig.schema.json" in wanted
    with zipfile.ZipFile(wheel) as archive:
        assert wanted <= set(archive.namelist())


def test_from_the_wheel_alone_a_new_rig_is_made_and_is_right(wheel, tmp_path):
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    for words in (["new", str(tmp_path / "bench")], ["check", str(tmp_path / "bench/rig.toml")]):
        # -P and -c: not the checkout's harness, though it is installed for development.
        code = f"import sys; sys.path.insert(0, {str(site)!r}); from harness.cli import main; "
        code += f"import harness; assert harness.__file__.startswith({str(site)!r}); "
        command = [sys.executable, "-P", "-c", code + f"sys.exit(main({words!r}))"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=30)
        assert (done.returncode, done.stderr.count("Traceback")) == (0, 0), done.stderr
