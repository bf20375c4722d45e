"""Documents whose code blocks run: README.md and every page below docs.

python -m tests.architecture.pages [PAGE ...]    run pages, write their real output into them, and
                                                 redraw README's picture if README is among them

Each page runs in a folder of its own, one block after another. A `text` block directly behind a
block of Python or shell is its expected output, standard error included. Comments in front of a
block modify it:

    <!-- file: NAME -->            write the block to NAME; do not run it
    <!-- in the rig: RIG -->       run the Python as `motorhil run RIG -`
    <!-- exit status: N -->        expect this exit status (default 0)
    <!-- not run: WHY -->          the block cannot run here
    <!-- needs: PROGRAM -->        the block runs where this program is installed
    <!-- wall clock: yes -->       retry the block: a busy machine may delay it
    <!-- by machine: REGEX -->     matching text may differ in the output that follows

A comment anywhere on a page prepares its folder:

    <!-- starts with: NAME ... -->     `wheels` is the rig of `motorhil new wheels`, `demo` is
                                       out/demo.mcap, and NAME.py is the block that another page
                                       writes to that file

Blocks of `pycon` are one session per page, which runs where the first of them stands.
A line "..." in an output stands for any lines, and "..." within a line for any characters.
The first `make demo` runs the commands of PURE=1 in the Makefile. Other make targets are only
checked for existence.
"""

import atexit
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from motorhil.compiled import PURE
from tests.architecture import rover_picture
from tests.support.checkout import CHECKOUT

README = CHECKOUT / "README.md"
PAGES = (README, *sorted((CHECKOUT / "docs").rglob("*.md")))
STARTS = re.compile(r"^<!-- starts with: (.*) -->$", re.MULTILINE)
PREPARED = {"wheels": ("motorhil new wheels", "wheels"), "demo": ("motorhil demo", "out")}
PICTURE = CHECKOUT / "docs" / "rover.svg"
FENCE = re.compile(r"^```(\w*)$")
COMMENT = re.compile(r"^<!-- ([a-z ]+): (.*) -->$")
TRIES_ON_THE_WALL = 3  # a busy machine may stop a process for longer than a heartbeat's 300 ms
RUN = ("bash", "python", "pycon")
# One process runs a session: it prints a line for each block, (exit status, printed) in JSON.
DOCTEST = """
import contextlib, doctest, io, json, sys
names, parser = {}, doctest.DocTestParser()
for number, text in enumerate(json.load(sys.stdin)):
    test = parser.get_doctest(text, names, f"session {number}", "session", 0)
    said = io.StringIO()
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    with contextlib.redirect_stderr(said):
        failed, _ = runner.run(test, out=said.write, clear_globs=False)
    names = test.globs
    print(json.dumps((int(failed > 0), said.getvalue())), flush=True)
"""
PRELUDE = f"""set -euo pipefail
make() {{
    grep -q "^$1:.*##" {CHECKOUT}/Makefile
    if [ "$*" = demo ] && [ ! -e out ]; then
        commands=$(command make --no-print-directory -C {CHECKOUT} -n -o .venv/.ready demo PURE=1)
        eval "${{commands//.venv\\/bin\\//}}"
    fi
}}
pytest() {{ command python -P -m pytest "$@"; }}
pip() {{ command python -m pip "$@" --quiet --disable-pip-version-check --no-index --no-deps \\
    --no-build-isolation --upgrade --target "$INSTALLED"; }}
"""


@dataclass
class Block:
    """A fenced block: its page, language, first line (from 0), lines and modifying comments."""

    page: str
    language: str
    first: int
    lines: list[str]
    special: dict[str, str] = field(default_factory=dict)

    @property
    def text(self) -> str:
        return "".join(f"{line}\n" for line in self.lines)

    def is_left_out(self) -> bool:
        """Return whether the block does not run on this machine."""
        needed = self.special.get("needs")
        return "not run" in self.special or (needed is not None and shutil.which(needed) is None)

    def __str__(self) -> str:
        return f"{self.page}:{self.first}"


