"""README is true: what it shows runs, and what it names is there."""

import ast
import re
import tempfile
from pathlib import Path
from xml.etree import ElementTree

import pytest

import motorhil.motorapi.errors
from motorhil.harness.cli.main import main as motorhil
from tests.architecture import rover_picture
from tests.architecture.readme import PICTURE, README, blocks_of, is_told, retold, run, steps_of
from tests.support.checkout import CHECKOUT

TEXT = README.read_text(encoding="utf-8")
PROSE = re.sub(r"^```.*?^```$", "", TEXT, flags=re.DOTALL | re.MULTILINE)
CODE = re.findall(r"`([^`\n]+)`", PROSE)
STEPS = list(steps_of(TEXT))
TRIES_ON_THE_WALL = 3  # a busy machine may stop a process for longer than a heartbeat's 300 ms


@pytest.fixture(scope="module")
def story():
    """What each step printed: (exit status, text), run in order in one folder; and that folder."""
    with tempfile.TemporaryDirectory(prefix="motorhil-readme-") as name:
        folder = Path(name)
        results = []
        for block, told in STEPS:
            result = run(block, folder)
            for _ in range(TRIES_ON_THE_WALL - 1):
                if "wall clock" not in block.special or is_told(told, result[1]):
                    break
                result = run(block, folder)
            results.append(result)
        yield results, folder / "work"


# --- blocks


@pytest.mark.parametrize("number", range(len(STEPS)), ids=[str(block) for block, _ in STEPS])
def test_a_block_runs_and_prints_what_is_shown(story, number):
    block, told = STEPS[number]
    status, printed = story[0][number]
    assert status == int(block.special.get("exit status", 0)), printed
    if told is not None and "not run" not in block.special:
        again = "python -m tests.architecture.readme writes what comes"
        assert is_told(told, printed), f"{told} is not what comes ({again}):\n{printed}"


def test_every_block_of_commands_python_and_toml_is_part_of_the_story():
    places = [block.first for block, _ in STEPS]
    assert len(places) > 15
    for block in blocks_of(TEXT):
        assert block.language in ("bash", "python", "pycon", "toml", "text"), str(block)
        assert block.language == "text" or block.first in places, str(block)
        assert "not run" not in block.special, f"{block}: everything can be run so far"


def test_the_demo_is_what_make_demo_runs_and_shows_its_table(story):
    printed = next(
        printed
        for (block, _), (_, printed) in zip(STEPS, story[0], strict=True)
        if block.lines == ["make demo"]
    )
    assert "digest" in printed
    assert (story[1] / "out/demo.mcap").is_file()


# --- what is named


def test_files_and_tests_that_are_named_are_there():
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    paths = [word for word in CODE if re.fullmatch(r"tests/[\w/]+\.py(::\w+)?", word)]
    assert len(paths) > 10
    for path in [*links, *paths]:
        file, _, test = path.partition("::")
        assert (CHECKOUT / file).is_file(), path
        if test:
            names = [
                node.name
                for node in ast.walk(ast.parse((CHECKOUT / file).read_text()))
                if isinstance(node, ast.FunctionDef)
            ]
            assert test in names, path


def test_headings_that_are_linked_are_there():
    headings = re.findall(r"^##+ (.*)$", TEXT, re.MULTILINE)
    anchors = [re.sub(r"[^\w -]", "", h.lower()).replace(" ", "-") for h in headings]
    linked = re.findall(r"\]\(#([^)]+)\)", TEXT)
    assert set(linked) <= set(anchors)
    assert len(linked) > 10


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
        assert f"make {target}" in TEXT, target
    for target in re.findall(r"make ([a-z-]+)`", TEXT):
        assert target in targets, target


def test_the_error_tree_is_the_one_there_is():
    tree = next(block for block in blocks_of(TEXT) if block.lines[:1] == ["MotorError"])
    documented = [line.strip() for line in motorhil.motorapi.errors.__doc__.splitlines()]
    assert [line.strip() for line in tree.lines] == [
        line
        for line in documented
        if line == "MotorError" or line.startswith(("|--", "|   ", "`--"))
    ]


def test_every_runtime_dependency_is_explained():
    project = (CHECKOUT / "pyproject.toml").read_text()
    listed = re.search(r"^dependencies = \[(.*?)\]", project, re.DOTALL | re.MULTILINE)[1]
    for name in re.findall(r'"([a-z-]+)[>=<]', listed):
        assert re.search(rf"^\| {name} \| .+ \|$", TEXT, re.MULTILINE), name


def test_the_determinism_contract_is_whole():
    rows = re.findall(r"^\| D(\d) \| .+ \| .+ \|$", TEXT, re.MULTILINE)
    assert rows == [str(number) for number in range(1, 9)]


# --- the picture


def polylines(svg):
    for line in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}polyline"):
        xs, ys = zip(*(map(float, p.split(",")) for p in line.get("points").split()), strict=True)
        yield line.get("stroke"), (min(xs), max(xs), min(ys), max(ys))


def texts(svg):
    return [t.text for t in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


def test_the_picture_is_of_the_demo_that_runs_today(story):
    committed = PICTURE.read_text(encoding="utf-8")
    drawn = rover_picture.draw(story[1] / "out/demo.mcap")
    again = "python -m tests.architecture.readme draws what comes"
    assert texts(committed) == texts(drawn), again
    pairs = list(zip(polylines(committed), polylines(drawn), strict=True))
    assert len(pairs) == 40  # 3 x 6 curves, pan and tilt, and their keys
    for (colour, box), (other_colour, other_box) in pairs:
        assert colour == other_colour, again
        # Two increments of a following error, a tenth of a panel: what a tuned gain may change.
        assert all(abs(a - b) < 12.0 for a, b in zip(box, other_box, strict=True)), again


# --- that the test of a block can fail


def block(text, machine=""):
    (found,) = blocks_of(f"<!-- by machine: {machine} -->\n```text\n{text}\n```\n")
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
    (found,) = blocks_of("```bash\nfalse\ntrue\n```\n")
    assert run(found, tmp_path)[0] == 1
    (found,) = blocks_of("```bash\nmake no-such-target\n```\n")
    assert run(found, tmp_path)[0] != 0
