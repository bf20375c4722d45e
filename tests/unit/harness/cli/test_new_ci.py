"""The option `new --ci`: its jobs run, and their helper chooses the bus."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from motorhil.harness.rig.config.scaffold import CI_FILES, EXAMPLES, requirement
from tests.support.checkout import CHECKOUT

HELPER = EXAMPLES / "ci" / "vcan-or-hub"
CI = (".github/workflows/motors.yml", ".ci/vcan-or-hub")
PROGRAM = """
import can
with can.Bus() as bus:
    bus.send(can.Message(arbitration_id=0, data=[0x81, 1], is_extended_id=False))
    print(next(m.arbitration_id for m in bus if m.arbitration_id > 0x700))
"""
FAILING_TEST = "def test_it(motor):\n    motor.enable()\n    raise ValueError\n"


def commands_in(job):
    """Return the commands of a job, line by line, without comments."""
    lines = re.findall(r"^ +(?:- )?(?:run: |- )((?:pytest|bash|for|python|if) .*)$", job, re.M)
    return [line.partition(" # ")[0] for line in lines]


def programs(folder, **texts):
    """Return a folder with these programs and those that the helper needs."""
    folder.mkdir(exist_ok=True)
    for name in ("bash", "cat", "env", "grep", "id", "mktemp", "rm", "tail", "uname", "timeout"):
        if name not in texts:
            (folder / name).symlink_to(shutil.which(name))
    for name, text in texts.items():
        (folder / name.replace("_", "-")).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name.replace("_", "-")).chmod(0o755)
    return folder


# --- written jobs


def test_job_is_written_for_new_or_existing_rig(bench, say):
    status, out, _ = say("new", "my wheels", "--ci", "github")
    assert status == 0
    assert out.splitlines()[-4:] == [*CI, "my wheels/test_motors.py", "requirements.txt"]
    job = Path(CI[0]).read_text()
    assert "pytest --rig='my wheels/rig.toml' --junitxml=" in job
    assert "bash .ci/vcan-or-hub 'my wheels/rig.toml' --on vcan0 -o" in job
    assert "-- python 'my wheels/drive.py'" in job
    assert Path(CI[1]).read_bytes() == HELPER.read_bytes()

    Path("my wheels/rig.toml").write_text("mine")
    assert say("new", "my wheels", "--ci", "gitlab") == (
        *(2, ""),
        f".ci/vcan-or-hub: already exists; take what you need from {HELPER.parent}\n",
    )
    Path(CI[1]).unlink()
    assert say("new", "my wheels", "--ci", "gitlab")[:2] == (0, f"{CI_FILES['gitlab']}\n{CI[1]}\n")
    assert Path("my wheels/rig.toml").read_text() == "mine"


@pytest.mark.parametrize("kind", CI_FILES)
def test_job_names_only_files_that_exist(bench, say, kind):
    Path("own").mkdir()
    Path("own/rig.toml").write_text("mine")
    Path("requirements.txt").write_text("pytest\n")
    status, out, err = say("new", "own", "--ci", kind)
    assert (status, out.splitlines()) == (0, [CI_FILES[kind], "own/test_motors.py"])
    assert err.startswith("requirements.txt: was there; it must install ")
    job = Path(CI_FILES[kind]).read_text()
    for name in ("drive.py", "vcan-or-hub", "wheels/"):
        assert name not in job
    assert "pytest --rig=own/rig.toml" in job
    assert "--rig=own/rig.toml" in Path("own/test_motors.py").read_text()


ORIGINS = {
    "an index": (None, "motorhil==0.1.0"),
    "a repository": (
        {"url": "https://h/m.git", "vcs_info": {"vcs": "git", "commit_id": "0a1b"}},
        "motorhil @ git+https://h/m.git@0a1b",
    ),
    "a file elsewhere": (
        {"url": "https://h/m.whl", "archive_info": {}},
        "motorhil @ https://h/m.whl",
    ),
    "a folder here": (
        {"url": "file:///a%20b/m", "dir_info": {"editable": True}},
        "./vendor/motorhil-0.1.0-py3-none-any.whl",
    ),
}


@pytest.mark.parametrize(("origin", "line"), ORIGINS.values(), ids=ORIGINS)
def test_requirement_is_where_motorhil_came_from(monkeypatch, origin, line):
    text = None if origin is None else json.dumps(origin)
    here = SimpleNamespace(version="0.1.0", read_text=lambda name: text)
    monkeypatch.setattr("importlib.metadata.distribution", lambda name: here)
    found, command = requirement()
    assert found == line
    built = "python -m pip wheel --no-deps --wheel-dir vendor '/a b/m'"
    assert command == (built if line.startswith("./") else "")


def test_job_that_cannot_be_written_leaves_no_files(bench, say):
    assert say("new", "../elsewhere", "--ci", "github")[2] == (
        "../elsewhere: is not in the current folder, where the CI job is written; "
        "change to its parent folder first\n"
    )
    Path(".github").write_text("")
    status, _, err = say("new", "wheels", "--ci", "github")
    assert (status, err.count("\n")) == (2, 1)
    assert [path.name for path in bench.iterdir()] == [".github"]


def test_both_jobs_run_the_same_commands():
    github, gitlab = ((EXAMPLES / "ci" / f"{kind}.yml").read_text() for kind in CI_FILES)
    loop = 'for record in out/*.mcap; do motorhil report "$record"; done'
    assert len(commands_in(github)) == 4
    assert commands_in(github)[:3] == commands_in(gitlab)[:3]
    assert commands_in(github)[3] == loop
    assert commands_in(gitlab)[3:] == [f'if [ "$CI_JOB_STATUS" = failed ]; then {loop}; fi']


@pytest.mark.pure("pytest is a program of the sources' environment")
@pytest.mark.wall
def test_job_runs(bench, say, tmp_path):
    say("new", "wheels", "--ci", "github")
    Path("wheels/test_motors.py").write_text(FAILING_TEST)
    Path("wheels/drive.py").write_text(PROGRAM)
    refused = dict.fromkeys(("ip", "modprobe", "apt_get", "sudo"), "exit 1")
    none = programs(tmp_path / "none", **refused)
    path = f"{none}:{Path(sys.executable).parent}:/usr/bin:/bin"
    summary = bench / "summary"
    environment = {"PATH": path, "GITHUB_STEP_SUMMARY": str(summary), "HOME": str(tmp_path)}
    environment["MOTORHIL_PURE"] = "1"  # whatever was compiled in this clone

    def run(command):
        return subprocess.run(
            ["bash", "-ec", command], env=environment, capture_output=True, text=True, check=False
        )

    _, test, program, pages = commands_in(Path(CI[0]).read_text())
    assert run(test).returncode == 1
    done = run(program)
    assert (done.returncode, done.stdout) == (0, f"{0x701}\n")
    assert summary.read_text() == done.stderr
    assert done.stderr.startswith("No virtual CAN on this machine (")
    assert run(pages).returncode == 0
    kinds = sorted(path.suffix for path in Path("out").iterdir())
    assert kinds == [".html", ".html", ".mcap", ".mcap", ".xml"]


# --- the helper

SERVE = 'echo "motorhil $*"; exit 7'
OPTIONS = (
    "rig.toml",
    "--on",
    "can0=none0",
    "--seed",
    "3",
    "--on=none1",
    "--",
    "a",
    "b c",
    "--on",
    "x",
)
ON_HUB = "motorhil serve rig.toml --seed 3 -- a b c --on x\n"
ON_VCAN = "motorhil serve rig.toml --seed 3 --on can0=none0 --on=none1 -- a b c --on x\n"


def helped(folder, *options, **texts):
    environment = {
        "PATH": str(programs(folder, motorhil=SERVE, **texts)),
        "DID": str(folder / "did"),
    }
    return subprocess.run(
        ["/bin/bash", str(HELPER), *options],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


DO = 'echo "{0} $*" >> "$DID"; '


@pytest.mark.parametrize("needs", ["nothing", "modprobe", "apt-get"])
def test_interfaces_are_created_with_least_privilege(tmp_path, needs):
    done = helped(
        tmp_path,
        *OPTIONS,
        ip=DO.format("ip") + f'[ {needs} = nothing ] || grep -q "^modprobe-done" "$DID"',
        modprobe=DO.format("modprobe")
        + f'{{ [ {needs} = modprobe ] || grep -q "^apt-get install" "$DID"; }} &&'
        + 'echo modprobe-done >> "$DID"',
        apt_get=DO.format("apt-get"),
        sudo=DO.format("sudo") + 'shift; exec "$@"',
    )
    assert (done.returncode, done.stdout) == (7, ON_VCAN)
    assert done.stderr.startswith("Virtual CAN: none0 none1 of this machine's kernel, ")
    did = [line for line in (tmp_path / "did").read_text().splitlines() if line[:4] != "sudo"]
    assert did[-4:] == [
        line
        for n in (0, 1)
        for line in (f"ip link add dev none{n} type vcan", f"ip link set up dev none{n}")
    ]
    assert any(line.startswith("modprobe ") for line in did) is (needs != "nothing")
    assert any(line.startswith("apt-get ") for line in did) is (needs == "apt-get")


def test_helper_falls_back_to_hub_with_reason(tmp_path):
    refuse = "echo {0} is refused >&2; exit 1"
    names = ("ip", "modprobe", "sudo")
    texts = {name: refuse.format(name) for name in names}
    done = helped(tmp_path, *OPTIONS, apt_get="echo no such package; exit 100", **texts)
    assert (done.returncode, done.stdout) == (7, ON_HUB)
    assert re.fullmatch(
        r"No virtual CAN on this machine \((no such package|sudo is refused)\): "
        r"run on the hub of motorhil instead\.\n",
        done.stderr,
    )


@pytest.mark.parametrize("options", [(), ("rig.toml", "--", "a"), ("rig.toml", "--on")])
def test_wrong_usage_of_helper_is_reported(tmp_path, options):
    done = helped(tmp_path, *options)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--on" in done.stderr


# --- jobs of this project


@pytest.mark.parametrize("job", [".github/workflows/ci.yml", ".gitlab-ci.yml"])
def test_own_jobs_run_existing_targets(job):
    text = (CHECKOUT / job).read_text()
    scripts = re.findall(r"\.ci/[\w-]+", text)
    assert set(scripts) == {".ci/run", ".ci/on-bus", ".ci/oldest"}
    for script in scripts:
        assert (CHECKOUT / script).stat().st_mode & 0o111, script
    helper = "harness/examples/ci/vcan-or-hub"
    assert helper in (CHECKOUT / ".ci/on-bus").read_text()
    assert (CHECKOUT / helper).read_bytes() == HELPER.read_bytes()


def test_own_jobs_run_every_supported_python():
    about = (CHECKOUT / "pyproject.toml").read_text()
    supported = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', about)
    assert supported[0] == re.search(r'requires-python = ">=(.*)"', about)[1]
    wheels = re.search(r"^build = (\[.*\])$", about, re.MULTILINE)[1]
    assert re.findall(r"cp3(\d+)-", wheels) == [one.split(".")[1] for one in supported]
    for job, key in ((".github/workflows/ci.yml", "python"), (".gitlab-ci.yml", "PYTHON_VERSION")):
        matrix = re.search(rf"{key}: (\[.*\])$", (CHECKOUT / job).read_text(), re.MULTILINE)[1]
        assert re.findall(r'"(.*?)"', matrix) == supported
    page = (CHECKOUT / "docs/reference/supported.md").read_text()
    assert f"| Python | {supported[0]} to {supported[-1]} |" in page


def test_oldest_dependency_is_tested_and_the_newest_locked():
    about = (CHECKOUT / "pyproject.toml").read_text()
    oldest, end = re.search(r'"pymodbus>=([\d.]+),<([\d.]+)"', about).groups()
    locked = re.search(r"^pymodbus==([\d.]+)", (CHECKOUT / "requirements.lock").read_text(), re.M)[
        1
    ]
    numbers = [tuple(map(int, one.split("."))) for one in (oldest, locked, end)]
    assert numbers[0] < numbers[1] < numbers[2] == (numbers[1][0], numbers[1][1] + 1)
    assert "pymodbus>=" in (CHECKOUT / ".ci/oldest").read_text()
