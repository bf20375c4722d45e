"""Shipped examples, and new rigs with CI jobs made from them."""

import json
import re
import shlex
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from motorhil.harness.rig.config.toml import RigError

EXAMPLES: Final = Path(__file__).resolve().parents[2] / "examples"
_SCHEMA: Final = "rig.schema.json"
_NO_SCHEMA: Final = "# Completion in an editor: see rig.schema.json, which `motorhil new` writes.\n"
_START: Final = "two_wheels"  # the example that a new rig starts from
_FILES: Final = (  # (name among the examples, name in the new folder)
    (f"{_START}.toml", "rig.toml"),
    ("wheel_model.toml", "wheel_model.toml"),
    (f"{_START}.py", "drive.py"),
)
_CI: Final = EXAMPLES / "ci"
_HELPER: Final = "vcan-or-hub"
_FIRST_TEST: Final = "first_test.txt"
_TEST: Final = "test_motors.py"
_REQUIREMENTS: Final = "requirements.txt"
_WHEELS: Final = "vendor"
_PROGRAM_STEP: Final = re.compile(  # of either job
    r"      - name: A program in real time.*\n.*\n\n|    - bash [.]ci/vcan-or-hub.*\n"
)
_DRIVE: Final = EXAMPLES / "new_drive"
_DRIVE_MODULE: Final = "motorhil.harness.examples.new_drive"
_DRIVE_NAME: Final = re.compile(r"[a-z][a-z0-9_]{0,31}", re.ASCII)
CI_FILES: Final = {"github": ".github/workflows/motors.yml", "gitlab": ".gitlab-ci.yml"}


def example_rigs() -> list[Path]:
    """Return the shipped rigs in alphabetical order, without the motor models beside them."""
    return [
        path for path in sorted(EXAMPLES.glob("*.toml")) if "\n[motor." in path.read_text("utf-8")
    ]


def first_comment(path: Path) -> str:
    """Return the first line of a file if it is a comment, else ""."""
    with path.open(encoding="utf-8") as file:
        line = file.readline().strip()
    return line.removeprefix("#").strip() if line.startswith("#") else ""


def write_new_rig(folder: Path, ci: str | None = None) -> list[Path]:
    """Write a working rig, a motor model, a script and the editors' schema into the folder.

    Args:
        folder: the folder; created if missing.
        ci: also write this CI job, one of CI_FILES, into the current folder, with a test and a
            requirements.txt if there are none; an existing rig in `folder` stays as it is.

    Returns:
        The files written.

    Raises:
        RigError: a file exists already, or cannot be written.
    """
    if not str(folder).isprintable():
        raise RigError(folder, "is not the name of a folder", "use printable characters only")
    is_there = ci is not None and (folder / "rig.toml").exists()
    rig = {} if is_there else _rig(folder)
    job = {} if ci is None else _job(ci, folder, is_new=not is_there)
    _refuse_existing(rig, "name another folder: motorhil new DIR")
    _refuse_existing(job, f"take what you need from {_CI}")
    _write(folder, rig | job)
    return [*rig, *job]


def write_new_drive(folder: Path, name: str) -> list[Path]:
    """Write a package for a kind of drive: adaptation, emulated drive, rig, model, test, README.

    Args:
        folder: the folder of the package; created if missing.
        name: the name of the kind in rigs; that of its package is motorhil_NAME.

    Returns:
        The files written.

    Raises:
        RigError: the name is not one, a file exists already, or cannot be written.
    """
    if _DRIVE_NAME.fullmatch(name) is None:
        what = f"{name!r} is not the name of a drive"
        raise RigError(folder, what, "use up to 32 of a-z, 0-9 and _, a letter first")
    package = Path("src", f"motorhil_{name}")
    places = {
        "pyproject.txt": Path("pyproject.toml"),
        "readme.txt": Path("README.md"),
        "test_drive.txt": Path("tests", f"test_{name}.py"),
        **{
            one: package / one
            for one in ("__init__.py", "host.py", "emulated.py", "rig.toml", "model.toml")
        },
    }
    texts = {folder / package / "py.typed": ""}
    for source, place in places.items():
        text = (_DRIVE / source).read_text("utf-8")
        text = re.sub(rf'"{re.escape(_DRIVE_MODULE)}[.](?:host|emulated):build"', f'"{name}"', text)
        camel = name.title().replace("_", "")
        texts[folder / place] = text.replace("mydrive", name).replace("Mydrive", camel)
    _refuse_existing(texts, f"name another folder: motorhil new DIR --drive {name}")
    _write(folder, texts)
    return sorted(texts)


