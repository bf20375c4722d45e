"""What is installed: emulated controllers and motor adaptations, by entry point.

Their names come from package metadata; a module is loaded only when one of its kind is used.

    motorhil.controllers    build(settings, context) -> emulators.controller.Controller
    motorhil.adaptations    build(bus, settings, model, runtime) -> motorapi.Motor

What either builds is for CAN buses, unless an attribute says for which kinds of buses it is:
`build.bus_kinds = ("modbus_rtu", "modbus_tcp")`. An adaptation then gets the line in place of a bus
(`motorapi.adaptations.modbus_line.ByteLine`), and `unit` in its settings in place of `node_id`.

An adaptation whose motors are on no bus says so by an attribute, `build.needs_bus = False`; it is
given None, and a rig's motor of its kind names neither controller nor bus.

An adaptation can bring the rig on which `motorhil conform` checks it when nobody names another,
`build.conformance_rig`: a path, from the folder of its module on.

What is not installed (yet) is named by its target, "package.module:function", in place of a name.

A controller with a register map can show it to people, by `motorhil list registers NAME`:
`build.registers`, called without arguments, gives the rows (`emulators.modbus.registers.Register`).
"""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from typing import Any, Final, final

CONTROLLERS: Final = "motorhil.controllers"
ADAPTATIONS: Final = "motorhil.adaptations"
_TARGET: Final = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_][\w.]*", re.ASCII)


@final
@dataclass(frozen=True, slots=True)
class Plugin:
    """One entry point.

    Attributes:
        name: what a rig calls it.
        target: "module:function".
    """

    name: str
    target: str
    entry_point: metadata.EntryPoint

    @property
    def package(self) -> str:
        """The distribution that brings it, and its version; "" if that is not known."""
        dist = self.entry_point.dist
        return "" if dist is None else f"{dist.name} {dist.version}"

    def load(self) -> Callable[..., Any]:
        """The function that builds one; whatever importing it raises."""
        loaded: Callable[..., Any] = self.entry_point.load()
        return loaded


def installed(group: str) -> dict[str, Plugin]:
    """The plugins of a group by name, in alphabetical order; of two alike, the first found."""
    found: dict[str, Plugin] = {}
    for entry_point in _entry_points(group, tuple(sys.path)):
        plugin = Plugin(entry_point.name, entry_point.value, entry_point)
        found.setdefault(entry_point.name, plugin)
    return dict(sorted(found.items()))


def is_target(name: str) -> bool:
    """Whether it says where a function is, "package.module:function", and is no plugin's name."""
    return _TARGET.fullmatch(name) is not None


def named(group: str, name: str) -> Plugin:
    """The plugin that a rig calls so: an installed one, or what the name itself points to.

    Raises:
        KeyError: none is called so.
    """
    if is_target(name):
        return Plugin(name, name, metadata.EntryPoint(name, name, group))
    return installed(group)[name]


@lru_cache(maxsize=2)
def _entry_points(group: str, path: tuple[str, ...]) -> metadata.EntryPoints:
    """Those along `path`, which is sys.path; looked for once, for it takes milliseconds."""
    return metadata.entry_points(group=group)
