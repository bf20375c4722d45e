"""The verb `serve`: a rig in real time for other processes.

CAN buses are served on a socket or on SocketCAN, Modbus lines on TCP or on pseudo-terminals.
Programs started beside the rig are child processes, and end with it.
"""

import argparse
import os
import select
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Final, final

from motorhil.emulators.gateways.hub import HubError, HubServer
from motorhil.emulators.gateways.loop import WallLoop
from motorhil.emulators.gateways.modbus_pty import ModbusPty, ModbusPtyError
from motorhil.emulators.gateways.modbus_tcp import ModbusSocket, ModbusSocketError
from motorhil.emulators.gateways.socketcan import SocketCanError, SocketCanGateway
from motorhil.harness.cli.main import FAILED, PASSED, WRONG_USAGE
from motorhil.harness.cli.options import add_seed
from motorhil.harness.cli.processes import StopSignals
from motorhil.harness.cli.viewing import (
    add_foxglove,
    add_view,
    chunk_ns,
    foxglove_words,
    page_of,
    record_for,
)
from motorhil.harness.recording.ownership import LockLooks, LockWriter
from motorhil.harness.replay.device_node import KIND as RECORDED
from motorhil.harness.replay.verdict import summary, unanswered
from motorhil.harness.rig.config.buses import (
    MODBUS_RTU,
    MODBUS_TCP,
    SERIAL,
    BusDescription,
    host_and_port,
)
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig

_NOT_FOUND: Final = 127
_GRACE_S: Final = 3.0
_BOOT_NS: Final = 2_000_000_000  # no emulated node takes longer


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `motorhil serve`."""
    parser.add_argument("rig", type=Path, metavar="RIG", help="the rig file, or a recording")
    parser.add_argument(
        "--socket",
        type=Path,
        metavar="PATH",
        help="serve all buses on this socket: can.Bus(interface='emulated', channel='PATH'); "
        "another bus than the first is 'PATH#can1' (default: a private socket, if no --on)",
    )
    parser.add_argument(
        "--on",
        action="append",
        default=[],
        metavar="[BUS=]INTERFACE",
        help="join a bus (default: the first) with a SocketCAN interface; may be repeated",
    )
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
        "--serial",
        action="append",
        default=[],
        metavar="[BUS=]LINK",
        help="serve a bus of kind serial likewise; may be repeated",
    )
    parser.add_argument(
        "--any-address",
        action="store_true",
        help="allow --modbus-tcp addresses that other machines can reach; whoever reaches one can "
        "move the motors",
    )
    add_seed(parser)
    add_view(parser)
    add_foxglove(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="record to this MCAP file"
    )
    parser.epilog = (
        "With -- COMMAND, the command runs while the rig is up, and its exit status is "
        "returned (CAN_INTERFACE and CAN_CHANNEL name the first CAN bus, MOTORHIL_CHANNEL_NAME "
        "bus or line `name`). Without a command, Ctrl-C stops."
    )


def run(options: argparse.Namespace) -> int:
    """Serve a rig; return 0, 1 (a recording could not answer), 2, or the command's own status."""
    if options.rest == []:
        print("motorhil serve: no command after --; name one, or omit --", file=sys.stderr)
        return WRONG_USAGE
    with ExitStack() as cleanup:
        target = cleanup.enter_context(record_for(options.output, options.view))
        rig = cleanup.enter_context(
            Rig.open(
                options.rig,
                seed=options.seed,
                record=target,
                chunk_ns=chunk_ns(1.0, options.view),
            )
        )
        if options.view and target is not None:
            cleanup.enter_context(
                page_of(
                    target,
                    rig.description.name,
                    options.view_port,
                    stays=False,
                    more=foxglove_words(options),
                )
            )
        for note in rig.notes:
            print(note, file=sys.stderr)
        _require_endpoint(rig, options)
        loop = WallLoop(rig.world.queue)
        cleanup.callback(loop.close)
        try:
            lines = _open_lines(rig, loop, options)
            endpoints = _open_buses(rig, loop, options, cleanup)
            _warn_of_addresses(rig, lines, options)
        except (HubError, SocketCanError, ModbusPtyError, ModbusSocketError) as error:
            print(f"motorhil serve: {error}", file=sys.stderr)
            return WRONG_USAGE
        _record_locks(rig, endpoints, cleanup)
        service = _Service(loop, cleanup.enter_context(StopSignals(loop)))
        if options.rest:
            _let_boot(rig)
            status = service.run_command(options.rest, _environment(endpoints, lines))
            verdict = _report_unanswered(rig)
            return status or verdict
        print(f"serving {rig.description.name}; Ctrl-C stops", file=sys.stderr)
        for bus, (interface, channel) in endpoints.items():
            print(f"{bus}: can.Bus(interface={interface!r}, channel={channel!r})", flush=True)
        for text in _line_texts(rig, lines):
            print(text, flush=True)
        service.run_until_stopped()
        print(
            f"stopped; an event was at most {loop.late_ns_max / 1e6:.1f} ms late", file=sys.stderr
        )
        return _report_unanswered(rig)


