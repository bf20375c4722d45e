"""What a program that was written for hardware calls its buses: `can.Bus("can0", "socketcan")`.

While it runs in a rig's virtual time every interface of python-can, but those in this process, is
the rig's: the channel is the name of one of its buses, or it is refused. So no program that runs in
virtual time commands hardware.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

import can
from can.interfaces import BACKENDS

from harness.can_plugin import EmulatedBus, bus_names

_HERE: Final = ("emulated", "virtual")  # interfaces of python-can that reach no hardware


@contextmanager
def hardware_is_the_rigs() -> Iterator[None]:
    """Within it, `can.Bus` of any interface joins the rig's bus that has the channel's name."""
    before = {name: BACKENDS[name] for name in BACKENDS if name not in _HERE}
    for name in before:
        setattr(sys.modules[__name__], _attribute(name), partial(_join, name))
        BACKENDS[name] = (__name__, _attribute(name))
    try:
        yield
    finally:
        BACKENDS.update(before)


def _attribute(interface: str) -> str:
    """Under what name python-can finds here what stands in for an interface."""
    return f"{interface} of the rig"


def _join(interface: str, channel: Any = None, **options: Any) -> can.BusABC:
    name, known = _bus_of(str(channel)), bus_names()
    if name not in known:
        raise can.CanInitializationError(
            f"interface {interface!r}, channel {channel!r}: hardware is not reached from virtual "
            f"time, and no bus of the rig is called {name} (there are: "
            f"{', '.join(known) or 'none'}); name one [bus.{name}], or run the program on the "
            "wall's clock: motorhil serve RIG -- python SCRIPT"
        )
    return EmulatedBus(name, **options)


def _bus_of(channel: str) -> str:
    """How a rig calls it: 0 is can0, /dev/ttyUSB0 is ttyUSB0."""
    return f"can{channel}" if channel.isdecimal() else channel.rpartition("/")[2]
