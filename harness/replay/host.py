"""Replay of a recorded host against devices, and comparison of their answers.

The player is sans-I/O, and sends a step once everything that the recorded host had waited for has
arrived again. Then the recorded pause is kept after the last of these observations, or after the
host's last frame. An observation that does not arrive within the patience after its time is missed.
The player notes it and continues, as a human operator would. The host's own heartbeat waits for
nothing, and continues while there are steps to send.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, final

from motorhil.emulators.can.frame import FRAME_BYTES
from motorhil.harness.replay.frames import duration_ns, never
from motorhil.harness.replay.verdict import meaning_in
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi.runtime.api import Runtime
from motorhil.traces.can_frame import classic
from motorhil.traces.exchange.host import (
    ANSWER,
    HostStep,
    Listener,
    Subject,
    Told,
    answer_size,
    host_of,
)
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.semantics.diff import (
    Difference,
    ObjectFidelity,
    Tolerance,
    differences,
    fidelity,
    retimed,
    told_by_nodes,
)

if TYPE_CHECKING:
    from motorhil.harness.rig.rig import Rig

PATIENCE_NS: Final = 2_000_000_000
_NEVER_NS: Final = 1 << 62
_RESET_ALL: Final = classic(0, b"\x81\x00")
"""The frame of NMT service "reset node" to all nodes (CiA 301)."""
_TAIL_S: Final = 0.1
"""How long to listen after the end of the recording [s], since devices may be slower now."""
_SDO_REQUEST: Final = 12  # function code of the pre-defined connection set


@final
@dataclass(frozen=True, slots=True)
class Missed:
    """An observation that did not arrive: when it was given up, and the last one heard instead."""

    time_ns: int
    awaited: Told
    step: HostStep
    instead: str


@final
class _Heartbeat:
    """Frames of one identifier that are sent by time alone."""

    def __init__(self, steps: list[HostStep], speed: float) -> None:
        self.steps = steps
        self.sent = 0
        self.due_ns = 0
        self._speed = speed
        last = steps[-1].start_ns - steps[-2].start_ns if len(steps) > 1 else None
        self._period_ns = last

    def start(self, begin_ns: int, now_ns: int) -> None:
        self.due_ns = now_ns + round((self.steps[0].start_ns - begin_ns) / self._speed)

    def take(self) -> HostStep:
        """Return the next frame and schedule its successor, at the end with the last period."""
        place = min(self.sent, len(self.steps) - 1)
        step = self.steps[place]
        self.sent += 1
        if self.sent < len(self.steps):
            pause_ns = self.steps[self.sent].start_ns - step.start_ns
            self.due_ns += round(pause_ns / self._speed)
        elif self._period_ns:
            self.due_ns += round(self._period_ns / self._speed)
        else:
            self.due_ns = _NEVER_NS
        return step


@final
class HostPlayer:
    """Player of one host on all its buses.

    Args:
        steps: the steps of the recording.
        listener: the listener to the live buses.
        begin_ns: the start time of the recording [ns].
        lines: those of the buses that are Modbus lines.
        speed: factor by which pauses are shorter than recorded.
        patience_ns: extra time for each awaited observation, beyond its recorded time [ns].

    Attributes:
        sent: number of frames sent, without heartbeats.
        unsent: number of recorded host frames that cannot be sent (CAN FD, malformed).
        missed: the observations that did not arrive.
        pairs: (recorded time, live time) of frames that were on their bus [ns].
    """

    def __init__(
        self,
        steps: Sequence[HostStep],
        listener: Listener,
        begin_ns: int = 0,
        lines: Collection[str] = (),
        speed: float = 1.0,
        patience_ns: int = PATIENCE_NS,
    ) -> None:
        self.sent = 0
        self.unsent = 0
        self.missed: list[Missed] = []
        self.pairs: list[tuple[int, int]] = []
        self._steps = [step for step in steps if not step.is_free]
        free: dict[tuple[str, bytes], list[HostStep]] = {}
        for step in steps:
            if step.is_free:
                free.setdefault((step.bus, step.frame[:4]), []).append(step)
        self._heartbeats = [_Heartbeat(one, speed) for one in free.values()]
        self._listener = listener
        self._speed = speed
        self._patience_ns = patience_ns
        self._told: dict[Subject, list[Told]] = {}
        self._seen: dict[Subject, int] = {}
        self._anchor = (begin_ns, 0)  # the last known pair of recorded and live time
        self._lines = frozenset(lines)
        self._waiting_since_ns = 0
        self._given_up: set[Subject] = set()  # subjects whose answers may still arrive late
        self._in_flight: list[HostStep] = []
        self._waits: list[Told] = []
        self._begin()

    def start(self, now_ns: int) -> None:
        """Start the playback at `now_ns`."""
        begin_ns = self._anchor[0]
        self._anchor = (begin_ns, now_ns)
        self._waiting_since_ns = now_ns
        for one in self._heartbeats:
            one.start(begin_ns, now_ns)

    def is_over(self) -> bool:
        """Return True once all steps are sent."""
        return self.sent == len(self._steps)

    def heard(self, bus: str, frame: bytes, now_ns: int, transmitted: bool) -> None:
        """Handle a complete frame on a live bus; `transmitted` marks one of the host's own."""
        if transmitted:
            for place, step in enumerate(self._in_flight):
                if step.bus == bus and step.frame == frame:
                    del self._in_flight[place]
                    self._is_out(step, now_ns)
                    break
            self._listener.decode(bus, frame)
            return
        for told in self._listener.told(now_ns, bus, self._listener.decode(bus, frame)):
            self._told.setdefault(told.subject, []).append(told)

    def answered(self, line: str, unit: int, now_ns: int) -> None:
        """Handle a complete answer of a unit on a live line."""
        subject = (line, unit, ANSWER)
        self._told.setdefault(subject, []).append(Told(now_ns, subject, True, "its answer"))

    def next_deadline_ns(self) -> int | None:
        """Return when `take` is due if nothing is heard before [ns]."""
        if self.is_over():
            return None
        due_ns = self._due_ns() if self._is_ready() else self._patient_until_ns()
        return min([due_ns, *(one.due_ns for one in self._heartbeats)])

    def take(self, now_ns: int) -> list[tuple[str, bytes]]:
        """Return (bus, frame) of each frame to send by now."""
        out: list[tuple[str, bytes]] = []
        for one in self._heartbeats:
            while one.due_ns <= now_ns and not self.is_over():
                step = one.take()
                out.append((step.bus, step.frame))
        while not self.is_over():
            if not self._is_ready():
                if now_ns < self._patient_until_ns():
                    break
                self._give_up(now_ns)
                continue
            if self._due_ns() > now_ns:
                break
            step = self._steps[self.sent]
            self._forget_late(step)
            out.append((step.bus, step.frame))
            if step.bus in self._lines:  # a line does not report the end of transmission
                self._is_out(step, now_ns + step.end_ns - step.start_ns)
            else:
                self._in_flight.append(step)
            self.sent += 1
            self._waiting_since_ns = now_ns
            self._begin()
        return out

    # ------------------------------------------------------------------------------ inside

    def _begin(self) -> None:
        """Set up the observations that the next step waits for."""
        if not self.is_over():
            self._waits = list(self._steps[self.sent].waits)

    def _is_out(self, step: HostStep, now_ns: int) -> None:
        """Note that a frame of the host has been on its bus."""
        self.pairs.append((step.end_ns, now_ns))
        self._know(step.end_ns, now_ns)

    def _is_ready(self) -> bool:
        """Return True if everything that this step waits for has arrived."""
        while self._waits and self._has_come(self._waits[0]):
            del self._waits[0]
        return not self._waits

    def _has_come(self, awaited: Told) -> bool:
        """Return True if the observation came after those awaited before, and pass over it."""
        heard = self._told.get(awaited.subject, [])
        for place in range(self._seen.get(awaited.subject, 0), len(heard)):
            if heard[place].value == awaited.value:
                self._seen[awaited.subject] = place + 1
                self._know(awaited.time_ns, heard[place].time_ns)
                return True
        return False

    def _patient_until_ns(self) -> int:
        """Return when this step stops waiting [ns]; its recorded wait may be minutes (homing)."""
        recorded_ns, live_ns = self._anchor
        pause_ns = round((self._waits[0].time_ns - recorded_ns) / self._speed)
        return max(self._waiting_since_ns, live_ns + pause_ns) + self._patience_ns

    def _give_up(self, now_ns: int) -> None:
        """Give up the observation that this step waits for."""
        awaited = self._waits.pop(0)
        heard = self._told.get(awaited.subject, [])
        if awaited.subject[2] == ANSWER:
            instead = "no answer"
            self._given_up.add(awaited.subject)
        elif heard:
            instead = f"last told: {heard[-1].text}"
        else:
            instead = "no report received"
        self.missed.append(Missed(now_ns, awaited, self._steps[self.sent], instead))
        self._waiting_since_ns = now_ns
        self._know(awaited.time_ns, now_ns)

    def _forget_late(self, step: HostStep) -> None:
        """Discard an answer that arrived after it was given up, before the next request."""
        can_id = int.from_bytes(step.frame[:4], "little")
        if step.bus in self._lines or can_id >> 7 != _SDO_REQUEST:
            return  # lines may have several requests to one unit in progress
        subject = (step.bus, can_id & 0x7F, ANSWER)
        if subject in self._given_up and len(self._told.get(subject, [])) > self._seen.get(
            subject, 0
        ):
            self._seen[subject] = len(self._told[subject])
            self._given_up.discard(subject)

    def _know(self, recorded_ns: int, live_ns: int) -> None:
        """Set the pair of recorded and live time from which pauses are counted."""
        if recorded_ns >= self._anchor[0]:
            self._anchor = (recorded_ns, live_ns)

    def _due_ns(self) -> int:
        """Return when this step is due, in live time [ns]."""
        recorded_ns, live_ns = self._anchor
        return live_ns + round((self._steps[self.sent].start_ns - recorded_ns) / self._speed)


