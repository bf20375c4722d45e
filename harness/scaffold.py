"""The shipped examples, and how one of them becomes a new rig of one's own."""

from pathlib import Path
from typing import Final

from harness.settings import RigError

EXAMPLES: Final = Path(__file__).parent / "examples"
_START: Final = "two_wheels"  # what a new rig begins as
_FILES: Final = (  # (in the examples, in the new folder)
    (f"{_START}.toml", "rig.toml"),
    ("wheel_model.toml", "wheel_model.toml"),
    (f"{_START}.py", "drive.py"),
)


def first_comment(path: Path) -> str:
    """What a file says about itself in its first line, if that is a comment."""
    with path.open(encoding="utf-8") as file:
        line = file.readline().strip()
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def write_new_rig(folder: Path) -> list[Path]:
    """A working rig, a motor model and a script are in the folder; the files written.

    Raises:
        RigError: one of them is there already, or the folder cannot be written; nothing is changed.
    """
    texts = [(folder / new, (EXAMPLES / old).read_text("utf-8")) for old, new in _FILES]
    for path, _ in texts:
        if path.exists():
            raise RigError(path, "is there already", "name another folder: motorhil new DIR")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts:
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
    except OSError as error:
        reason = error.strerror or str(error)
        raise RigError(folder, f"cannot be written: {reason}", "name another folder") from None
    return [path for path, _ in texts]
