"""Shared clock: the rig's virtual time for programs in other processes.

Programs connect to a UNIX socket and join by name. All have joined before time 0, and take their
turns in the order of the rig file, whoever connected first. Then each is a party of the rig, as a
thread of this process would be, so that both make the same record.

Only here a wall clock is read: to end the wait for a program that does not join, and to tell of one
that keeps the turn.
"""

import contextlib
import json
import os
import re
import select
import signal
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.participant import Participant

if TYPE_CHECKING:
    from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
    from motorhil.emulators.simulation.world import World
    from motorhil.harness.virtual_time.runtime import VirtualRuntime

VARIABLE: Final = "MOTORHIL_CLOCK"
"""Environment variable of programs: PATH#NAME, the clock's socket and the program's name."""
RIG_VARIABLE: Final = "MOTORHIL_RIG"
"""Environment variable of programs: the rig file."""
SITE: Final = Path(__file__).parent / "site"
"""Folder on the PYTHONPATH of Python programs: they join before their first line."""
OF_CHILDREN: Final = "-children"
"""Appended to the clock's path: the socket that children join; the other is for the start."""
JOIN_S: Final = 10.0
_LOOK_S: Final = 0.1
_GRACE_S: Final = 5.0
_WAITS_TOLD: Final = 8
_CHILDREN_MAX: Final = 256
_LATE_MAX: Final = 1_024  # records; the buffer of a connection holds fewer
_PATIENCE: Final = struct.pack("@ll", 0, 10_000)  # s, us; then the outputs of programs are read
_PEER: Final = struct.Struct("3i")  # pid, uid, gid
_PROCESS: Final = re.compile(r"pid (\d+) \([^()]*\)")


@final
class JoinError(Exception):
    """Programs did not join; the message names them."""