@final
class ReceiveQueue:
    """A bus listener that ignores all frames before a given frame of its own.

    Args:
        hear: called with each frame, its time [ns], and True if the frame is an own one.
        opening: the frame to wait for; None: listen at once.
    """

    def __init__(self, hear: Callable[[bytes, int, bool], None], opening: bytes | None) -> None:
        self._hear = hear
        self._opening = opening

    def heard(self, frame: bytes, time_ns: int, transmitted: bool) -> None:
        """Handle a frame that was on the bus."""
        if self._opening is not None:
            if not transmitted or frame != self._opening:
                return
            self._opening = None
        self._hear(frame, time_ns, transmitted)


class Driven(Protocol):
    """The buses and lines that a recorded host drives.

    Attributes:
        runtime: the runtime that provides the time.
        buses, lines: their names.
        what: the name of all of them together, for messages.
    """

    runtime: Runtime
    buses: Sequence[str]
    lines: Sequence[str]
    what: str

    def bit_times_ns(self, bus: str) -> tuple[int, int]:
        """Return the bit times [ns] of a bus: nominal, and in the CAN FD data phase."""

    def send(self, bus: str, frame: bytes) -> None:
        """Queue a can_frame on a bus, or send an ADU on a line."""

    def listen(self, bus: str, player: HostPlayer, opening: bytes | None = None) -> None:
        """Connect the player to a bus or line, from its own frame `opening` on; None: at once."""


