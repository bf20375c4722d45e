"""README.md and docs: every code block runs, and every named file, test and command exists."""

import ast
import re
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

from motorhil.harness.cli.main import main as motorhil
from motorhil.motorapi import errors
from tests.architecture import rover_picture
from tests.architecture.pages import (
    PAGES,
    PICTURE,
    blocks_of,
    is_told,
    name_of,
    prepare,
    results_of,
    retold,
    run,
    steps_of,
)
from tests.support.checkout import CHECKOUT

TEXTS = {name_of(page): page.read_text(encoding="utf-8") for page in PAGES}
ALL = "\n".join(TEXTS.values())
PROSE = re.sub(r"^```.*?^```$", "", ALL, flags=re.DOTALL | re.MULTILINE)
CODE = re.findall(r"`([^`\n]+)`", PROSE)
STEPS = {page: list(steps_of(text, page)) for page, text in TEXTS.items()}
NUMBERED = [(page, number) for page, steps in STEPS.items() for number in range(len(steps))]
NAMED_FILE = r"(?:tests|docs|harness|motorapi|emulators|traces)/[\w/.-]+\.\w+(?:::\w+)?"


@pytest.fixture(scope="module")
def stories():
    """Run pages on demand, each once: page -> (results of its steps, its working folder)."""
    with tempfile.TemporaryDirectory(prefix="motorhil-pages-") as name:
        yield Stories(Path(name))


class Stories:
    def __init__(self, folder):
        self._folder = folder
        self._told = {}

    def __getitem__(self, page):
        if page not in self._told:
            self._told[page] = self._run(page)
        return self._told[page]

    def _run(self, page):
        folder = self._folder / page.replace("/", "-")
        folder.mkdir()
        prepare(TEXTS[page], folder)
        return results_of(STEPS[page], folder), folder / "work"


# --- blocks


@pytest.mark.parametrize(
    ("page", "number"), NUMBERED, ids=[str(STEPS[page][number][0]) for page, number in NUMBERED]
)
def test_a_block_runs_and_prints_what_is_shown(stories, page, number):
    block, told = STEPS[page][number]
    status, printed = stories[page][0][number]
    assert status == int(block.special.get("exit status", 0)), printed
    if told is not None and not block.is_left_out():
        again = f"python -m tests.architecture.pages {page} writes the real output"
        assert is_told(told, printed), f"{told} is not the output ({again}):\n{printed}"


def test_every_block_of_commands_python_and_toml_runs():
    places = {str(block) for steps in STEPS.values() for block, _ in steps}
    assert len(places) > 50
    for page, text in TEXTS.items():
        for block in blocks_of(text, page):
            languages = ("bash", "python", "pycon", "toml", "yaml", "text")
            is_compiled = block.language == "c" and "file" in block.special
            assert block.language in languages or is_compiled, str(block)
            assert block.language == "text" or str(block) in places, str(block)
            assert "not run" not in block.special, f"{block}: every block can run so far"


def test_readme_make_demo_writes_the_recording_with_its_digest(stories):
    results, folder = stories["README.md"]
    printed = next(
        printed
        for (block, _), (_, printed) in zip(STEPS["README.md"], results, strict=True)
        if block.lines == ["make demo"]
    )
    assert "digest" in printed
    assert (folder / "out/demo.mcap").is_file()


# --- what is named


def test_files_and_tests_that_are_named_exist():
    paths = [word for word in CODE if re.fullmatch(NAMED_FILE, word)]
    assert len(paths) > 30
    for path in paths:
        file, _, test = path.partition("::")
        assert (CHECKOUT / file).is_file(), path
        if test:
            names = [
                node.name
                for node in ast.walk(ast.parse((CHECKOUT / file).read_text()))
                if isinstance(node, ast.FunctionDef)
            ]
            assert test in names, path


@pytest.mark.parametrize("command", sorted({word for word in CODE if word.startswith("motorhil ")}))
def test_commands_that_are_named_exist_with_their_options(command, capsys):
    words = command.split()
    if words[1].startswith("-"):
        assert motorhil(words[1:]) == 0
        return
    assert motorhil([words[1], "--help"]) == 0
    told = capsys.readouterr().out
    for option in re.findall(r"(?<= )--?[a-z]+", command):
        assert option in told


def test_verbs_and_targets_that_exist_are_named(capsys):
    motorhil(["--help"])
    verbs = re.findall(r"^    (\w+)  ", capsys.readouterr().out, re.MULTILINE)
    assert verbs
    for verb in verbs:
        assert any(word.startswith(f"motorhil {verb}") for word in CODE), verb
    makefile = (CHECKOUT / "Makefile").read_text()
    targets = re.findall(r"^([a-z-]+):.*##", makefile, re.MULTILINE)
    assert "bench" in targets
    for target in targets:
        assert f"make {target}" in ALL, target
    for target in re.findall(r"make ([a-z-]+)`", ALL):
        assert target in targets, target


