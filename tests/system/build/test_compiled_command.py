"""The choice of cores by the command `motorhil` of a clone, with a build that only says so."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from motorhil.compiled import proof
from tests.support.checkout import CHECKOUT

pytestmark = pytest.mark.pure("a matter of the sources")

PURE = "pure Python cores, source"


class Clone:
    """A folder like a clone, with the command in its environment."""

    def __init__(self, folder):
        self.folder = folder
        self.build = folder / ".venv-compiled"
        package = folder / "motorhil"
        package.mkdir()
        for path in (CHECKOUT / "motorhil").iterdir():
            if path.is_symlink():
                (package / path.name).symlink_to(path.resolve())
            elif path.is_file():
                (package / path.name).write_bytes(path.read_bytes())
        for name in ("setup.py", "pyproject.toml", "requirements.lock"):
            (folder / name).touch()
        self.command = folder / "bin" / "motorhil"
        self._write(
            self.command,
            f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(folder)!r})\n"
            "from motorhil.__main__ import start\nsys.exit(start())\n",
        )

    @staticmethod
    def _write(path, text):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)

    def compile(self):
        self._write(self.build / "bin" / "python", '#!/bin/sh\necho compiled "$@"\n')
        (self.build / ".proof").write_text(proof(self.folder) + "\n")

    def run(self, *words, command=None, **environment):
        kept = {name: value for name, value in os.environ.items() if name != "MOTORHIL_PURE"}
        done = subprocess.run(
            [*(command or [self.command]), *words],
            cwd=self.folder,
            env=kept | environment,
            capture_output=True,
            text=True,
            check=True,
            timeout=60.0,
        )
        return done.stdout.strip(), done.stderr.strip()


@pytest.fixture
def clone(tmp_path):
    return Clone(tmp_path)


def test_command_without_a_build_is_pure_and_silent(clone):
    printed, said = clone.run("--version")
    assert PURE in printed
    assert said == ""


def test_command_takes_the_build_of_these_sources(clone):
    clone.compile()
    assert clone.run("--version") == (f"compiled {clone.command} --version", "")
    assert clone.run("demo", "a b") == (f"compiled {clone.command} demo a b", "")


def test_command_with_a_stale_build_is_pure_and_says_so_once(clone):
    clone.compile()
    (clone.folder / "motorhil" / "new.py").touch()
    printed, said = clone.run("--version")
    assert PURE in printed
    assert said.splitlines() == [
        "motorhil: pure Python cores; the sources have changed since `make compiled`; run it again,"
        " or set MOTORHIL_PURE=1"
    ]
    clone.compile()
    assert clone.run("--version")[0].startswith("compiled ")


@pytest.mark.parametrize("damage", ["proof", "python"])
def test_command_with_half_a_build_is_pure(clone, damage):
    clone.compile()
    (clone.build / {"proof": ".proof", "python": "bin/python"}[damage]).unlink()
    printed, said = clone.run("--version")
    assert PURE in printed
    assert "make compiled" in said


def test_command_on_the_python_of_the_build_starts_no_other(clone):
    clone.compile()
    python = clone.build / "bin" / "python"
    python.unlink()
    python.symlink_to(Path(sys.executable).resolve())
    (clone.build / "pyvenv.cfg").write_text(f"home = {sys.base_prefix}/bin\n")
    printed, _ = clone.run("--version", PYTHONPATH=os.pathsep.join(sys.path))  # once, not forever
    assert PURE in printed


def test_pure_cores_can_be_selected(clone):
    clone.compile()
    printed, said = clone.run("--version", MOTORHIL_PURE="1")
    assert PURE in printed
    assert said == ""
    printed, said = clone.run("--version", command=[sys.executable, "-m", "motorhil"])
    assert PURE in printed
    assert said == ""


def change_size(path):
    path.write_text("x = 1\n")


def change_time(path):
    os.utime(path, (1, 1))


def change_name(path):
    path.rename(path.with_name("other.py"))


@pytest.mark.parametrize("change", [change_size, change_time, change_name, Path.unlink])
@pytest.mark.parametrize("name", ["new.py", "table.json"])
def test_any_changed_file_changes_the_proof(clone, change, name):
    path = clone.folder / "motorhil" / name
    path.touch()
    before = proof(clone.folder)
    (path.parent / "__pycache__").mkdir(exist_ok=True)
    (path.parent / "__pycache__" / "new.pyc").touch()
    assert proof(clone.folder) == before
    change(path)
    assert proof(clone.folder) != before
