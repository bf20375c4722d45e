import subprocess
import sys
import time

import pytest

from tests.architecture.quick import DEADLINE, changed_modules, distances, selected
from tests.support.checkout import CHECKOUT

IMPORTS = {"m.a": set(), "m.b": {"m.a"}, "tests.test_b": {"m.b"}, "tests.test_c": {"m.c"}}


def test_distance_is_the_shortest_chain_of_imports():
    assert distances({"m.a"}, IMPORTS) == {"m.a": 0, "m.b": 1, "tests.test_b": 2}
    assert distances(set(), IMPORTS) == {}


def test_data_file_changed_selects_modules_that_name_it(tmp_path, monkeypatch):
    (tmp_path / "one.py").write_text('TEXT = "table.csv"')
    (tmp_path / "two.py").write_text("")
    graph = {name: (tmp_path / f"{name}.py", set()) for name in ("one", "two")}
    monkeypatch.setattr("tests.architecture.quick.CHECKOUT", tmp_path)
    assert changed_modules(["data/table.csv"], graph) == {"one"}
    assert changed_modules(["two.py", "gone.py"], graph) == {"two"}


def test_nearest_tests_of_a_module_come_first():
    chosen = selected(["emulators/canopen/emcy.py"])
    places = [place for _, place in chosen]
    assert chosen == sorted(chosen)
    assert "tests/unit/emulators/canopen/test_emcy.py" in places
    assert "tests/unit/motorapi/functions/test_values.py" not in places


@pytest.mark.parametrize(("left_s", "ran"), [(1e6, "1 passed"), (-1.0, "1 tests were not run")])
def test_no_test_begins_after_the_deadline(tmp_path, left_s, ran):
    (tmp_path / "test_one.py").write_text("def test_one():\n    pass\n")
    command = (sys.executable, "-m", "pytest", "-p", "tests.architecture.quick", "--rootdir", ".")
    done = subprocess.run(
        (*command, "-p", "no:cacheprovider", "-c", "/dev/null", "test_one.py"),
        cwd=tmp_path,
        env={"PYTHONPATH": str(CHECKOUT), DEADLINE: str(time.time() + left_s)},
        capture_output=True,
        text=True,
    )
    assert ran in done.stdout, done.stdout + done.stderr
