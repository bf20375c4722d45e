"""Hardware bus names redirected to the rig: `can.Bus("can0", "socketcan")`.

While a program runs in a rig's virtual time, every python-can interface joins the rig, except those
within this process. The channel is the name of one of the rig's buses, or it is refused. So a
program in virtual time never commands hardware.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

import can
from can.interfaces import BACKENDS

from harness.can_plugin import EmulatedBus, bus_names

_HERE: Final = ("emulated", "virtual")  # python-can interfaces that reach no hardware


@contextmanager
def hardware_is_the_rigs() -> Iterator[None]:
    """Redirect `can.Bus` of any interface to the rig's bus with the channel's name."""
    before = {name: BACKENDS[name] for name in BACKENDS if name not in _HERE}
    for name in before:
        setattr(sys.modules[__name__], _attribute(name), partial(_join, name))
        BACKENDS[name] = (__name__, _attribute(name))
    try:
        yield
    finally:
        BACKENDS.update(before)


def _attribute(interface: str) -> str:
    """Return the attribute of this module that replaces an interface of python-can."""
    return f"{interface} of the rig"


def _join(interface: str, channel: Any = None, **options: Any) -> can.BusABC:
    name, known = _bus_of(str(channel)), bus_names()
    if name not in known:
        raise can.CanInitializationError(
            f"interface {interface!r}, channel {channel!r}: hardware cannot be reached from "
            f"virtual time, and the rig has no bus {name} (its buses: "
            f"{', '.join(known) or 'none'}); name one [bus.{name}], or run the program in wall "
            "time: motorhil serve RIG -- python SCRIPT"
        )
    return EmulatedBus(name, **options)


def _bus_of(channel: str) -> str:
    """Return the rig's name for a channel: can0 for 0, ttyUSB0 for /dev/ttyUSB0."""
    return f"can{channel}" if channel.isdecimal() else channel.rpartition("/")[2]
