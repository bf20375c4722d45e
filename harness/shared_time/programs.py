"""The programs of a rig: started, given turns, watched and ended, each in a process of its own.

Output is printed line by line, with the program's name before it, in the order of the turns. Python
programs join before their first line; binaries by a preloaded library, at their first wait. Others
join by `motorhil.join()`, or by the protocol of `motorhil.harness.shared_time.records`.
"""

import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.rig.config.buses import MODBUS_TCP
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.lines import serial_line
from motorhil.harness.shared_time.binaries import BinaryError, preload
from motorhil.harness.shared_time.shared_clock import (
    RIG_VARIABLE,
    SITE,
    VARIABLE,
    JoinError,
    SharedClock,
)
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import VARIABLE as LOCK_VARIABLE

if TYPE_CHECKING:
    from motorhil.harness.rig.config.buses import BusDescription
    from motorhil.harness.rig.config.programs import ProgramDescription
    from motorhil.harness.rig.rig import Rig

_LINES_VARIABLE: Final = "MOTORHIL_LINES"  # of programs that are not Python: see _lines_text
_GRACE_S: Final = 5.0
_CHUNK: Final = 65_536
_CHUNKS: Final = 4  # of output at once
_LINE_MAX: Final = 1 << 20  # bytes without a line feed
_LOOK_S: Final = 0.1
_ENDED_S: Final = 0.001  # from the end of its output to that of a program


