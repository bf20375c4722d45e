"""README as a story that runs: its fenced blocks, one after another, in a folder beside a clone.

python -m tests.architecture.readme       runs it, writes into README what really comes, and draws
                                          its picture of the demo anew

A block of Python or shell is run; a `text` block right behind it is what it prints, errors
included, in the order of a terminal. In between, and before a block, comments say what is special:

    <!-- file: NAME -->            the block is written to NAME, not run
    <!-- in the rig: RIG -->       the Python runs as `motorhil run RIG -`
    <!-- exit status: N -->        it ends so (else 0)
    <!-- not run: WHY -->          it cannot be run here
    <!-- by machine: REGEX -->     what matches may differ in the text that follows

Blocks of `pycon` are one session, and a doctest: each is run behind those before it.
A line "..." in a text stands for any lines left out, and "..." within a line for any characters.
The first `make demo` runs what the Makefile says of PURE=1; of other targets only that they exist
is asked.
"""

import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from tests.architecture import rover_picture
from tests.support.checkout import CHECKOUT

README = CHECKOUT / "README.md"
PICTURE = CHECKOUT / "docs" / "rover.svg"
FENCE = re.compile(r"^```(\w*)$")
COMMENT = re.compile(r"^<!-- ([a-z ]+): (.*) -->$")
RUN = ("bash", "python", "pycon")
DOCTEST = """
import doctest, sys
failed, _ = doctest.testfile(sys.argv[1], module_relative=False, optionflags=doctest.ELLIPSIS)
sys.exit(failed > 0)
"""
PRELUDE = f"""set -euo pipefail
make() {{
    grep -q "^$1:.*##" {CHECKOUT}/Makefile
    if [ "$*" = demo ] && [ ! -e out ]; then
        commands=$(command make --no-print-directory -C {CHECKOUT} -n -o .venv/.ready demo PURE=1)
        eval "${{commands//.venv\\/bin\\//}}"
    fi
}}
pip() {{ command python -m pip "$@" --quiet --disable-pip-version-check --no-index --no-deps \\
    --no-build-isolation --target "$INSTALLED"; }}
"""


@dataclass
class Block:
    """A fenced block: what language, which lines of README (from 0) it fills, what is special."""

    language: str
    first: int
    lines: list[str]
    special: dict[str, str] = field(default_factory=dict)

    @property
    def text(self):
        return "".join(f"{line}\n" for line in self.lines)

    def __str__(self):
        return f"README.md:{self.first}"


def blocks_of(text):
    """All fenced blocks, each with the comments that stand right before it."""
    found, special, block = [], {}, None
    for number, line in enumerate(text.splitlines()):
        fence, comment = FENCE.match(line), COMMENT.match(line)
        if block is not None:
            if line == "```":
                found.append(block)
                block, special = None, {}
            else:
                block.lines.append(line)
        elif fence:
            block = Block(fence[1], number + 1, [], special)
        elif comment:
            special[comment[1]] = comment[2]
        elif line:
            special = {}
    return found


def steps_of(text):
    """(block, what it prints or None) for all blocks that do something, in order."""
    blocks = blocks_of(text)
    lines = text.splitlines()
    for block, after in zip(blocks, [*blocks[1:], None], strict=True):
        if block.language not in RUN and "file" not in block.special:
            continue
        told = None
        if after is not None and after.language == "text":
            between = lines[block.first + len(block.lines) + 1 : after.first - 1]
            if all(not line or COMMENT.match(line) for line in between):
                told = after
        yield block, told


def environment(folder):
    """Of a user who has installed motorhil and nothing else."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("CAN_", "MOTORHIL_"))}
    return {
        **kept,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(folder / "site"), kept.get("PYTHONPATH")])),
        "INSTALLED": str(folder / "site"),
        "PYTHONUNBUFFERED": "1",
    }


def run(block, folder):
    """(exit status, what it printed) of a block."""
    work = folder / "work"
    if not work.is_dir():
        work.mkdir()
        (work / "motorhil").symlink_to(CHECKOUT)
    if "file" in block.special:
        path = work / block.special["file"]
        path.parent.mkdir(exist_ok=True)
        path.write_text(block.text)
        return 0, ""
    if "not run" in block.special:
        return 0, ""
    if block.language == "bash":
        command, text = ["bash", "-c", PRELUDE + block.text], ""
    elif block.language == "pycon":
        session = folder / "session.txt"
        with session.open("a", encoding="utf-8") as file:
            file.write(f"{block.text}\n")
        command, text = ["python", "-c", DOCTEST, str(session)], ""
    elif "in the rig" in block.special:
        command, text = ["motorhil", "run", block.special["in the rig"], "-"], block.text
    else:
        command, text = ["python", "-c", block.text], ""
    done = subprocess.run(
        command,
        cwd=work,
        env=environment(folder),
        input=text,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, done.stdout


def pattern_of(line, machine):
    """The regex for a line of a text block."""
    parts = re.split(machine, line) if machine else [line]
    escaped = [r".*".join(re.escape(part) for part in piece.split("...")) for piece in parts]
    return f"(?:{machine})".join(escaped) if machine else escaped[0]


def is_told(block, printed):
    """Whether a text block says what was printed."""
    machine = block.special.get("by machine", "")
    patterns = [
        r"(?:.*\n)*?" if line.strip() == "..." else pattern_of(line.rstrip(), machine) + r"\n"
        for line in block.lines
    ]
    text = "".join(f"{line.rstrip()}\n" for line in printed.splitlines())
    return re.fullmatch("".join(patterns), text) is not None


def retold(block, printed):
    """The lines that the text block should have; what was left out is left out again."""
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
    """Whether two lines begin with the same word, numbers and units aside; or both are empty."""
    first, second = (re.search(r"[A-Za-z/]\S+", line) for line in (old, new))
    if first is None or second is None:
        return old.strip() == new.strip()
    return first[0] == second[0]


def main():
    """README says what its blocks print; one line for each that was changed."""
    text = README.read_text(encoding="utf-8")
    lines = text.splitlines()
    changes = []
    with tempfile.TemporaryDirectory() as name:
        for block, told in steps_of(text):
            status, printed = run(block, Path(name))
            if status != int(block.special.get("exit status", 0)):
                sys.exit(f"{block}: exit status {status}\n{printed}")
            if told is not None and "not run" not in block.special and not is_told(told, printed):
                changes.append((told, retold(told, printed)))
        drawn = rover_picture.draw(Path(name) / "work" / "out" / "demo.mcap")
    PICTURE.write_text(drawn, encoding="utf-8")
    for told, new in reversed(changes):
        lines[told.first : told.first + len(told.lines)] = new
    README.write_text("\n".join(lines) + "\n", encoding="utf-8")
    for told, _ in changes:
        print(f"{told}: written anew")


if __name__ == "__main__":
    main()