def name_of(page: Path) -> str:
    """Return the name of a page, relative to the checkout."""
    return page.relative_to(CHECKOUT).as_posix()


def blocks_of(text: str, page: str = "README.md") -> list[Block]:
    """Return all fenced blocks, each with the comments directly before it."""
    found: list[Block] = []
    special: dict[str, str] = {}
    block = None
    for number, line in enumerate(text.splitlines()):
        fence, comment = FENCE.match(line), COMMENT.match(line)
        if block is not None:
            if line == "```":
                found.append(block)
                block, special = None, {}
            else:
                block.lines.append(line)
        elif fence:
            block = Block(page, fence[1], number + 1, [], special)
        elif comment:
            special[comment[1]] = comment[2]
        elif line:
            special = {}
    return found


def steps_of(text: str, page: str = "README.md") -> Iterator[tuple[Block, Block | None]]:
    """Yield (block, its expected output or None) for every block that does something, in order."""
    blocks = blocks_of(text, page)
    lines = text.splitlines()
    for block, after in zip(blocks, [*blocks, None][1:], strict=True):
        if block.language not in RUN and "file" not in block.special:
            continue
        told = None
        if after is not None and after.language == "text":
            between = lines[block.first + len(block.lines) + 1 : after.first - 1]
            if all(not line or COMMENT.match(line) for line in between):
                told = after
        yield block, told


