"""Lines of a rig on TCP and pseudo-terminals, for `motorhil serve`."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from emulators.modbus_pty import ModbusPty, ModbusPtyError
from emulators.modbus_socket import ModbusSocket, ModbusSocketError
from emulators.serve import WallLoop
from harness.rig import Rig
from harness.rig_buses import MODBUS_RTU, MODBUS_TCP, BusDescription
from harness.settings import RigError

ModbusDoorError = (ModbusPtyError, ModbusSocketError)
_PORT_MAX: Final = 65_535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the Modbus arguments of `motorhil serve`."""
    parser.add_argument(
        "--modbus-tcp",
        action="append",
        default=[],
        metavar="[BUS=]HOST:PORT",
        help="serve a bus of kind modbus_tcp (default: the first) at this address; port 0 "
        "means any free port; may be repeated",
    )
    parser.add_argument(
        "--modbus-rtu",
        action="append",
        default=[],
        metavar="[BUS=]LINK",
        help="serve a bus of kind modbus_rtu (default: the first) on a pseudo-terminal with "
        "this symbolic link; may be repeated",
    )
    parser.add_argument(
        "--any-address",
        action="store_true",
        help="allow --modbus-tcp addresses that other machines can reach",
    )


def open_doors(rig: Rig, loop: WallLoop, options: argparse.Namespace) -> dict[str, list[str]]:
    """Open the requested endpoints and return them: bus -> HOST:PORT or LINK, one per request.

    Raises:
        RigError: the rig has no such line.
        ModbusSocketError, ModbusPtyError: an address or link cannot be used.
    """
    doors: dict[str, list[str]] = {}
    for text in options.modbus_tcp:
        bus, host, port = _tcp_words(rig, text)
        there = ModbusSocket(host, port, rig.world, bus, any_address=options.any_address)
        loop.add(there)
        doors.setdefault(bus, []).append(str(there))
    for text in options.modbus_rtu:
        bus, link = _words(rig, text, "--modbus-rtu", MODBUS_RTU)
        pty = ModbusPty(Path(link), rig.world, bus)
        loop.add(pty)
        doors.setdefault(bus, []).append(str(pty.link.absolute()))
    return doors


def described(rig: Rig, doors: dict[str, list[str]]) -> Iterable[str]:
    """Return one line of text per endpoint."""
    for name, places in doors.items():
        bus = rig.description.buses[name]
        units = [
            str(one.node_id)
            for one in rig.description.controllers.values()
            if one.bus == name and one.node_id is not None
        ]
        behind = f"units {', '.join(units)}" if units else "no units"
        for place in places:
            yield f"{name}: {_protocol(bus)} at {place}, {behind}"


def _protocol(bus: BusDescription) -> str:
    if bus.kind == MODBUS_TCP:
        return "Modbus/TCP"
    return f"Modbus RTU (as at {bus.bitrate_bit_s} bit/s 8{bus.parity}{bus.stop_bits})"


def _tcp_words(rig: Rig, text: str) -> tuple[str, str, int]:
    bus, place = _words(rig, text, "--modbus-tcp", MODBUS_TCP)
    host, _, port = place.rpartition(":")
    if host.startswith("[") and host.endswith("]"):
        host = host[1:-1]
    if not host or not (port.isascii() and port.isdigit()) or int(port) > _PORT_MAX:
        raise ModbusSocketError(f"--modbus-tcp {text}: no HOST:PORT; usual: 127.0.0.1:5020")
    return bus, host, int(port)


def _words(rig: Rig, text: str, option: str, kind: str) -> tuple[str, str]:
    """Split an option's text into bus and place; the default is the first fitting bus."""
    buses = rig.description.buses
    fitting = [bus.name for bus in buses.values() if bus.kind == kind]
    name, _, place = text.rpartition("=")
    if not name:
        if not fitting:
            raise RigError(rig.description.source.path, *_none(kind, option))
        name = fitting[0]
    if name not in fitting:
        had = f"it is of kind {buses[name].kind}" if name in buses else "the rig has no such bus"
        known = ", ".join(fitting) or "none"
        raise ModbusSocketError(
            f"{option} {text}: bus {name!r}: {had}; buses of kind {kind}: {known}"
        )
    if not place:
        raise ModbusSocketError(f"{option} {text}: names no place; see motorhil serve --help")
    return name, place


def _none(kind: str, option: str) -> tuple[str, str]:
    return (
        f"the rig has no bus of kind {kind}, which {option} serves",
        f'write [bus.NAME] with kind = "{kind}"',
    )
