"""Rig of a program that runs in another process than the rig.

with motorhil.join() as rig:
wheel = rig.motors["left"]
wheel.enable()
rig.runtime.run_for(1.0)
"""

import json
import os
import socket
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.harness.python_can.bus import EmulatedBus, close_rig, open_rig
from motorhil.harness.python_can.line import EmulatedLine
from motorhil.harness.rig.bus_load import traffic_of
from motorhil.harness.rig.names import Named
from motorhil.harness.rig.plugins import RigPlugins
from motorhil.harness.rig.reading import describe, read_models
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.remote_runtime import RemoteLink, RemoteRuntime
from motorhil.harness.shared_time.remote_world import RemoteWorld
from motorhil.harness.shared_time.shared_clock import (
    JOIN_S,
    OF_CHILDREN,
    RIG_VARIABLE,
    SITE,
    VARIABLE,
)
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.synchronization.bus_load import declare_traffic

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import RigDescription
    from motorhil.motorapi.group import MotorGroup
    from motorhil.motorapi.motor import Motor


@final
class _Children:
    """The clock for the children of a program: that of its rig, with names from the program's."""

    def __init__(self, name: str, link: RemoteLink, runtime: RemoteRuntime, place: str, rig: Path):
        self._name = name
        self._link = link
        self._runtime = runtime
        self._place = place
        self._rig = rig
        self._count = 0

    def invite(self, environment: Mapping[str, str]) -> dict[str, str]:
        """Return this environment with what the next child needs to join."""
        if self._runtime.is_in_callback():
            raise UsageError(
                f"program {self._name}: starts a child in a callback; expected a turn of the"
                " program; start it from a thread"
            )
        self._count += 1
        path = f"{SITE}{os.pathsep}{environment.get('PYTHONPATH', '')}".rstrip(os.pathsep)
        return {
            **environment,
            "PYTHONPATH": path,
            "PYTHONUNBUFFERED": "1",
            VARIABLE: f"{self._place}{OF_CHILDREN}#{self._name}/{self._count}",
            RIG_VARIABLE: str(self._rig),
        }

    def admit(self, pid: int) -> str:
        """Wait until that child has joined; return "", or why it has not."""
        head = records.COUNTED.pack(records.CHILD, pid)
        self._link.send(head + f"{self._name}/{self._count}".encode())
        return records.text_of(self._link.receive(), 1)

    def has_relatives(self) -> bool:
        """Return whether a child has joined, or this program is one."""
        return self._count > 0 or "/" in self._name

    def watching(self) -> AbstractContextManager[None]:
        """Let waits of this party look again after each turn of another process."""
        return self._runtime.watching_processes()


@final
class RemoteRig:
    """The part of a rig that its programs have: time, buses and motors, no controllers.

    Attributes (read only):
        name: the program's name in the rig.
        seed: the seed of the run.
        description: the contents of the rig file.
        runtime: where the program waits, and so lets time pass.
        motors, groups: by name, in the order of the file, created on first use.
        children: where Python programs that this one starts join.
    """

    def __init__(self, name: str, path: Path, connection: socket.socket, shared_at: str) -> None:
        self.name: Final[str] = name
        self.description: Final[RigDescription] = describe(path)
        link = RemoteLink(connection)
        link.send(records.numbered(records.JOIN, records.VERSION, name))
        connection.settimeout(2.0 * JOIN_S)
        record = link.receive()
        connection.settimeout(None)
        if record[0] != records.WELCOME:
            raise UsageError(f"program {name!r}: refused by the rig: {record[1:].decode()}")
        _, _, now_ns, seed = records.WELCOMED.unpack_from(record)
        buses: dict[str, int | None] = json.loads(record[records.WELCOMED.size :])
        self.seed: Final[int] = seed
        self.runtime: Final[RemoteRuntime] = RemoteRuntime(link, now_ns)
        self.children: Final = _Children(name, link, self.runtime, shared_at, path)
        self._cleanup = ExitStack()
        self._cleanup.callback(link.close)
        self._cleanup.callback(self.runtime.close)
        lines = {name: bus for name, bus in self.description.buses.items() if bus.is_line}
        world = self._world = RemoteWorld(buses, lines, link, self.runtime)
        open_rig(world, self.runtime, shared_at)
        self._cleanup.callback(close_rig, world)
        self._plugins: Final[RigPlugins] = RigPlugins(self.description)
        self._models: Final = read_models(self.description)
        self._buses: Final = Named("bus", buses, self._bus)
        self._shared_at: Final = shared_at
        self._lines: Final = Named("line", lines, self.open_line)
        self.motors: Mapping[str, Motor] = Named("motor", self.description.motors, self._motor)
        self.groups: Mapping[str, MotorGroup] = Named("group", self.description.groups, self._group)
        self.runtime.begin()

    def bus(self, name: str) -> EmulatedBus:
        """Return this program's connection to a bus, a python-can bus.

        Raises:
            KeyError: the rig has no such bus.
        """
        return self._buses[name]

    def line(self, name: str) -> EmulatedLine:
        """Return this program's port on a line.

        Raises:
            KeyError: the rig has no such line.
        """
        return self._lines[name]

    def open_line(self, name: str) -> EmulatedLine:
        """Return a new port on a line, which the caller closes."""
        return EmulatedLine(self._world, name, self.runtime, self._shared_at)

    def close(self) -> None:
        """Close motors and buses, and leave the rig."""
        self._cleanup.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _bus(self, name: str) -> EmulatedBus:
        bus = EmulatedBus(name, fd=self.description.buses[name].data_bitrate_bit_s is not None)
        self._cleanup.callback(bus.shutdown)
        declare_traffic(bus, traffic_of(self.description, name))
        return bus

    def _motor(self, name: str) -> "Motor":
        built, close, _ = self._plugins.motor(name, self._models[name], self.runtime, self._link)
        self._cleanup.callback(close)
        return built

    def _link(self, bus: str) -> EmulatedBus | EmulatedLine:
        return self.line(bus) if self.description.buses[bus].is_line else self.bus(bus)

    def _group(self, name: str) -> "MotorGroup":
        from motorhil.motorapi.group import MotorGroup

        group = MotorGroup()
        for motor in self.description.groups[name].motors:
            group.append(self.motors[motor])
        return group


_joined: list[RemoteRig] = []


def join() -> RemoteRig:
    """Join the rig that has started this program, and return it; a second call returns the same.

    The program becomes a party of the rig's virtual time. Python programs that `motorhil run RIG`
    has started have joined already.

    Raises:
        UsageError: this program was not started by a rig, or the rig refuses it.
    """
    if _joined:
        return _joined[0]
    channel, rig = (os.environ.get(name, "") for name in (VARIABLE, RIG_VARIABLE))
    path, _, name = channel.rpartition("#")
    if not path:
        raise UsageError(
            f"{VARIABLE}: not set; expected the shared clock of a rig; start the program by"
            " [program.NAME] of a rig, with 'motorhil run RIG'"
        )
    del os.environ[VARIABLE]  # a child is another program
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connection.connect(path)
    except OSError as error:
        connection.close()
        raise UsageError(f"{path}: cannot join the rig: {error.strerror or error}") from None
    _joined.append(RemoteRig(name, Path(rig), connection, path.removesuffix(OF_CHILDREN)))
    return _joined[0]