@cache
def prepared(name: str) -> Path:
    """Return a folder with the result of a preparing command, made once per process."""
    folder = Path(tempfile.mkdtemp(prefix=f"motorhil-{name}-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    subprocess.run(
        PREPARED[name][0].split(),
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        timeout=120,
        check=True,
    )
    return folder


def prepare(text: str, folder: Path) -> None:
    """Put into a page's folder all that the page starts with."""
    work = folder / "work"
    work.mkdir()
    (folder / "motorhil").symlink_to(CHECKOUT)  # a clone beside the folder, never in it
    names = [name for line in STARTS.findall(text) for name in line.split()]
    for name in names:
        if name in PREPARED:
            made = PREPARED[name][1]
            shutil.copytree(prepared(name) / made, work / made)
        else:
            (work / name).write_text(shown_file(name).text)


def shown_file(name: str) -> Block:
    """Return the block that some page writes to the named file."""
    for page in PAGES:
        for block in blocks_of(page.read_text(encoding="utf-8"), name_of(page)):
            if block.special.get("file") == name:
                return block
    raise LookupError(f"{name}: no page writes this file")


def environment(folder):
    """Return the environment of a user who has installed motorhil and nothing else."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("CAN_", "MOTORHIL_"))}
    return {
        **kept,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(folder / "site"),
        "INSTALLED": str(folder / "site"),
        "PYTHONUNBUFFERED": "1",
        PURE: os.environ.get(PURE, "1"),  # as the other tests (tests/conftest.py)
    }


def run(block, folder):
    """Run a block; return its exit status and its output."""
    work = folder / "work"
    if "file" in block.special:
        path = work / block.special["file"]
        path.parent.mkdir(exist_ok=True)
        path.write_text(block.text)
        return 0, ""
    if block.is_left_out():
        return 0, ""
    if block.language == "pycon":
        return in_session([block], folder)[0]
    if block.language == "bash":
        command, text = ["bash", "-c", PRELUDE + block.text], ""
    elif "in the rig" in block.special:
        command, text = ["motorhil", "run", block.special["in the rig"], "-"], block.text
    else:
        command, text = ["python", "-c", block.text], ""
    return execute(command, text, folder)


def in_session(blocks: Sequence[Block], folder: Path) -> list[tuple[int, str]]:
    """Run blocks of `pycon` as one session; return exit status and output of each."""
    text = json.dumps([block.text for block in blocks])
    status, printed = execute(["python", "-c", DOCTEST], text, folder)
    lines = [json.loads(line) for line in printed.splitlines() if line.startswith("[")]
    missing = [(status or 1, printed)] * (len(blocks) - len(lines))
    return [(status, printed) for status, printed in lines] + missing


def execute(command: Sequence[str], text: str, folder: Path) -> tuple[int, str]:
    """Run a command in a page's folder; return its exit status and its output."""
    done = subprocess.run(
        command,
        cwd=folder / "work",
        env=environment(folder),
        input=text,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, done.stdout


def results_of(steps: Sequence[tuple[Block, Block | None]], folder: Path) -> list[tuple[int, str]]:
    """Run the steps of a page in order; return exit status and output of each.

    Blocks of `pycon` run together, where the first of them stands. A block on the wall clock is
    repeated if its output is not the expected one.
    """
    session = [block for block, _ in steps if block.language == "pycon"]
    answers: list[tuple[int, str]] = []
    results = []
    for block, told in steps:
        if block.language == "pycon":
            answers = answers or in_session(session, folder)
            results.append(answers[session.index(block)])
            continue
        tries = TRIES_ON_THE_WALL if "wall clock" in block.special else 1
        for _ in range(tries):
            result = run(block, folder)
            if told is None or is_told(told, result[1]):
                break
        results.append(result)
    return results


def pattern_of(line, machine):
    """Return the regex for a line of an expected output."""
    parts = re.split(machine, line) if machine else [line]
    escaped = [r".*".join(re.escape(part) for part in piece.split("...")) for piece in parts]
    return f"(?:{machine})".join(escaped) if machine else escaped[0]


def is_told(block, printed):
    """Return whether the expected output matches what was printed."""
    machine = block.special.get("by machine", "")
    patterns = [
        r"(?:.*\n)*?" if line.strip() == "..." else pattern_of(line.rstrip(), machine) + r"\n"
        for line in block.lines
    ]
    text = "".join(f"{line.rstrip()}\n" for line in printed.splitlines())
    return re.fullmatch("".join(patterns), text) is not None


def retold(block, printed):
    """Return the lines the expected output should have, with the same omissions."""
    lines = [line.rstrip() for line in printed.splitlines()]
    if not any(line.strip() == "..." for line in block.lines):
        return lines
    rest = list(lines)
    said = []
    for line in block.lines:
        place = next((k for k, new in enumerate(rest) if same_row(line, new)), None)
        if line.strip() != "..." and place is not None:
            said.append(rest[place])
            del rest[: place + 1]
        else:
            said.append(line)
    return said


def same_row(old, new):
    """Return whether two lines begin with the same word, numbers aside, or are both empty."""
    first, second = (re.search(r"[A-Za-z/]\S+", line) for line in (old, new))
    if first is None or second is None:
        return old.strip() == new.strip()
    return first[0] == second[0]


def rewrite(page: Path) -> None:
    """Write the real output of a page's blocks into the page; print each changed place."""
    text = page.read_text(encoding="utf-8")
    lines = text.splitlines()
    changes = []
    with tempfile.TemporaryDirectory() as name:
        prepare(text, Path(name))
        steps = list(steps_of(text, name_of(page)))
        results = results_of(steps, Path(name))
        for (block, told), (status, printed) in zip(steps, results, strict=True):
            if status != int(block.special.get("exit status", 0)):
                sys.exit(f"{block}: exit status {status}\n{printed}")
            if told is not None and not block.is_left_out() and not is_told(told, printed):
                changes.append((told, retold(told, printed)))
        if page == README:
            drawn = rover_picture.draw(Path(name) / "work" / "out" / "demo.mcap")
            PICTURE.write_text(drawn, encoding="utf-8")
    for told, new in reversed(changes):
        lines[told.first : told.first + len(told.lines)] = new
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for told, _ in changes:
        print(f"{told}: rewritten")


def main(names: Sequence[str]) -> None:
    """Rewrite the named pages, or all of them."""
    for page in [CHECKOUT / name for name in names] or PAGES:
        rewrite(page)


if __name__ == "__main__":
    main(sys.argv[1:])