def drive(
    driven: Driven,
    recording: Path,
    speed: float = 1.0,
    patience_ns: int = PATIENCE_NS,
    reset: bool = False,
) -> HostPlayer:
    """Send everything the recorded host sent to the devices.

    Args:
        driven: the buses and lines of the devices.
        recording: a recording with a host in it.
        speed: factor by which the host's pauses are shorter than recorded.
        patience_ns: how much longer than recorded the player waits for an answer [ns].
        reset: reset all nodes by NMT first, so that nodes that run already boot again.

    Raises:
        TraceError: the recording cannot be read.
        RigError: the recording has no host, or it uses a bus or line that is missing.
    """
    buses, lines = driven.buses, driven.lines
    bits_ns = {bus: driven.bit_times_ns(bus) for bus in buses}

    def length_ns(bus: str, frame: bytes) -> int:
        bit_ns, data_bit_ns = bits_ns.get(bus, (1000, 1000))
        if len(frame) > FRAME_BYTES and not data_bit_ns:
            raise ValueError("a classical bus does not carry CAN FD frames")
        return duration_ns(frame, bit_ns, data_bit_ns)

    with read_trace(recording) as trace:
        steps, unsent = host_of(trace, Listener({}), length_ns)
        first_ns, end_ns = trace.span_ns() or (0, 0)
        begin_ns = 0 if "run" in trace.metadata else first_ns
    if not steps:
        raise RigError(
            recording, "holds no frame of a host", "give a recording with commands to devices"
        )
    used = list(dict.fromkeys(step.bus for step in steps))
    for bus in used:
        if bus not in (*buses, *lines):
            known = ", ".join((*buses, *lines))
            problem = (
                f"the recorded host sends on {bus!r}, but {driven.what} has no such bus or line"
            )
            raise RigError(recording, problem, f"available: {known}")
    player = HostPlayer(steps, Listener({}), begin_ns, lines, speed, patience_ns)
    player.unsent = unsent
    runtime = driven.runtime
    resets = [one for one in used if reset and one in buses]
    for name in used:  # messages from before the reset do not count as answers
        driven.listen(name, player, _RESET_ALL if name in resets else None)
    for bus in resets:
        driven.send(bus, _RESET_ALL)
    player.start(runtime.now_ns())
    while not player.is_over():
        for bus, frame in player.take(runtime.now_ns()):
            driven.send(bus, frame)
        due_ns = player.next_deadline_ns()
        if due_ns is not None:
            left_s = max(0, due_ns - runtime.now_ns()) / 1e9
            runtime.wait_until(_changed(player, due_ns), left_s)
    runtime.wait_until(never, max(0, end_ns - steps[-1].end_ns) / 1e9 + _TAIL_S)
    return player


