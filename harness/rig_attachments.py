"""Files that a rig names, which are attached to its recordings."""

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from harness.rig_file import RigDescription

_TOML: Final = "application/toml"
_NAMING: Final = (
    ("motor", "model", _TOML),
    ("controller", "eds", "text/plain"),
    ("controller", "nonvolatile_memory", "text/plain"),
)


def named_files(rig: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return (file as the rig names it, media type) of every file in its tables, each once."""
    found: dict[str, str] = {}
    for kind, key, media_type in _NAMING:
        tables = rig.get(kind)
        for table in tables.values() if isinstance(tables, dict) else ():
            named = table.get(key) if isinstance(table, dict) else None
            if isinstance(named, str):
                found.setdefault(named, media_type)
    return list(found.items())


def files_of(description: "RigDescription") -> list[tuple[str, str, bytes]]:
    """Return (name, media type, contents) of the rig and of every file it names, each once.

    Files of a recorded rig are not on disk; their contents come from the recording.
    """
    source = description.source
    files = [(source.path.name, _TOML, source.text.encode())]
    paths = [(motor.model, _TOML) for motor in description.motors.values()]
    for controller in description.controllers.values():
        eds = controller.settings.get("eds")
        if isinstance(eds, str):
            paths.append((description.folder / eds, "text/plain"))
    paths += [
        (description.folder / named, media_type)
        for named, media_type in named_files(tomllib.loads(source.text))
    ]
    files += _contents(path for path in paths if isinstance(path[0], Path))
    names = {name for name, _, _ in files}
    return files + [one for one in description.attached if one[0] not in names]


def _contents(paths: Iterable[tuple[object, str]]) -> list[tuple[str, str, bytes]]:
    seen: list[Path] = []
    files: list[tuple[str, str, bytes]] = []
    for path, media_type in paths:
        if isinstance(path, Path) and path not in seen and path.is_file():
            seen.append(path)
            files.append((path.name, media_type, path.read_bytes()))
    return files
