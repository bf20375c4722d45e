"""The option --world: a test runs in a disturbed world of its rig."""

import pytest

from motorhil.harness.rig.config.scaffold import write_new_rig

pytest_plugins = ["pytester"]
WORLD = '[[stimulus]]\ncontroller = "left"\nname = "fault"\nvalue = 0x2310\nat_s = 0.0\n'
HAS_FAULT = """
import pytest

def test_given(rig):
    rig.motors["left"].enable()

def test_example(open_rig):
    with open_rig() as rig:
        rig.motors["left"].enable()

@pytest.mark.rig("other/rig.toml")
def test_other(rig):
    rig.motors["left"].enable()
"""


@pytest.fixture
def project(pytester, monkeypatch):
    """Return a project with two rigs, tests of both, and a world."""
    monkeypatch.delenv("PYTEST_ADDOPTS", raising=False)
    for name in ("wheels", "other"):
        write_new_rig(pytester.path / name)
    pytester.makeini("[pytest]\naddopts = -W error -p no:cacheprovider -p no:hypothesispytest\n")
    pytester.makepyfile(HAS_FAULT)
    (pytester.path / "world.toml").write_text(WORLD)
    return pytester


def test_without_a_world_all_pass(project):
    project.runpytest_inprocess("--rig=wheels/rig.toml").assert_outcomes(passed=3)


def test_world_disturbs_the_rig_of_the_command_line(project):
    result = project.runpytest_inprocess("--rig", "wheels/rig.toml", "--world", "world.toml")
    result.assert_outcomes(passed=1, failed=2)
    result.stdout.fnmatch_lines_random(
        ["again:  pytest --rig=wheels/rig.toml --world=world.toml --seed=1 *::test_given"]
    )


def test_world_disturbs_each_rig_without_a_command_line(project):
    result = project.runpytest_inprocess("--world=world.toml", "-k", "other")
    result.assert_outcomes(failed=1, deselected=2)


def test_world_that_is_no_fragment_is_told(project):
    (project.path / "world.toml").write_text("[rig]\nname = 1\n")
    result = project.runpytest_inprocess("--rig=wheels/rig.toml", "--world=world.toml")
    result.assert_outcomes(passed=1, failed=1, errors=1)
    result.stdout.fnmatch_lines_random(["*world.toml:1: *"])
