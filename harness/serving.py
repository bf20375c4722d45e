"""`motorhil serve`: a rig in real time for other processes.

CAN buses are served on a socket or on SocketCAN, Modbus lines on TCP or on pseudo-terminals.
"""

import argparse
import os
import select
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Final, final

from emulators.hub import HubError, HubServer
from emulators.serve import WallLoop
from emulators.socketcan import SocketCanError, SocketCanGateway
from harness import modbus_doors
from harness.exit_status import FAILED, PASSED, WRONG_USAGE
from harness.lock_looks import LockLooks
from harness.ownership_tap import LockWriter
from harness.replay.verdict import summary, unanswered
from harness.rig import Rig
from harness.seed_option import add_seed
from harness.settings import RigError
from harness.wall_programs import StopSignals

_NOT_FOUND: Final = 127
_GRACE_S: Final = 3.0


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
    modbus_doors.add_arguments(parser)
    add_seed(parser)
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
        rig = cleanup.enter_context(Rig.open(options.rig, seed=options.seed, record=options.output))
        _refuse_nothing(rig, options)
        loop = WallLoop(rig.world.queue)
        cleanup.callback(loop.close)
        try:
            lines = modbus_doors.open_doors(rig, loop, options)
            doors = _open_doors(rig, loop, options, cleanup)
        except (HubError, SocketCanError, *modbus_doors.ModbusDoorError) as error:
            print(f"motorhil serve: {error}", file=sys.stderr)
            return WRONG_USAGE
        _look_at_locks(rig, doors, cleanup)
        service = _Service(loop, cleanup.enter_context(StopSignals(loop)))
        if options.rest:
            status = service.run_command(options.rest, _environment(doors, lines))
            verdict = _stood_in(rig)
            return status or verdict
        print(f"serving {rig.description.name}; Ctrl-C stops", file=sys.stderr)
        for bus, (interface, channel) in doors.items():
            print(f"{bus}: can.Bus(interface={interface!r}, channel={channel!r})", flush=True)
        for text in modbus_doors.described(rig, lines):
            print(text, flush=True)
        service.run_until_stopped()
        print(
            f"stopped; an event was at most {loop.late_ns_max / 1e6:.1f} ms late", file=sys.stderr
        )
        return _stood_in(rig)


def _stood_in(rig: Rig) -> int:
    """Print what recorded controllers could not answer; return 0 if they answered everything."""
    for line in summary(rig):
        print(f"motorhil serve: {line}", file=sys.stderr)
    return FAILED if unanswered(rig) else PASSED


def _refuse_nothing(rig: Rig, options: argparse.Namespace) -> None:
    """Raise RigError if nothing would be served."""
    if rig.world.bus_names() or options.modbus_tcp or options.modbus_rtu:
        return
    if rig.world.line_names():
        raise RigError(
            options.rig,
            "the rig has lines and no CAN bus, and no address to serve them is given",
            "say --modbus-tcp 127.0.0.1:5020, or --modbus-rtu LINK",
        )
    raise RigError(
        options.rig,
        "the rig has no bus, so there is nothing to serve",
        "motorhil run opens a prompt with its motors",
    )


def _environment(doors: dict[str, tuple[str, str]], lines: dict[str, list[str]]) -> dict[str, str]:
    """Return environment variables that tell a command where buses and lines are."""
    told: dict[str, str] = {}
    if doors:
        told["CAN_INTERFACE"], told["CAN_CHANNEL"] = next(iter(doors.values()))
    places = {bus: channel for bus, (_, channel) in doors.items()}
    places |= {line: where[0] for line, where in lines.items()}
    for name, place in places.items():
        told[f"MOTORHIL_CHANNEL_{name.upper().replace('-', '_')}"] = place
    return told


def _open_doors(
    rig: Rig, loop: WallLoop, options: argparse.Namespace, cleanup: ExitStack
) -> dict[str, tuple[str, str]]:
    """Open each bus and return its python-can name: bus -> (interface, channel)."""
    names = rig.world.bus_names()
    doors: dict[str, tuple[str, str]] = {}
    if not names and not options.on and options.socket is None:
        return doors
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
        doors[bus] = ("socketcan", interface)
    path = options.socket
    if path is None and not options.on:
        folder = cleanup.enter_context(tempfile.TemporaryDirectory(prefix="motorhil-"))
        path = Path(folder) / "hub"
    if path is not None:
        loop.add(HubServer(path, rig.world))
        for bus in names:
            channel = str(path.absolute()) + ("" if bus == names[0] else f"#{bus}")
            doors.setdefault(bus, ("emulated", channel))
    return doors


def _look_at_locks(rig: Rig, doors: dict[str, tuple[str, str]], cleanup: ExitStack) -> None:
    """Record the owners of motors on SocketCAN too, if there is a recording."""
    interfaces = {bus: channel for bus, (kind, channel) in doors.items() if kind == "socketcan"}
    if rig.recording is not None and interfaces:
        writer = LockWriter(rig.recording, rig.world)
        looks = LockLooks(writer, rig.world, rig.description, interfaces)
        cleanup.callback(looks.look)  # covers what the command did after the last poll


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