def _warn_of_addresses(rig: Rig, lines: dict[str, list[str]], options: argparse.Namespace) -> None:
    """Say who can move the motors at addresses that other machines can reach."""
    buses = rig.description.buses
    for name, places in lines.items():
        if options.any_address and buses[name].kind == MODBUS_TCP:
            for place in places:
                print(
                    f"motorhil serve: {name}: whoever reaches {place} can move the motors; Modbus "
                    "has no passwords",
                    file=sys.stderr,
                )


def _let_boot(rig: Rig) -> None:
    """Advance the rig's time until its nodes have booted, so that a command finds them.

    Nodes from a recording boot when they did there.
    """
    missing = {
        (one.bus, 0x700 + one.node_id)
        for one in rig.description.controllers.values()
        if one.bus in rig.world.bus_names() and one.node_id is not None and one.kind != RECORDED
    }

    def heard(bus: str, now_ns: int, sender: str, frame: bytes) -> None:
        missing.discard((bus, int.from_bytes(frame[:4], "little")))

    queue = rig.world.queue
    end_ns = queue.now_ns + _BOOT_NS
    rig.world.tap_frames(heard)
    try:
        while missing:
            due_ns = queue.next_time_ns()
            if due_ns is None or due_ns > end_ns:
                break
            queue.run_next()
    finally:
        rig.world.untap_frames(heard)


def _report_unanswered(rig: Rig) -> int:
    """Print what recorded controllers could not answer; return 0 if they answered everything."""
    for line in summary(rig):
        print(f"motorhil serve: {line}", file=sys.stderr)
    return FAILED if unanswered(rig) else PASSED


def _require_endpoint(rig: Rig, options: argparse.Namespace) -> None:
    """Raise RigError if nothing would be served."""
    if rig.world.bus_names() or options.modbus_tcp or options.modbus_rtu or options.serial:
        return
    if rig.world.line_names():
        raise RigError(
            options.rig,
            "the rig has lines and no CAN bus, and no address to serve them is given",
            "say --modbus-tcp 127.0.0.1:5020, --modbus-rtu LINK, or --serial LINK",
        )
    raise RigError(
        options.rig,
        "the rig has no bus, so there is nothing to serve",
        "motorhil run opens a prompt with its motors",
    )


def _environment(
    endpoints: dict[str, tuple[str, str]], lines: dict[str, list[str]]
) -> dict[str, str]:
    """Return environment variables that tell a command where buses and lines are."""
    variables: dict[str, str] = {}
    if endpoints:
        variables["CAN_INTERFACE"], variables["CAN_CHANNEL"] = next(iter(endpoints.values()))
    places = {bus: channel for bus, (_, channel) in endpoints.items()}
    places |= {line: where[0] for line, where in lines.items()}
    for name, place in places.items():
        variables[f"MOTORHIL_CHANNEL_{name.upper().replace('-', '_')}"] = place
    return variables


def _open_buses(
    rig: Rig, loop: WallLoop, options: argparse.Namespace, cleanup: ExitStack
) -> dict[str, tuple[str, str]]:
    """Open each bus and return its python-can name: bus -> (interface, channel)."""
    names = rig.world.bus_names()
    endpoints: dict[str, tuple[str, str]] = {}
    if not names and not options.on and options.socket is None:
        return endpoints
    if not names:
        raise RigError(options.rig, "the rig has no CAN bus for --on and --socket", "omit them")
    for text in options.on:
        bus, _, interface = text.rpartition("=")
        bus = bus or names[0]
        if not interface:
            raise SocketCanError(f"--on {text}: names no interface; write --on {bus}=vcan0")
        if bus not in names:
            known = ", ".join(names)
            raise SocketCanError(f"--on {text}: the rig has no bus {bus!r}; it has {known}")
        loop.add(SocketCanGateway(interface, rig.world, bus))
        endpoints[bus] = ("socketcan", interface)
    path = options.socket
    if path is None and not options.on:
        folder = cleanup.enter_context(tempfile.TemporaryDirectory(prefix="motorhil-"))
        path = Path(folder) / "hub"
    if path is not None:
        loop.add(HubServer(path, rig.world))
        for bus in names:
            channel = str(path.absolute()) + ("" if bus == names[0] else f"#{bus}")
            endpoints.setdefault(bus, ("emulated", channel))
    return endpoints


