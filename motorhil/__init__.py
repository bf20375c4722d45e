"""Motor interface, emulated drives, harness and traces under one name.

The names that most programs need are here; each is loaded when it is first used. Everything else is
in the four packages `motorapi`, `emulators`, `traces` and `harness`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig as Rig
    from motorhil.harness.shared_time.remote_rig import join as join
    from motorhil.harness.swarm.properties import always as always
    from motorhil.harness.swarm.properties import sometimes as sometimes

_HOMES = {
    "Rig": "motorhil.harness.rig.rig",
    "always": "motorhil.harness.swarm.properties",
    "join": "motorhil.harness.shared_time.remote_rig",
    "sometimes": "motorhil.harness.swarm.properties",
}


def __getattr__(name: str) -> object:
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module 'motorhil' has no attribute {name!r}")
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
