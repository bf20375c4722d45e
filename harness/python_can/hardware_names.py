"""Names of hardware for the buses of a rig.

A program finds the rig's buses under their hardware names: while it runs in the rig's virtual time,
every python-can interface joins the rig, except those within this process. The channel is the name
of one of the rig's buses, or it is refused. So a program in virtual time never commands hardware.
"""

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, Final

import can
from can.interfaces import BACKENDS

from motorhil.harness.python_can.bus import EmulatedBus, bus_names

_CAN_SETTINGS: Final = ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_BITRATE", "CAN_CONFIG")
_NO_HARDWARE: Final = ("emulated", "virtual")  # python-can interfaces that reach no hardware


@contextmanager
def bus_settings(buses: Iterable[str]) -> Iterator[None]:
    """Let a plain `can.Bus()` join the rig's first bus, and `can.Bus("can1")` another one.

    For a rig without a bus it raises an error that says so. A hardware interface joins the rig's
    bus with the channel's name.
    """
    before = {name: os.environ.pop(name, None) for name in _CAN_SETTINGS}
    os.environ["CAN_INTERFACE"] = "emulated"
    os.environ["CAN_CHANNEL"] = next(iter(buses), "none")
    try:
        with redirect_hardware():
            yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


@contextmanager
def redirect_hardware() -> Iterator[None]:
    """Redirect `can.Bus` of any interface to the rig's bus with the channel's name."""
    before = {name: BACKENDS[name] for name in BACKENDS if name not in _NO_HARDWARE}
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
    return EmulatedBus(name, told_channel=channel, **options)


def _bus_of(channel: str) -> str:
    """Return the rig's name for a channel: can0 for 0, ttyUSB0 for /dev/ttyUSB0."""
    return f"can{channel}" if channel.isdecimal() else channel.rpartition("/")[2]
