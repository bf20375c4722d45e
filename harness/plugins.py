"""Installed emulated controllers and motor adaptations, found by entry point.

Their names come from package metadata. A module is loaded only when one of its kind is used.

    motorhil.controllers    build(settings, context) -> motorhil.emulators.controller.Controller
    motorhil.adaptations    build(bus, settings, model, runtime) -> motorapi.Motor
    motorhil.decoders       build(node_id) -> decode(frame) -> BusMessage | None

By default both build for CAN buses. An attribute lists other kinds of buses: `build.bus_kinds =
("modbus_rtu", "modbus_tcp")`. An adaptation then gets a ByteLine in place of a bus, and `unit` in
its settings in place of `node_id`.

An adaptation whose motors are on no bus has the attribute `build.needs_bus = False`. It gets None,
and a rig's motor of its kind names neither controller nor bus.

The decorators `adaptation` (motorhil.motorapi.api) and `controller` (motorhil.emulators.api) set
these attributes, and the version of the API that a plugin was written for.

An adaptation can have a rig of its own for `motorhil conform`, used if the command line names none:
`build.conformance_rig`, a path relative to the folder of its module.

A decoder has the name of the controllers whose frames it describes, for `show`, `judge` and
`report`. `decode` gets every frame of their bus (traces/can_frame.py), and returns None for those
of others.

A plugin that is not installed is named by its target, "package.module:function".

A controller with a register map can list it for `motorhil list registers NAME`: `build.registers`,
called without arguments, returns the rows (Register).
"""

import re
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, final

from motorhil.frozen import frozen

CONTROLLERS: Final = "motorhil.controllers"
ADAPTATIONS: Final = "motorhil.adaptations"
DECODERS: Final = "motorhil.decoders"
SETTINGS: Final = {
    CONTROLLERS: "motorhil.controller_settings",
    ADAPTATIONS: "motorhil.adaptation_settings",
}
"""The group in which the plugins of a group declare their tables (`motorhil.settings`)."""
_TARGET: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", re.ASCII)


class PluginVersionError(ImportError):
    """A plugin that was written for another version of the API."""

    def __init__(self, problem: str, remedy: str) -> None:
        super().__init__(f"{problem}; {remedy}")
        self.problem: Final = problem
        self.remedy: Final = remedy


def _of_adaptations() -> tuple[str, int]:
    from motorhil.motorapi.api.registration import API_VERSION

    return "motorhil.motorapi.api", API_VERSION


def _of_controllers() -> tuple[str, int]:
    from motorhil.emulators.controller import API_VERSION

    return "motorhil.emulators.api", API_VERSION


_APIS: Final = {ADAPTATIONS: _of_adaptations, CONTROLLERS: _of_controllers}


def _check_version(written_for: object, api: str, version: int) -> None:
    if written_for == version:
        return
    newer = isinstance(written_for, int) and written_for > version
    raise PluginVersionError(
        f"was written for version {written_for!r} of {api}; this motorhil has version {version}",
        "upgrade motorhil" if newer else "install a newer release of the plugin",
    )


@final
@frozen
class Plugin:
    """One entry point.

    Attributes:
        name: its name in rigs.
        target: "module:function".
    """

    name: str
    target: str
    entry_point: metadata.EntryPoint

    @property
    def package(self) -> str:
        """The distribution that contains it, and its version; "" if unknown."""
        dist = self.entry_point.dist
        return "" if dist is None else f"{dist.name} {dist.version}"

    def load(self) -> Callable[..., Any]:
        """Import and return the build function; exceptions of the import propagate.

        Raises:
            PluginVersionError: it was written for another version of the API.
        """
        loaded: Callable[..., Any] = self.entry_point.load()
        written_for = getattr(loaded, "api_version", None)
        if written_for is not None and self.entry_point.group in _APIS:
            _check_version(written_for, *_APIS[self.entry_point.group]())
        return loaded


def installed(group: str) -> dict[str, Plugin]:
    """Return a group's plugins by name, in alphabetical order; the first one found counts."""
    return dict(_installed(group, tuple(sys.path)))


def is_target(name: str) -> bool:
    """Return True for "package.module:function", which is not the name of a plugin."""
    return _TARGET.fullmatch(name) is not None


def named(group: str, name: str) -> Plugin:
    """Return the plugin of this name: an installed one, or the target that the name gives.

    Raises:
        KeyError: no plugin has this name.
    """
    if is_target(name):
        return Plugin(name, name, metadata.EntryPoint(name, name, group))
    return _installed(group, tuple(sys.path))[name]


def own_eds(target: str) -> Path | None:
    """Return the EDS file shipped in a controller package's folder `eds`, or None.

    The controller's module is not imported: the file is `package/eds/*_NAME.eds` for
    `package.NAME.module:function`.
    """
    package, _, name = target.partition(":")[0].rpartition(".")[0].rpartition(".")
    spec = find_spec(package) if package else None
    if spec is None or not spec.submodule_search_locations:
        return None
    for folder in spec.submodule_search_locations:
        for path in sorted((Path(folder) / "eds").glob(f"*_{name}.eds")):
            return path
    return None


@lru_cache(maxsize=8)
def _installed(group: str, path: tuple[str, ...]) -> Mapping[str, Plugin]:
    found: dict[str, Plugin] = {}
    for entry_point in _entry_points(path)(group=group):
        plugin = Plugin(entry_point.name, entry_point.value, entry_point)
        found.setdefault(entry_point.name, plugin)
    return MappingProxyType(dict(sorted(found.items())))


@lru_cache(maxsize=1)
def _entry_points(path: tuple[str, ...]) -> Callable[..., metadata.EntryPoints]:
    """Return a selection from all entry points along `path` (sys.path).

    Cached, because reading them takes 5 ms, whatever the group.
    """
    return metadata.entry_points().select
