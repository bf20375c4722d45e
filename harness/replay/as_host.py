"""Replay of a recorded host against devices, and comparison of their answers."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, final

from emulators.media.can_bits import INTERMISSION_BITS, measure, phases_of
from emulators.media.can_frame import FRAME_BYTES
from emulators.media.can_port import LENGTHS_MASK
from harness.recorded_meaning import meaning_in
from harness.replay.ears import Ears
from harness.replay.host_player import PATIENCE_NS, HostPlayer
from harness.settings import RigError
from motorapi.runtime import Runtime
from traces.fidelity import ObjectFidelity, fidelity, retimed, told_by_nodes
from traces.host_tape import Listener
from traces.reader import read_trace
from traces.recorded_host import answer_size, host_of
from traces.semantic_diff import Difference, Tolerance, differences
from traces.traffic import classic

if TYPE_CHECKING:
    from harness.rig import Rig

_RESET_ALL: Final = classic(0, b"\x81\x00")
"""The frame of NMT service "reset node" to all nodes (CiA 301)."""
_TAIL_S: Final = 0.1
"""How long to listen after the end of the recording [s], since devices may be slower now."""


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
        nominal, data = phases_of(measure(frame) & LENGTHS_MASK)
        return (nominal - INTERMISSION_BITS) * bit_ns + data * data_bit_ns

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
    runtime.wait_until(_never, max(0, end_ns - steps[-1].end_ns) / 1e9 + _TAIL_S)
    return player


def _changed(player: HostPlayer, due_ns: int) -> Callable[[], bool]:
    return lambda: player.next_deadline_ns() != due_ns


def _never() -> bool:
    return False


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

        self.runtime.listen(self._rig.bus(bus), Ears(hear, opening).heard)

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
