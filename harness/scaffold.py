"""The shipped examples, and how one of them becomes a new rig of one's own."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final

from harness.settings import RigError

EXAMPLES: Final = Path(__file__).parent / "examples"
SCHEMA: Final = Path(__file__).parent / "rig.schema.json"
_START: Final = "two_wheels"  # what a new rig begins as
_FILES: Final = (  # (in the examples, in the new folder)
    (f"{_START}.toml", "rig.toml"),
    ("wheel_model.toml", "wheel_model.toml"),
    (f"{_START}.py", "drive.py"),
    ("../rig.schema.json", "rig.schema.json"),
)


def example_rigs() -> list[Path]:
    """The shipped rigs, in alphabetical order; the other TOML files beside them are models."""
    return [
        path for path in sorted(EXAMPLES.glob("*.toml")) if "\n[motor." in path.read_text("utf-8")
    ]


def first_comment(path: Path) -> str:
    """What a file says about itself in its first line, if that is a comment."""
    with path.open(encoding="utf-8") as file:
        line = file.readline().strip()
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def write_new_rig(folder: Path) -> list[Path]:
    """A working rig, a motor model, a script and the schema for editors are in the folder.

    Returns:
        The files written.

    Raises:
        RigError: one of them is there already, or the folder cannot be written.
    """
    texts = {folder / new: (EXAMPLES / old).read_text("utf-8") for old, new in _FILES}
    texts[folder / "rig.toml"] = texts[folder / "rig.toml"].replace(
        f"#:schema ../{SCHEMA.name}", f"#:schema ./{SCHEMA.name}"
    )
    for old, new in _FILES:  # the script names the files beside it
        texts[folder / "drive.py"] = texts[folder / "drive.py"].replace(old, new)
    for path in texts:
        if path.exists():
            raise RigError(path, "is there already", "name another folder: motorhil new DIR")
    missing = [above for above in (folder, *folder.parents) if not above.exists()]
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            with path.open("x", encoding="utf-8") as file:
                made.append(path)
                file.write(text)
    except OSError as error:
        _take_back(made, missing)
        reason = error.strerror or str(error)
        raise RigError(folder, f"cannot be written: {reason}", "name another folder") from None
    return list(texts)


def _take_back(files: Iterable[Path], folders: Iterable[Path]) -> None:
    """None of these is there, as far as that can be had."""
    with suppress(OSError):
        for path in files:
            path.unlink()
        for folder in folders:
            folder.rmdir()