@final
class _Child:
    """A process that a program has started, and that has joined.

    Attributes:
        program: the name of the program of the rig from which it descends.
        fd: readable once the process has ended.
    """

    def __init__(self, program: str, fd: int) -> None:
        self.program: Final[str] = program
        self.fd: Final[int] = fd

    def has_ended(self, within_s: float = 0.0) -> bool:
        """Wait up to this time [s] for its end; return whether it has ended."""
        return bool(select.select([self.fd], [], [], within_s)[0])

    def end(self) -> None:
        """Kill it."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.fd, signal.SIGKILL)


@final
class _Turn:
    """The turn that a program has, on the wall clock.

    Records that wait after the limit may be older than a pause of this process, so that some are
    served.

    Attributes:
        is_due: True once the program has kept the turn for too long.
        is_told: True once that was told, and the program killed.
        is_asked: True once it was told because of Ctrl-C.
    """

    def __init__(self) -> None:
        self.is_due: bool = False
        self.is_told: bool = False
        self.is_asked: bool = False
        self._began_s = time.monotonic()
        self._late = 0

    def kept_s(self) -> float:
        """Return for how long the program has had it [s]."""
        return time.monotonic() - self._began_s

    def is_late(self, stall_s: float) -> bool:
        """Look at the clock; return whether the program has kept the turn for too long."""
        return self.kept_s() > stall_s

    def is_over(self, stall_s: float, is_heard: bool) -> bool:
        """Look at the clock; return whether a killed program still keeps the turn."""
        kept_s = self.kept_s()
        if kept_s > stall_s:
            self._late += 1
            self.is_due = self.is_due or not is_heard or self._late > _LATE_MAX
        return self.is_told and kept_s > 2.0 * stall_s


@final
class SharedClock:
    """The socket that programs join, and the programs that have joined.

    Args:
        world: the rig's buses.
        runtime: the rig's time.
        path: of the socket, which is created.
        seed: of the run.
        tell: called with (program, level, sentence) for what happens to programs.
        stalls_s: how long each program may keep the turn, on the wall clock [s].
        end: ends the program of this name, which keeps it longer.
        await_end: waits for the end of the process of this name, whose connection has ended.

    Attributes:
        turns: how many turns programs have had.
        left: the programs that have gone, with the reason; "" for those that left by themselves.
    """

    def __init__(
        self,
        world: "World",
        runtime: "VirtualRuntime",
        path: Path,
        *,
        seed: int,
        tell: Callable[[str, str, str], None],
        stalls_s: Mapping[str, float],
        end: Callable[[str], None],
        await_end: Callable[[str], None],
    ) -> None:
        self.world: Final[World] = world
        self.runtime: Final[VirtualRuntime] = runtime
        self.path: Final[Path] = path
        self.turns: int = 0
        self.left: dict[str, str] = {}
        self._seed: Final[int] = seed
        self._tell: Final[Callable[[str, str, str], None]] = tell
        self._stalls_s: Final[Mapping[str, float]] = stalls_s
        self._end: Final[Callable[[str], None]] = end
        self._await_end: Final[Callable[[str], None]] = await_end
        self._programs: list[Participant] = []
        self._poll: Final[select.poll] = select.poll()  # of outputs
        self._ends: Final[select.poll] = select.poll()  # of connections
        self._outputs: dict[int, Callable[[], bool]] = {}
        self._listener: Final[socket.socket] = _listener(path)
        self._of_children: Final[socket.socket] = _listener(Path(f"{path}{OF_CHILDREN}"))
        self._tokens: dict[tuple[str, int], list[int]] = {}
        self._pids: dict[int, str] = {}
        self._children: dict[str, _Child] = {}
        self._turn = _Turn()

    def watch(self, fd: int, take: Callable[[], bool]) -> None:
        """Call `take` when `fd` is readable, until it returns False."""
        self._outputs[fd] = take
        self._poll.register(fd, select.POLLIN)

    def await_programs(self, names: Sequence[str], is_alive: Callable[[str], bool]) -> None:
        """Wait until all of these programs have joined; then let them wait for their first turns.

        Raises:
            JoinError: one has not joined within 10 s, or has ended; names it.
        """
        joined: dict[str, Participant] = {}
        until_s = time.monotonic() + JOIN_S
        while len(joined) < len(names):
            missing = [name for name in names if name not in joined]
            dead = [name for name in missing if not is_alive(name)]
            if dead or time.monotonic() > until_s:
                self._programs = list(joined.values())
                who = ", ".join(dead or missing)
                why = "ended before it joined" if dead else f"did not join within {JOIN_S:g} s"
                raise JoinError(
                    f"program {who}: {why}; expected one that joins the rig's time: a Python"
                    " program, a binary that waits, or one that calls motorhil.join();"
                    " joins = false lets it run beside"
                )
            found = self._accept(self._listener, missing)
            if found is not None:
                joined[found.name] = found
        self._listener.close()
        self.path.chmod(0o400)  # tells a second process of a program that it is too late
        self._programs = [joined[name] for name in names]
        for program in self._programs:
            self._begin(program)

    def _begin(self, program: Participant) -> None:
        self._ends.register(program.connection, 0)
        program.begin()

    def look_for_deaths(self) -> None:
        """Note the programs that have died while they waited."""
        ended = [fd for fd, _ in self._ends.poll(0)]
        for program in self._programs if ended else ():
            if program.connection.fileno() in ended:
                program.died()

    def _accept(self, listener: socket.socket, missing: Sequence[str]) -> Participant | None:
        door = listener.fileno()
        ready = select.select([door, *self._outputs], [], [], _LOOK_S)[0]
        for one in ready:
            if one != door:
                self._take(one)
        if door not in ready:
            return None
        connection, _ = listener.accept()
        connection.settimeout(JOIN_S)
        try:
            record = connection.recv(records.RECORD_MAX)
        except OSError:
            record = b""
        refusal, name = _refusal(record, missing)
        if refusal:
            with contextlib.suppress(OSError):
                connection.send(bytes([records.REFUSED]) + refusal.encode())
            connection.close()
            return None
        connection.settimeout(None)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _PATIENCE)
        peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        self._pids[_PEER.unpack(peer)[0]] = name
        buses = {bus: self.world.bus(bus).data_bitrate_bit_s for bus in self.world.bus_names()}
        head = records.WELCOMED.pack(
            records.WELCOME, records.VERSION, self.runtime.now_ns(), self._seed
        )
        try:
            connection.send(head + json.dumps(buses).encode())
        except OSError:  # it has ended since; whoever looks after its process tells
            connection.close()
            return None
        return Participant(name, connection, self)

    def admit(self, parent: Participant, pid: int, name: str) -> str:
        """Wait until a child of this program has joined, and let it wait for its first turn.

        Returns:
            Why it has not joined; "" if it has.
        """
        reason = self._admitted(parent, pid, name)
        self._turn = _Turn()  # to start a child takes its parent's time
        return reason

    def _admitted(self, parent: Participant, pid: int, name: str) -> str:
        is_full = len(self._children) == _CHILDREN_MAX
        try:
            child = _Child(parent.name.partition("/")[0], os.pidfd_open(pid))
        except ProcessLookupError:
            return "ended before it joined the rig's time"
        until_s = time.monotonic() + JOIN_S
        while time.monotonic() < until_s:
            found = self._accept(self._of_children, [] if is_full else [name])
            if found is not None:
                self._children[name] = child
                self._programs = [one for one in self._programs if not one.is_gone] + [found]
                self._begin(found)
                return ""
            if child.has_ended():
                os.close(child.fd)
                full = f"was refused: the rig has {_CHILDREN_MAX} children at once; wait for one"
                return full if is_full else "ended before it joined the rig's time"
        os.close(child.fd)
        return f"did not join the rig's time within {JOIN_S:g} s; it runs on the wall clock"

    def are_gone(self) -> bool:
        """Return whether all programs have left."""
        return all(program.is_gone for program in self._programs)

    def receive(self, participant: Participant, is_first: bool) -> bytes:
        """Return the program's next message, b"" if it has gone; end it if it keeps the turn."""
        if is_first:
            self._turn = _Turn()
        if not self._turn.is_late(self._stall_s(participant.name)):
            try:
                return participant.connection.recv(records.RECORD_MAX)
            except BlockingIOError:  # it takes longer than most
                pass
            except OSError:
                return b""
        self._poll.register(participant.connection, select.POLLIN)
        try:
            return self._awaited(participant)
        finally:
            self._poll.unregister(participant.connection)

    def end_turn(self) -> None:
        """Take what programs have printed, before another one prints."""
        for fd, _ in self._poll.poll(0):
            self._take(fd)

    def _awaited(self, participant: Participant) -> bytes:
        connection, turn = participant.connection, self._turn
        stall_s = self._stall_s(participant.name)
        while True:
            ready = [fd for fd, _ in self._poll.poll(1000.0 * _LOOK_S)]
            for fd in ready:
                if fd in self._outputs:
                    self._take(fd)
            is_heard = connection.fileno() in ready
            if turn.is_over(stall_s, is_heard):
                return b""  # it cannot be killed: its connection is closed
            if turn.is_due and not turn.is_told:
                self._end_stalled(participant.name)
            if not turn.is_asked and self.runtime.is_interrupted():
                self._tell_holder(participant.name)
            if is_heard:
                try:
                    return connection.recv(records.RECORD_MAX)
                except OSError:
                    return b""

    def _end_stalled(self, name: str) -> None:
        self._turn.is_told = True
        text = (
            f"has kept the turn for {self._stall_s(name):g} s of wall time, and no virtual time"
            f" passes; expected a wait; it is killed; waiting: {self._waiting()}"
        )
        self._tell(name, "error", text)
        child = self._children.get(name)
        if child is None:
            self._end(name)
        else:
            child.end()

    def _tell_holder(self, name: str) -> None:
        """Tell who has the turn, since Ctrl-C takes effect only at its next wait."""
        self._turn.is_asked = True
        text = (
            f"has had the turn for {self._turn.kept_s():.1f} s of wall time; Ctrl-C takes effect at"
            f" its next wait; press it again to end at once; waiting: {self._waiting()}"
        )
        self._tell(name, "warning", text)

    def _waiting(self) -> str:
        """Return who waits, and until when; of each program its parties."""
        programs = {one.name for one in self._programs if not one.is_gone}
        waits = [
            f"{name} " + ("without a timeout" if end_ns is None else f"until {end_ns / 1e9:g} s")
            for name, end_ns in self.runtime.waits()
            if name.partition("/")[0] in programs
        ]
        more = [f"and {len(waits) - _WAITS_TOLD} more"] if len(waits) > _WAITS_TOLD else []
        return ", ".join(waits[:_WAITS_TOLD] + more) or "nobody"

    def _stall_s(self, name: str) -> float:
        """Return how long a program may keep the turn; a child as long as its program [s]."""
        child = self._children.get(name)
        return self._stalls_s[name if child is None else child.program]

    def _take(self, fd: int) -> None:
        if not self._outputs[fd]():
            del self._outputs[fd]
            self._poll.unregister(fd)

    def repeatable(self, bus: str, notice: "OwnershipNotice", name: str) -> "OwnershipNotice":
        """Return a program's notice with names for process IDs, and tokens counted from 1."""
        known = self._tokens.setdefault((bus, notice.resource), [])
        if notice.token and notice.token not in known:
            known.append(notice.token)
        token = known.index(notice.token) + 1 if notice.token else 0
        holder = _PROCESS.sub(lambda found: self._pids.get(int(found[1]), found[0]), notice.holder)
        return replace(notice, token=token, holder=holder, pid=0, program=name)

    def departed(self, participant: Participant, reason: str) -> None:
        """Close the connection of a program that has gone; wait for the end of its process."""
        self._ends.unregister(participant.connection)
        participant.connection.close()
        self.left[participant.name] = reason
        child = self._children.get(participant.name)
        if child is not None:
            if child.has_ended(_GRACE_S):  # its parent sees its end, and all that it has written
                os.close(self._children.pop(participant.name).fd)
        else:  # its locks are free, also those that it keeps until its end
            self._await_end(participant.name)
        if reason:
            self._tell(participant.name, "warning", f"has left the rig: {reason}")

    def close(self) -> None:
        """Close all connections and remove the socket."""
        for program in self._programs:
            program.connection.close()
        for child in self._children.values():
            child.end()
            os.close(child.fd)
        self._listener.close()
        self._of_children.close()
        self.path.unlink(missing_ok=True)
        Path(f"{self.path}{OF_CHILDREN}").unlink(missing_ok=True)


def _listener(path: Path) -> socket.socket:
    """Return a socket at this path, which only this user can connect to."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    mask = os.umask(0o177)
    try:
        listener.bind(str(path))
    finally:
        os.umask(mask)
    listener.listen()
    return listener


def _refusal(record: bytes, missing: Sequence[str]) -> tuple[str, str]:
    """Return why a JOIN is refused, or "", and the name."""
    if len(record) < records.NUMBERED.size or record[0] != records.JOIN:
        return "expected JOIN", ""
    _, version = records.NUMBERED.unpack_from(record)
    name = records.text_of(record, records.NUMBERED.size)
    if version != records.VERSION:
        return f"protocol {version}: unknown; expected {records.VERSION}", name
    if name not in missing:
        names = ", ".join(missing) or "none, as it has as many as it takes"
        return f"program {name!r}: not awaited; expected one of {names}", name
    return "", name
