"""Contents of the wheel that users install."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from motorhil.harness.version import source_digest

CHECKOUT = Path(os.environ.get("MOTORHIL_CHECKOUT", Path(__file__).parents[3]))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    ignored = shutil.ignore_patterns("__pycache__", "*.so")
    shutil.copytree(CHECKOUT / "motorhil", folder / "motorhil", ignore=ignored)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(CHECKOUT / name, folder)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--disable-pip-version-check", "-w", str(folder), "."]
    subprocess.run(command, cwd=folder, check=True, timeout=200)
    return next(folder.glob("*.whl"))


def test_wheel_contains_every_data_file(wheel):
    wanted = {
        path.relative_to(CHECKOUT).as_posix()
        for package in (CHECKOUT / "motorhil").iterdir()
        for path in package.rglob("*")
        if path.suffix in (".toml", ".json", ".eds", ".binpb", ".html", ".css", ".js", ".c", ".h")
        or path.name == "py.typed"
    }
    assert "motorhil/harness/report/template/page.html" in wanted
    with zipfile.ZipFile(wheel) as archive:
        assert wanted <= set(archive.namelist())


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Return a function that runs a command line from the wheel alone, without the checkout."""
    site = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    start = f"import sys; sys.path.insert(0, {str(site)!r}); "
    start += "from motorhil.harness.cli.main import main; "
    start += f"from motorhil import harness; assert harness.__file__.startswith({str(site)!r}); "

    def run(*words):
        command = [sys.executable, "-P", "-c", start + f"sys.exit(main({list(words)!r}))"]
        return subprocess.run(command, cwd=site, capture_output=True, text=True, timeout=120)

    return run


def test_new_rig_is_made_and_runs_from_the_wheel_alone(installed, tmp_path):
    bench = tmp_path / "bench"
    for words in (["new", bench], ["run", bench / "rig.toml", bench / "drive.py"]):
        done = installed(*map(str, words))
        assert (done.returncode, done.stderr.count("Traceback")) == (0, 0), done.stderr
    assert "right is at 3.1416 rad" in done.stdout


def test_report_works_from_the_wheel_alone(installed, tmp_path):
    bench = tmp_path / "bench"
    installed("new", str(bench))
    recording = str(tmp_path / "run.mcap")
    installed("run", str(bench / "rig.toml"), str(bench / "drive.py"), "-o", recording)
    done = installed("report", recording)
    assert (done.returncode, done.stderr) == (0, "")
    assert '"name":"left"' in (tmp_path / "run.html").read_text("utf-8")


def test_source_digest_does_not_depend_on_the_place(installed):
    assert f"source {source_digest()} in " in installed("--version").stdout


def test_first_push_finds_all_that_its_job_needs(wheel, tmp_path, monkeypatch):
    """The job's steps, in a folder that only `motorhil new` and the printed command have filled."""
    monkeypatch.chdir(tmp_path)
    start = "from motorhil.harness.cli.main import main; import sys; sys.exit(main(sys.argv[1:]))"
    new = [sys.executable, "-c", start, "new", "wheels", "--ci", "gitlab"]
    done = subprocess.run(new, capture_output=True, text=True, check=True, timeout=60)
    told = "commit what this makes: python -m pip wheel --no-deps --wheel-dir vendor "
    assert told in done.stderr
    Path("vendor").mkdir()
    shutil.copy(wheel, "vendor")
    own, *others = Path("requirements.txt").read_text().splitlines()
    assert others == ["pytest>=8"]
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps"]
    install += ["--disable-pip-version-check", "--target", "site", own]
    subprocess.run(install, check=True, timeout=120)
    job = Path(".gitlab-ci.yml").read_text()
    commands = re.findall(r"^    - (pytest .*|bash .*)$", job, re.MULTILINE)
    assert len(commands) == 2
    path = f"{tmp_path}/bin:{Path(sys.executable).parent}:{os.environ['PATH']}"
    Path("bin").mkdir()
    Path("bin/motorhil").write_text(f"#!{sys.executable}\n{start}\n")
    Path("bin/motorhil").chmod(0o755)
    site = {"PATH": path, "PYTHONPATH": f"{tmp_path}/site", "HOME": str(tmp_path)}
    for command in commands:
        ran = subprocess.run(
            ["bash", "-ec", command], env=site, capture_output=True, text=True, timeout=120
        )
        assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "right is at 3.1416 rad" in ran.stdout
    assert Path("out/junit.xml").exists()
