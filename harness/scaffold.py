"""The shipped examples, and how one of them becomes a new rig of one's own, with its CI."""

import shlex
from collections.abc import Iterable, Mapping
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
_CI: Final = EXAMPLES / "ci"
_HELPER: Final = "vcan-or-hub"
CI_FILES: Final = {"github": ".github/workflows/motors.yml", "gitlab": ".gitlab-ci.yml"}


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


def write_new_rig(folder: Path, ci: str | None = None) -> list[Path]:
    """A working rig, a motor model, a script and the schema for editors are in the folder.

    Args:
        folder: where; it is made if missing.
        ci: also write such a CI job, one of CI_FILES, into the current folder; a rig that is in
            `folder` already then stays as it is.

    Returns:
        The files written.

    Raises:
        RigError: one of them is there already, or cannot be written.
    """
    is_there = ci is not None and (folder / "rig.toml").exists()
    rig = {} if is_there else _rig(folder)
    job = {} if ci is None else _job(ci, folder)
    _refuse_existing(rig, "name another folder: motorhil new DIR")
    _refuse_existing(job, f"take what you need from {_CI}")
    _write(folder, rig | job)
    return [*rig, *job]


def _rig(folder: Path) -> dict[Path, str]:
    texts = {folder / new: (EXAMPLES / old).read_text("utf-8") for old, new in _FILES}
    texts[folder / "rig.toml"] = texts[folder / "rig.toml"].replace(
        f"#:schema ../{SCHEMA.name}", f"#:schema ./{SCHEMA.name}"
    )
    for old, new in _FILES:  # the script names the files beside it
        texts[folder / "drive.py"] = texts[folder / "drive.py"].replace(old, new)
    return texts


def _job(kind: str, folder: Path) -> dict[Path, str]:
    """What runs tests with the folder's rig, and its helper."""
    try:
        place = folder.resolve().relative_to(Path.cwd())
    except ValueError:
        raise RigError(
            folder, "is not in the current folder, where the CI job will be", "go there first"
        ) from None
    job = (_CI / f"{kind}.yml").read_text("utf-8")
    for name in ("rig.toml", "drive.py"):
        job = job.replace(f"wheels/{name}", shlex.quote((place / name).as_posix()))
    return {
        Path(CI_FILES[kind]): job,
        Path(".ci", _HELPER): (_CI / _HELPER).read_text("utf-8"),
    }


def _refuse_existing(paths: Iterable[Path], remedy: str) -> None:
    for path in paths:
        if path.exists():
            raise RigError(path, "is there already", remedy)


def _write(folder: Path, texts: Mapping[Path, str]) -> None:
    missing = {
        above for path in texts for above in (path.parent, *path.parents) if not above.exists()
    }
    made: list[Path] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in texts.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("x", encoding="utf-8") as file:
                made.append(path)
                file.write(text)
    except OSError as error:
        _take_back(made, sorted(missing, reverse=True))
        reason = error.strerror or str(error)
        raise RigError(folder, f"cannot be written: {reason}", "name another folder") from None


def _take_back(files: Iterable[Path], folders: Iterable[Path]) -> None:
    """None of these is there, as far as that can be had."""
    with suppress(OSError):
        for path in files:
            path.unlink()
        for folder in folders:
            folder.rmdir()