def write_rig(folder: Path, text: str) -> list[Path]:
    """Write this rig and the editors' schema into the folder; return the files.

    Raises:
        RigError: a file exists already, or cannot be written.
    """
    from motorhil.harness.rig.config.schema import schema_text  # loads all plugins' tables

    texts = {folder / "rig.toml": f"#:schema ./{_SCHEMA}\n{text}", folder / _SCHEMA: schema_text()}
    _refuse_existing(texts, "name another folder: motorhil new DIR --from FILE")
    _write(folder, texts)
    return list(texts)


def write_program(path: Path, text: str) -> list[Path]:
    """Write a program beside its rig; return the file.

    Raises:
        RigError: the file exists already, or cannot be written.
    """
    _refuse_existing([path], "delete or rename it first")
    _write(path.parent, {path: text})
    return [path]


def _rig(folder: Path) -> dict[Path, str]:
    from motorhil.harness.rig.config.schema import schema_text  # loads all plugins' tables

    texts = {folder / new: (EXAMPLES / old).read_text("utf-8") for old, new in _FILES}
    texts[folder / "rig.toml"] = texts[folder / "rig.toml"].replace(
        _NO_SCHEMA, f"#:schema ./{_SCHEMA}\n"
    )
    for old, new in _FILES:  # the script names the files beside it
        texts[folder / "drive.py"] = texts[folder / "drive.py"].replace(old, new)
    return {**texts, folder / _SCHEMA: schema_text()}


def requirement() -> tuple[str, str]:
    """Return the line that installs this motorhil elsewhere, and a command to run before.

    It is installed from where it was installed from here (direct_url.json, PEP 610). If that is a
    folder of this machine, the command makes a wheel of it, to be committed; else there is none.
    """
    here = metadata.distribution("motorhil")
    origin = json.loads(here.read_text("direct_url.json") or "{}")
    url = str(origin.get("url", ""))
    vcs = origin.get("vcs_info")
    if vcs is not None:
        return f"motorhil @ {vcs['vcs']}+{url}@{vcs['commit_id']}", ""
    if not url:
        return f"motorhil=={here.version}", ""
    if not url.startswith("file:"):
        return f"motorhil @ {url}", ""
    source = shlex.quote(unquote(urlsplit(url).path))
    wheel = f"./{_WHEELS}/motorhil-{here.version}-py3-none-any.whl"
    return wheel, f"python -m pip wheel --no-deps --wheel-dir {_WHEELS} {source}"


def has_tests(folder: Path) -> bool:
    """Return whether pytest finds a test in the folder, the current one, or its `tests`."""
    return any(any(one.glob("test_*.py")) for one in (folder, Path(), Path("tests")))


def _job(kind: str, folder: Path, *, is_new: bool) -> dict[Path, str]:
    """Return the CI job that runs tests with the folder's rig, and what the job needs.

    The step with the rig's program is left out if a rig that exists has none.
    """
    try:
        place = folder.resolve().relative_to(Path.cwd())
    except ValueError:
        raise RigError(
            folder,
            "is not in the current folder, where the CI job is written",
            "change to its parent folder first",
        ) from None
    job = (_CI / f"{kind}.yml").read_text("utf-8")
    has_program = is_new or (folder / "drive.py").exists()
    if not has_program:
        job = _PROGRAM_STEP.sub("", job)
    texts: dict[Path, str] = {}
    if has_program:
        texts[Path(".ci", _HELPER)] = (_CI / _HELPER).read_text("utf-8")
    if not has_tests(folder):
        texts[folder / _TEST] = (_CI / _FIRST_TEST).read_text("utf-8")
    if not Path(_REQUIREMENTS).exists():
        texts[Path(_REQUIREMENTS)] = f"{requirement()[0]}\npytest>=8\n"
    job_file = Path(CI_FILES[kind])
    texts = {job_file: job, **texts}
    for name in ("rig.toml", "drive.py"):
        named = shlex.quote((place / name).as_posix())
        for path in (job_file, folder / _TEST):
            if path in texts:
                texts[path] = texts[path].replace(f"wheels/{name}", named)
    return texts


def _refuse_existing(paths: Iterable[Path], remedy: str) -> None:
    for path in paths:
        try:
            exists = path.exists()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RigError(path.parent, f"cannot be written: {reason}", remedy) from None
        if exists:
            raise RigError(path, "already exists", remedy)


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
    """Delete these files and folders, as far as possible."""
    with suppress(OSError):
        for path in files:
            path.unlink()
        for folder in folders:
            folder.rmdir()
