"""Kept failures: fragment, test, row and command of each cause."""

import ast
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.kept import command, keep, kept_in, name_of, record_of
from motorhil.harness.swarm.plan import PYTEST, SCRIPT, Program
from motorhil.harness.swarm.report.sentences import story
from tests.support.swarm.campaigns import PLAN, failure

NASTY = 'he said """a\\b""" in 漢字 and \'c\'\nd, ' + 20 * "many words "


@pytest.fixture
def home(tmp_path, monkeypatch):
    folder = tmp_path / "repository"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def values_in(test: Path) -> dict[str, object]:
    """Return the names that a generated test gives to paths."""
    tree = ast.parse(test.read_text(encoding="utf-8"))
    body = [node for node in tree.body if isinstance(node, ast.Assign)]
    names: dict[str, object] = {"Path": Path, "__file__": str(test)}
    exec(compile(ast.Module(body, []), "test", "exec"), names)
    return names


def test_fragment_begins_with_story_and_command(home):
    kept = keep(failure(), PLAN, Path("out"))
    lines = kept.fragment.read_text().splitlines()
    assert lines[0] == f"# {story(kept.row)}"
    assert lines[1] == f"# again: {command(kept.row, PLAN, kept.fragment)}"
    assert lines[3:6] == ["[[fault]]", 'bus = "can0"', 'kind = "drop"']


def test_kept_failures_are_read_back_as_written(home):
    rows = failure(), failure(3, "limit-position", NASTY)
    written = [keep(row, PLAN, Path("out")) for row in rows]
    record_of(rows[0], Path("out")).write_bytes(b"")
    found = {one.row: one for one in kept_in(Path("out"))}
    assert set(found) == set(rows)
    assert found[rows[1]] == written[1]
    assert found[rows[0]] == replace(
        written[0], record=Path("out/failures", f"{name_of(rows[0])}.mcap")
    )


def test_folder_without_failures_keeps_none(tmp_path):
    assert kept_in(tmp_path) == []


def test_damaged_row_of_kept_failure_is_named(home):
    kept = keep(failure(), PLAN, Path("out"))
    kept.fragment.with_suffix(".json").write_text("{")
    with pytest.raises(
        RigError, match=r"out/failures/.*\.json: cannot be read: .*; remove the file"
    ):
        kept_in(Path("out"))


def test_folder_that_cannot_be_written_is_named(home):
    Path("out").write_text("a file")
    with pytest.raises(RigError, match="out/failures: cannot be made: Not a directory"):
        keep(failure(), PLAN, Path("out"))


PROGRAMS = {
    "function": (PLAN.program, "'errand:run'"),
    "script": (
        Program(SCRIPT, "bench/drive.py", ("--fast", 'a "b"')),
        "str(HERE / '../../bench/drive.py')",
    ),
    "pytest": (
        Program(PYTEST, "tests/test_a.py::test_b[1]"),
        "str(HERE / '../../tests/test_a.py') + '::test_b[1]'",
    ),
}


@pytest.mark.parametrize("kind", PROGRAMS)
@pytest.mark.parametrize("columns", [88, 100])
@pytest.mark.parametrize("text", ["short", NASTY])
def test_generated_test_is_formatted_and_clean(home, kind, columns, text):
    program, _ = PROGRAMS[kind]
    kept = keep(failure(text=text), replace(PLAN, program=program), Path("out"))
    ruff = [sys.executable, "-m", "ruff"]
    options = ["--isolated", "--no-cache", "--line-length", str(columns)]
    for words in (["format", "--check"], ["check", "--select", "E,F,W,I,N,UP,B,SIM,D2,D3"]):
        ignored = ["--ignore", "D203,D213"] if words[0] == "check" else []
        done = subprocess.run([*ruff, *words, *options, *ignored, kept.test], capture_output=True)
        assert done.returncode == 0, done.stdout.decode()


@pytest.mark.parametrize("kind", PROGRAMS)
def test_generated_test_names_program_and_words(home, kind):
    program, expected = PROGRAMS[kind]
    kept = keep(failure(), replace(PLAN, program=program), Path("out"))
    tree = ast.parse(kept.test.read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    (call,) = [node for node in calls if ast.unparse(node.func) == "assert_holds"]
    rig, kind_of, name, words = map(ast.unparse, call.args)
    assert (rig, ast.literal_eval(kind_of), name) == ("RIG", program.kind, expected)
    assert tuple(ast.literal_eval(words)) == program.words
    assert {one.arg: ast.unparse(one.value) for one in call.keywords} == {
        "seed": "17",
        "world": "WORLD",
    }


def test_generated_test_finds_its_files_after_a_move(home):
    kept = keep(failure(), PLAN, Path("out"))
    moved = home.parent / "elsewhere"
    home.rename(moved)
    names = values_in(moved / kept.test)
    assert names["RIG"].resolve() == moved / "rig.toml"
    assert names["WORLD"] == moved / kept.fragment
    assert names["WORLD"].is_file()


def test_path_without_common_folder_is_absolute(home):
    kept = keep(failure(), replace(PLAN, rig="/nowhere/rig.toml"), Path("out"))
    assert values_in(kept.test)["RIG"] == Path("/nowhere/rig.toml")


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("function", "motorhil swarm rig.toml errand:run --seed 17 --world 'a b.toml'"),
        (
            "script",
            "motorhil run rig.toml bench/drive.py --seed 17 --world 'a b.toml' -- --fast 'a \"b\"'",
        ),
        (
            "pytest",
            "pytest 'tests/test_a.py::test_b[1]' --rig rig.toml --seed 17 --world 'a b.toml'",
        ),
    ],
)
def test_command_repeats_the_failure(kind, expected):
    plan = replace(PLAN, program=PROGRAMS[kind][0])
    assert command(failure(), plan, Path("a b.toml")) == expected


def test_causes_have_different_names():
    names = {name_of(failure(oracle=f"oracle {n}")) for n in range(20)}
    names |= {name_of(failure(text=80 * "x" + f" {n}")) for n in range(20)}
    assert len(names) == 40
    assert all(len(name) <= 55 and name.isidentifier() for name in names)