def _changed(player: HostPlayer, due_ns: int) -> Callable[[], bool]:
    return lambda: player.next_deadline_ns() != due_ns


@final
class DrivenRig:
    """The buses and lines of an open rig."""

    def __init__(self, rig: "Rig") -> None:
        self.runtime: Runtime = rig.runtime
        self.buses: Sequence[str] = rig.world.bus_names()
        self.lines: Sequence[str] = rig.world.line_names()
        self.what = str(rig.description.source.path)
        self._rig = rig
        self._rests: dict[str, bytearray] = {}  # of incomplete answers, by line

    def bit_times_ns(self, bus: str) -> tuple[int, int]:
        """Return the bit times [ns] of a bus: nominal, and in the CAN FD data phase.

        The latter is 0 on a classical bus.
        """
        found = self._rig.world.bus(bus)
        return found.bit_ns, found.data_bit_ns

    def send(self, bus: str, frame: bytes) -> None:
        """Queue the frame on a bus, or send it on a line."""
        if bus in self.lines:
            line = self._rig.line(bus)
            if line.framing == "rtu":  # an incomplete answer cannot be part of a later one
                self._rests.setdefault(bus, bytearray()).clear()
            line.send(frame)
        else:
            self.runtime.send(self._rig.bus(bus), frame)

    def listen(self, bus: str, player: HostPlayer, opening: bytes | None = None) -> None:
        """Connect the player to a bus or line, from its own frame `opening` on."""
        if bus in self.lines:
            self._listen_to_line(bus, player)
            return

        def hear(frame: bytes, time_ns: int, transmitted: bool) -> None:
            player.heard(bus, frame, time_ns, transmitted)

        self.runtime.listen(self._rig.bus(bus), ReceiveQueue(hear, opening).heard)

    def _listen_to_line(self, name: str, player: HostPlayer) -> None:
        line = self._rig.line(name)
        rest = self._rests.setdefault(name, bytearray())
        is_tcp = line.framing == "tcp"
        unit_at = 6 if is_tcp else 0

        def hear(data: bytes, time_ns: int) -> None:
            rest.extend(data)
            while (size := answer_size(bytes(rest), is_tcp)) is not None and len(rest) >= size:
                if size > unit_at:
                    player.answered(name, rest[unit_at], time_ns)
                del rest[:size]

        line.listen(hear)


def compared(
    recording: Path, live: Path, pairs: list[tuple[int, int]], tolerance: Tolerance
) -> tuple[list[ObjectFidelity], list[Difference]]:
    """Compare the live devices with the recorded ones: fidelity by object, and differences.

    Raises:
        TraceError: one of the files cannot be read.
    """
    first, second = (told_by_nodes(meaning_in(path, "replay")) for path in (recording, live))
    if pairs:
        first = retimed(first, pairs)
    return fidelity(first, second, tolerance), differences(first, second, tolerance)