def _record_locks(rig: Rig, endpoints: dict[str, tuple[str, str]], cleanup: ExitStack) -> None:
    """Record the owners of motors on SocketCAN too, if there is a recording."""
    interfaces = {bus: channel for bus, (kind, channel) in endpoints.items() if kind == "socketcan"}
    if rig.recording is not None and interfaces:
        writer = LockWriter(rig.recording, rig.world)
        looks = LockLooks(writer, rig.world, rig.description, interfaces)
        cleanup.callback(looks.look)  # covers what the command did after the last poll


def _open_lines(rig: Rig, loop: WallLoop, options: argparse.Namespace) -> dict[str, list[str]]:
    """Open the requested endpoints and return them: bus -> HOST:PORT or LINK, one per request.

    Raises:
        RigError: the rig has no such line.
        ModbusSocketError, ModbusPtyError: an address or link cannot be used.
    """
    endpoints: dict[str, list[str]] = {}
    for text in options.modbus_tcp:
        bus, host, port = _tcp_address(rig, text)
        endpoint = ModbusSocket(host, port, rig.world, bus, any_address=options.any_address)
        loop.add(endpoint)
        endpoints.setdefault(bus, []).append(str(endpoint))
    terminals = [(text, "--modbus-rtu", MODBUS_RTU) for text in options.modbus_rtu]
    terminals += [(text, "--serial", SERIAL) for text in options.serial]
    for text, option, kind in terminals:
        bus, link = _bus_and_place(rig, text, option, kind)
        pty = ModbusPty(Path(link), rig.world, bus)
        loop.add(pty)
        endpoints.setdefault(bus, []).append(str(pty.link.absolute()))
    return endpoints


def _line_texts(rig: Rig, endpoints: dict[str, list[str]]) -> Iterable[str]:
    """Return one line of text per endpoint."""
    for name, places in endpoints.items():
        bus = rig.description.buses[name]
        units = [
            str(one.node_id)
            for one in rig.description.controllers.values()
            if one.bus == name and one.node_id is not None
        ]
        served = f"units {', '.join(units)}" if units else "no units"
        for place in places:
            yield f"{name}: {_protocol(bus)} at {place}, {served}"


def _protocol(bus: BusDescription) -> str:
    if bus.kind == MODBUS_TCP:
        return "Modbus/TCP"
    name = "Modbus RTU" if bus.kind == MODBUS_RTU else "serial line"
    return f"{name} (as at {bus.bitrate_bit_s} bit/s 8{bus.parity}{bus.stop_bits})"


def _tcp_address(rig: Rig, text: str) -> tuple[str, str, int]:
    bus, place = _bus_and_place(rig, text, "--modbus-tcp", MODBUS_TCP)
    end = host_and_port(place)
    if end is None:
        raise ModbusSocketError(f"--modbus-tcp {text}: no HOST:PORT; usual: 127.0.0.1:5020")
    return bus, *end


def _bus_and_place(rig: Rig, text: str, option: str, kind: str) -> tuple[str, str]:
    """Split an option's text into bus and place; the default is the first fitting bus."""
    buses = rig.description.buses
    fitting = [bus.name for bus in buses.values() if bus.kind == kind]
    name, _, place = text.rpartition("=")
    if not name:
        if not fitting:
            raise RigError(rig.description.source.path, *_no_bus(kind, option))
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


def _no_bus(kind: str, option: str) -> tuple[str, str]:
    return (
        f"the rig has no bus of kind {kind}, which {option} serves",
        f'write [bus.NAME] with kind = "{kind}"',
    )


@final
class _Service:
    """The event loop, until a signal or the end of the command."""

    def __init__(self, loop: WallLoop, signals: StopSignals) -> None:
        self._loop = loop
        self._signals = signals

    def _is_stopped(self) -> bool:
        return self._signals.number is not None

    def run_until_stopped(self) -> None:
        """Run until SIGINT or SIGTERM."""
        self._loop.start()
        self._loop.run(self._is_stopped)

    def run_command(self, command: list[str], environment: dict[str, str]) -> int:
        """Run the command; return its exit status (128 + n if signal n ended it)."""
        try:
            process = subprocess.Popen(command, env={**os.environ, **environment})
        except OSError as error:
            print(f"motorhil serve: {command[0]}: {error.strerror}", file=sys.stderr)
            return _NOT_FOUND
        watch = os.pidfd_open(process.pid)
        try:
            self._loop.wake_on(watch)
            self._loop.start()
            self._loop.run(lambda: self._is_stopped() or bool(select.select([watch], [], [], 0)[0]))
            if process.poll() is None:  # we were asked to stop, so the command is as well
                process.terminate()
                try:
                    process.wait(_GRACE_S)
                except subprocess.TimeoutExpired:
                    process.kill()
            status = process.wait()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            self._loop.forget(watch)
            os.close(watch)
        return 128 - status if status < 0 else status