@final
class _Process:
    """A running program.

    Attributes:
        description: its table in the rig.
        process: itself.
    """

    def __init__(
        self,
        description: "ProgramDescription",
        environment: Mapping[str, str],
        folder: Path,
        tell: Callable[[str], None],
    ) -> None:
        self.description: Final[ProgramDescription] = description
        self._tell: Final[Callable[[str], None]] = tell
        self._line = b""
        command = list(description.command)
        if command[0] in ("python", "python3"):
            command[0] = sys.executable
        self.process: Final = subprocess.Popen(
            command,
            cwd=folder,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        assert self.process.stdout is not None
        self.fd: Final[int] = self.process.stdout.fileno()
        os.set_blocking(self.fd, False)

    def drain(self) -> bool:
        """Print the lines of output that are there; return False at the end of the output.

        A pipe holds no more than it reads at once, so that endless output holds nobody up.
        """
        for _ in range(_CHUNKS):
            try:
                read = os.read(self.fd, _CHUNK)
            except BlockingIOError:
                return True
            *lines, self._line = (self._line + read).split(b"\n")
            if self._line and (not read or len(self._line) > _LINE_MAX):
                lines, self._line = [*lines, self._line], b""
            for line in lines:
                text = line.decode("utf-8", "replace").rstrip("\r")
                self._tell(f"{self.description.name}: {text}")
            if not read:
                return False
        return True

    def end(self) -> None:
        """Kill it and its children."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)

    def close(self) -> None:
        """End it, if it still runs, and its output."""
        if self.process.poll() is None:
            self.end()
            self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def await_end(self) -> None:
        """Wait until its locks and files are free, which is just after its connection has ended."""
        _await_ends([self], time.monotonic() + _GRACE_S)

    def status(self) -> int:
        """Return its exit status, after the last of its output; kill it if it still runs."""
        if self.process.poll() is None:
            self.end()
        status = self.process.wait()
        self.drain()
        return status


def _await_ends(processes: Iterable[_Process], until_s: float) -> None:
    """Wait for their ends, and print their output meanwhile, or a full pipe would prevent them."""
    writing = {one.fd: one for one in processes}
    running = list(writing.values())
    while running and time.monotonic() < until_s:
        for fd in select.select(list(writing), [], [], _LOOK_S if writing else _ENDED_S)[0]:
            if not writing[fd].drain():
                del writing[fd]
        running = [one for one in running if one.process.poll() is None]


def run_programs(rig: "Rig", tell: Callable[[str], None]) -> dict[str, str]:
    """Start the rig's programs and let virtual time pass until all of them have ended.

    Args:
        rig: the open rig, at time 0.
        tell: called with each line of output and each notice.

    Returns:
        What was wrong with each program, by name; empty if all ended as they should.

    Raises:
        RigError: a program cannot be started, or does not join; all are ended.
    """
    with _started(rig, tell) as (processes, clock):
        joining = [one.name for one in rig.description.programs.values() if one.joins]
        if not joining:
            raise rig.description.error(
                ("program",), "none of the programs joins the rig", "take joins = false out of one"
            )
        try:
            clock.await_programs(joining, lambda name: processes[name].process.poll() is None)
        except JoinError as error:
            for one in processes.values():
                one.drain()
            raise RigError(rig.description.source.path, str(error)) from None
        _schedule_kills(rig, processes)
        try:
            rig.runtime.wait_for_parties(clock.are_gone)
        except KeyboardInterrupt:
            rig.runtime.wait_for_parties(clock.are_gone)  # each has had it in its wait
            raise
        except UsageError:  # all wait for one another: each program tells it, and ends
            rig.runtime.wait_for_parties(clock.are_gone)
        rig.send_queued()
        for one in processes.values():
            if not one.description.joins:
                one.end()
        _await_ends(processes.values(), time.monotonic() + _GRACE_S)
        wrong: dict[str, str] = {}
        killed = [name for name, _ in rig.description.world.kills]
        for name, one in processes.items():
            status = one.status()
            reason = _failure(one, status, clock.left.get(name, ""))
            if reason and not (status == -signal.SIGKILL and name in killed):
                wrong[name] = reason
        return wrong


def _schedule_kills(rig: "Rig", processes: Mapping[str, _Process]) -> None:
    """Kill programs when the rig's world says so; each has left when time goes on."""
    for name, at_ns in rig.description.world.kills:

        def kill(now_ns: int, one: _Process = processes[name]) -> None:
            one.end()
            one.await_end()

        rig.runtime.queue.alarm(kill).set(at_ns)


def _failure(one: _Process, status: int, reason: str) -> str:
    """Return what was wrong with the end of a program, or ""."""
    if not one.description.joins or one.description.may_leave:
        return ""
    if status < 0:
        return f"ended by {signal.Signals(-status).name}"
    if status:
        return f"exit status {status}"
    return reason


@contextmanager
def _started(
    rig: "Rig", tell: Callable[[str], None]
) -> Iterator[tuple[dict[str, _Process], SharedClock]]:
    description = rig.description
    processes: dict[str, _Process] = {}
    with tempfile.TemporaryDirectory(prefix="motorhil-run-") as folder:
        (Path(folder) / "locks").mkdir(mode=0o700)

        def notice(name: str, level: str, text: str) -> None:
            tell(f"program {name}: {text}")
            rig.world.report(rig.runtime.now_ns(), level, name, text)

        clock = SharedClock(
            rig.world,
            rig.runtime,
            Path(folder) / "clock",
            seed=rig.seed,
            tell=notice,
            stalls_s={name: one.stall_s for name, one in description.programs.items()},
            end=lambda name: processes[name].end(),
            await_end=lambda name: processes[name].await_end(),
        )
        try:
            preloads = _preloads(rig)
            for program in description.programs.values():
                processes[program.name] = _start(
                    rig, program, clock, Path(folder), preloads[program.name], tell
                )
                clock.watch(processes[program.name].fd, processes[program.name].drain)
            yield processes, clock
        finally:
            for one in processes.values():
                one.close()
            clock.close()


def _preloads(rig: "Rig") -> dict[str, str]:
    """Return LD_PRELOAD of each program, before the first one is started; "" for none."""
    description = rig.description
    folder = description.source.path.resolve().parent
    found: dict[str, str] = {}
    for program in description.programs.values():
        try:
            word = program.command[0]
            found[program.name] = preload(word, folder, os.environ) if program.joins else ""
        except BinaryError as error:
            raise description.error(
                ("program", program.name, "command"), error.problem, error.remedy
            ) from None
    return found


def _lines_text(buses: "Iterable[BusDescription]") -> str:
    """Return the lines among the buses for the preloaded library, one in a row of text.

    The fields are name, address, bit rate, bits of a character, their format, and t3.5 [ns].
    """
    rows: list[str] = []
    for bus in buses:
        if bus.kind == MODBUS_TCP:
            rows.append(f"{bus.name}\t{bus.address}\t0\t0\t-\t0")
        elif bus.is_line:
            wires, form = serial_line(bus), f"8{bus.parity}{bus.stop_bits}"
            fields = (bus.name, bus.address, bus.bitrate_bit_s, wires.bits, form, wires.t35_ns)
            rows.append("\t".join(map(str, fields)))
    return "\n".join(rows)


def _start(
    rig: "Rig",
    program: "ProgramDescription",
    clock: SharedClock,
    folder: Path,
    preloaded: str,
    tell: Callable[[str], None],
) -> _Process:
    source = rig.description.source.path.resolve()
    path = f"{SITE}{os.pathsep}{os.environ.get('PYTHONPATH', '')}".rstrip(os.pathsep)
    environment = {
        **os.environ,
        "PYTHONPATH": path,
        "PYTHONUNBUFFERED": "1",
        LOCK_VARIABLE: str(folder / "locks"),
        RIG_VARIABLE: str(source),
    }
    if program.joins:
        environment[VARIABLE] = f"{clock.path}#{program.name}"
        if preloaded:
            environment["LD_PRELOAD"] = preloaded
            environment[_LINES_VARIABLE] = _lines_text(rig.description.buses.values())
    word = program.command[0]
    try:
        return _Process(program, environment, source.parent, tell)
    except OSError as error:
        known = shutil.which(word) is not None
        remedy = "make it executable" if known else "name an installed program, or its path"
        raise rig.description.error(
            ("program", program.name, "command"),
            f'"{word}" cannot be started: {error.strerror or error}',
            remedy,
        ) from None