def test_the_error_tree_is_the_one_there_is():
    text = TEXTS["docs/reference/errors.md"]
    tree = next(block for block in blocks_of(text) if block.lines[:1] == ["MotorError"])
    documented = [line.strip() for line in errors.__doc__.splitlines()]
    assert [line.strip() for line in tree.lines] == [
        line
        for line in documented
        if line == "MotorError" or line.startswith(("|--", "|   ", "`--"))
    ]


def test_every_runtime_dependency_is_explained():
    project = (CHECKOUT / "pyproject.toml").read_text()
    listed = re.search(r"^dependencies = \[(.*?)\]", project, re.DOTALL | re.MULTILINE)[1]
    for name in re.findall(r'"([a-z-]+)[>=<]', listed):
        assert re.search(rf"^\| {name} \| .+ \|$", TEXTS["README.md"], re.MULTILINE), name


def test_the_determinism_contract_is_whole():
    rows = re.findall(
        r"^\| D(\d) \| .+ \| .+ \|$", TEXTS["docs/explanation/virtual-time.md"], re.MULTILINE
    )
    assert rows == [str(number) for number in range(1, 9)]


# --- the picture


def polylines(svg):
    for line in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}polyline"):
        xs, ys = zip(*(map(float, p.split(",")) for p in line.get("points").split()), strict=True)
        yield line.get("stroke"), (min(xs), max(xs), min(ys), max(ys))


def texts(svg):
    return [t.text for t in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


def test_the_picture_is_of_the_demo_that_runs_today(stories):
    committed = PICTURE.read_text(encoding="utf-8")
    drawn = rover_picture.draw(stories["README.md"][1] / "out/demo.mcap")
    again = "python -m tests.architecture.pages README.md redraws it"
    assert texts(committed) == texts(drawn), again
    pairs = list(zip(polylines(committed), polylines(drawn), strict=True))
    assert len(pairs) == 40  # 3 x 6 curves, pan and tilt, and their keys
    for (colour, box), (other_colour, other_box) in pairs:
        assert colour == other_colour, again
        # Two increments of a following error, a tenth of a panel: what a tuned gain may change.
        assert all(abs(a - b) < 12.0 for a, b in zip(box, other_box, strict=True)), again


# --- that the test of a block can fail


def block(text, machine=""):
    comment = f"<!-- by machine: {machine} -->"
    (found,) = blocks_of(f"{comment}\n```text\n{text}\n```\n")
    return found


@pytest.mark.parametrize(
    ("shown", "machine", "printed", "holds"),
    [
        ("a\nb", "", "a\nb\n", True),
        ("a\nb", "", "a\nc\n", False),
        ("a\nb", "", "a\nb\nc\n", False),
        ("a\n...\nc", "", "a\nb\nb\nc\n", True),
        ("a\n...\nc", "", "a\nb\nd\n", False),
        ("t ... s", "", "t 12 s\n", True),
        ("t ... s", "", "t 12 h\n", False),
        ("t 1.5 s", r"\d\.\d", "t 2.7 s\n", True),
        ("t 1.5 s", r"\d\.\d", "t fast s\n", False),
        ("x (1) 1.5", r"\d\.\d", "x (2) 1.5\n", False),
    ],
)
def test_a_text_that_differs_is_found(shown, machine, printed, holds):
    assert is_told(block(shown, machine), printed) is holds


def test_a_shortened_text_is_written_anew_row_by_row():
    shown = block("1.5 s head\n...\nrow 2\n\nend 1")
    assert retold(shown, "2.5 s head\n3.5 s old\nrow 7\nmore 1\n\nend 9\n") == [
        *("2.5 s head", "...", "row 7", "", "end 9")
    ]


def test_a_failing_block_fails(tmp_path):
    prepare("", tmp_path)
    (found,) = blocks_of("```bash\nfalse\ntrue\n```\n")
    assert run(found, tmp_path)[0] == 1
    (found,) = blocks_of("```bash\nmake no-such-target\n```\n")
    assert run(found, tmp_path)[0] != 0


def test_block_that_needs_missing_program_is_left_out(tmp_path):
    prepare("", tmp_path)
    for program, is_left_out in (("bash", False), ("no-such-program", True)):
        (found,) = blocks_of(f"<!-- needs: {program} -->\n```bash\nfalse\n```\n")
        assert found.is_left_out() == is_left_out
        assert run(found, tmp_path)[0] == (0 if is_left_out else 1)


def test_a_failing_session_fails_where_it_does(tmp_path):
    prepare("", tmp_path)
    text = "```pycon\n>>> a = 1\n```\n\n```pycon\n>>> a\n2\n```\n\n```pycon\n>>> a\n1\n```\n"
    results = results_of(list(steps_of(text)), tmp_path)
    assert [status for status, _ in results] == [0, 1, 0]
    assert "Got:" in results[1][1]
