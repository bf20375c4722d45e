import re
import shutil
import subprocess

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from tests.support.checkout import CHECKOUT

WORKFLOWS = [*(CHECKOUT / ".github" / "workflows").glob("*.yml"), EXAMPLES / "ci" / "github.yml"]


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_makefile_has_one_recipe_for_each_target():
    done = subprocess.run(
        ["make", "-n", "-o", ".venv/.ready", "check"], cwd=CHECKOUT, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")


def floating(text: str) -> list[str]:
    """Return the actions and tools of a workflow that are not pinned."""
    actions = re.findall(r"uses: *(\S+)", text)
    tools = re.findall(r"pipx run (\S+)", text)
    return [one for one in actions if not re.search(r"@[0-9a-f]{40}$", one)] + [
        one for one in tools if "==" not in one
    ]


@pytest.mark.parametrize("name", WORKFLOWS, ids=lambda path: path.name)
def test_actions_of_a_workflow_are_pinned(name):
    text = name.read_text()
    assert "uses:" in text
    assert floating(text) == []


def test_action_by_tag_is_found():
    text = "- uses: actions/cache@v5\n- run: pipx run cibuildwheel --output-dir dist\n"
    assert floating(text) == ["actions/cache@v5", "cibuildwheel"]


def test_marks_of_waiting_tests_stand_in_their_files():
    """`make test` finds these files by their text; otherwise such a test would not run at all."""
    mark = re.compile(r"\bmark\.(wall|vcan)\b")
    files = [path for path in (CHECKOUT / "tests").rglob("*.py") if mark.search(path.read_text())]
    assert len(files) > 50
    assert [path for path in files if not path.name.startswith("test_")] == []
