"""Two programs that share the buses of a rig, both in this process.

Each has its own connections, hardware objects and locks, as two processes have. A lock tells its
holders apart by their files, and not by their processes. So the motors of the two programs know of
each other only by the bus and by the locks.

Both programs wait in the rig's time. Leases are in that time, too.

A program may be killed. Then no line of it runs any more: its timers and listeners are silent, and
its parties wait until the rig is closed. As the kernel does for a process, its lock files are
closed without a release, and frames that it has queued are still sent.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.python_can.bus import EmulatedBus
from motorhil.harness.python_can.line import EmulatedLine
from motorhil.harness.rig.bus_load import traffic_of
from motorhil.harness.rig.config.faults import HOST
from motorhil.harness.rig.names import Named
from motorhil.harness.rig.plugins import RigPlugins
from motorhil.harness.rig.reading import read_models
from motorhil.harness.rig.rig import Rig
from motorhil.harness.virtual_time.runtime import never
from motorhil.motorapi.bus_context import BusContext
from motorhil.motorapi.locking.directory import VARIABLE
from motorhil.motorapi.locking.process_lock import abandon_locks, close_spare_files
from motorhil.motorapi.synchronization.bus_load import declare_traffic

if TYPE_CHECKING:
    import can

    from motorhil.harness.virtual_time.runtime import VirtualRuntime
    from motorhil.motorapi import Motor
    from motorhil.motorapi.runtime.api import FrameListener, Party, Registration

Link = EmulatedBus | EmulatedLine
_PORTS: Final = (HOST, f"{HOST}-2")
"""The names of the programs' ports on a bus, in the order of opening."""


@final
class ProgramRuntime:
    """The Runtime of one program: the rig's, whose time other programs share.

    Attributes:
        context: the state that this program keeps for motors without a bus.
        is_dead: True once the program was killed.
    """

    def __init__(self, runtime: "VirtualRuntime") -> None:
        self.context: Final = BusContext()
        self.is_dead: bool = False
        self._runtime: Final = runtime

    def die(self) -> None:
        """End the program at this instant, as `kill -9` does."""
        self.is_dead = True
        abandon_locks(self)

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._runtime.now_ns()

    def wait_until(self, done: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait as `VirtualRuntime.wait_until`."""
        result = self._runtime.wait_until(lambda: self.is_dead or done(), timeout_s)
        if self.is_dead:
            party = self._runtime.party_of_thread()
            if party is not None:
                party.joined = True  # its error, when the rig is closed, would be that of a corpse
            self._runtime.wait_until(never)
        return result

    def watching_processes(self) -> AbstractContextManager[None]:
        """Return a context for waits: they look again after each turn of a party in any case."""
        return nullcontext()

    def is_in_callback(self) -> bool:
        """Return True inside a callback or a condition of a wait."""
        return self._runtime.is_in_callback()

    def every(self, period_s: float, action: Callable[[], None]) -> "Registration":
        """Run `action` every `period_s` [s]."""
        return self._runtime.every(period_s, lambda: None if self.is_dead else action())

    def spawn(self, name: str, function: Callable[[], None]) -> "Party":
        """Run `function` as a further party."""
        return self._runtime.spawn(name, function)

    def listen(
        self, bus: "can.BusABC", on_frame: "FrameListener", *, fd: bool = False
    ) -> "Registration":
        """Call `on_frame` for every frame on `bus`."""

        def hear(frame: bytes, time_ns: int, transmitted: bool) -> None:
            if not self.is_dead:
                on_frame(frame, time_ns, transmitted)

        return self._runtime.listen(bus, hear, fd=fd)

    def send(self, bus: "can.BusABC", frame: bytes) -> None:
        """Queue a frame on `bus`."""
        if not self.is_dead:
            self._runtime.send(bus, frame)


@final
class Programs:
    """The motors of a rig, some of them in a second program.

    Args:
        rig: the open rig; its own motors must not be used beside these.
        is_second: returns True for the name of a motor of the second program.

    Attributes:
        motors: by name, each created on first use.
    """

    def __init__(self, rig: Rig, is_second: Callable[[str], bool]) -> None:
        self._rig: Final = rig
        self._is_second: Final = is_second
        self._plugins: Final = RigPlugins(rig.description)
        self._models: Final = read_models(rig.description)
        self._runtimes: Final = tuple(ProgramRuntime(rig.runtime) for _ in _PORTS)
        self._links: Final[dict[tuple[bool, str], Link]] = {}
        with ExitStack() as cleanup:
            folder = Path(cleanup.enter_context(TemporaryDirectory()))
            cleanup.enter_context(_locks_in(folder))
            self._places: Final = _names_of_one_file(folder)
            self._cleanup = cleanup.pop_all()
        self.motors: Mapping[str, Motor] = Named("motor", rig.description.motors, self._motor)

    def close(self) -> None:
        """Close the motors and connections of both programs."""
        self._cleanup.close()

    def kill(self, motor: str) -> None:
        """Kill the program of this motor."""
        self._runtimes[self._is_second(motor)].die()

    def port(self, motor: str) -> str:
        """Return the name of the port by which the program of this motor sends."""
        return _PORTS[self._is_second(motor)]

    @property
    def runtime(self) -> ProgramRuntime:
        """The runtime of the first program."""
        return self._runtimes[0]

    def link(self, bus: str, motor: str = "") -> Link:
        """Return the connection to a bus or line of this motor's program; "": of the first one."""
        return self._link(self._is_second(motor), bus)

    def _motor(self, name: str) -> "Motor":
        second = self._is_second(name)
        described = self._rig.description.motors[name].controller
        core = None if described is None else self._rig.world.controller(described)
        runtime = self._runtimes[second]
        built, close, _ = self._plugins.motor(
            *(name, self._models[name], runtime),
            lambda bus: self._link(second, bus),
            core,
        )
        self._cleanup.callback(lambda: None if runtime.is_dead else close())
        return built

    def _link(self, second: bool, bus: str) -> Link:
        """Return a program's connection to a bus; the first program opens its own first."""
        if second:
            self._link(False, bus)
        if (second, bus) not in self._links:
            self._links[second, bus] = self._opened(str(self._places[second]), bus, second)
        return self._links[second, bus]

    def _opened(self, place: str, name: str, second: bool) -> Link:
        rig = self._rig
        described = rig.description.buses[name]
        if described.is_line:
            line = EmulatedLine(rig.world, name, self._runtimes[second], place)
            self._cleanup.callback(line.close)
            return line
        is_fd = described.data_bitrate_bit_s is not None
        bus = EmulatedBus(name, fd=is_fd, shared_at=place)
        self._cleanup.callback(bus.shutdown)
        declare_traffic(bus, traffic_of(rig.description, name))
        return bus


def _names_of_one_file(folder: Path) -> tuple[Path, Path]:
    """Return two names of one file, which stands for the socket of a hub.

    Locks know a hub by its file, and so are shared. A program knows its own bus by the name.
    """
    first, second = folder / "first", folder / "second"
    first.touch()
    os.link(first, second)
    return first, second


@contextmanager
def _locks_in(folder: Path) -> Iterator[None]:
    """Use this folder for locks within the block."""
    before = os.environ.get(VARIABLE)
    locks = folder / "locks"
    locks.mkdir(mode=0o700)
    os.environ[VARIABLE] = str(locks)
    try:
        yield
    finally:
        close_spare_files(locks)
        if before is None:
            del os.environ[VARIABLE]
        else:
            os.environ[VARIABLE] = before
