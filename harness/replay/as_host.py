"""The host of a recording drives a rig; what its devices answer is compared with the recording."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from emulators.media.can_bits import INTERMISSION_BITS, KEY_SHIFT, measure
from harness.replay.host_player import PATIENCE_NS, HostPlayer
from harness.settings import RigError
from traces.fidelity import ObjectFidelity, fidelity, retimed, told_by_nodes
from traces.host_tape import HostStep, Listener
from traces.meaning import Meaning, meaning_of
from traces.reader import read_trace
from traces.recorded_host import answer_size, host_of
from traces.semantic_diff import Difference, Tolerance, differences

if TYPE_CHECKING:
    from harness.rig import Rig

_BITS: Final = (1 << KEY_SHIFT) - 1
_TAIL_S: Final = 0.1
"""How long what the last frame brings about is heard [s]."""


@final
@dataclass(frozen=True, slots=True)
class HostRun:
    """What came of it.

    Attributes:
        player: what was sent, and what was waited for in vain.
        pairs: (time in the recording, live time) of the host's frames [ns].
    """

    player: HostPlayer
    pairs: list[tuple[int, int]]


def read_host(recording: Path) -> tuple[list[HostStep], int]:
    """The host's frames, and when the recording begins [ns].

    Raises:
        TraceError: the recording cannot be read.
        RigError: there is no host in it.
    """
    with read_trace(recording) as trace:
        steps = host_of(trace, Listener({}))
        begin_ns = 0 if "run" in trace.metadata else (trace.span_ns() or (0, 0))[0]
    if not steps:
        raise RigError(
            recording, "holds no frame of a host", "give a recording with commands to devices"
        )
    return steps, begin_ns


def drive(
    rig: "Rig",
    steps: list[HostStep],
    begin_ns: int,
    speed: float = 1.0,
    patience_ns: int = PATIENCE_NS,
    progress: Callable[[int, int], None] | None = None,
) -> HostRun:
    """The rig has been told all that the recorded host sent.

    Raises:
        RigError: the host uses a bus or line that the rig does not have.
    """
    runtime = rig.runtime
    buses, lines = set(rig.world.bus_names()), set(rig.world.line_names())
    for step in steps:
        if step.bus not in buses | lines:
            known = ", ".join((*rig.world.bus_names(), *rig.world.line_names()))
            raise RigError(
                rig.description.source.path,
                f"has no bus or line {step.bus!r}, on which the recorded host sends",
                f"name one of them so: {known}",
            )
    used = dict.fromkeys(step.bus for step in steps)
    bits_ns = {bus: rig.world.bus(bus).bit_ns for bus in used if bus in buses}

    def length_ns(bus: str, frame: bytes) -> int:
        if bus in lines:
            return rig.line(bus).duration_ns(len(frame))
        return ((measure(frame) & _BITS) - INTERMISSION_BITS) * bits_ns[bus]

    player = HostPlayer(
        steps, Listener({}), begin_ns, length_ns, lines & set(used), speed, patience_ns
    )
    for name in used:
        if name in lines:
            _hear_line(rig, name, player)
        else:
            _hear_bus(rig, name, player)
    player.start(runtime.now_ns())
    while not player.is_over():
        for bus, frame in player.take(runtime.now_ns()):
            if bus in lines:
                rig.line(bus).send(frame)
            else:
                runtime.send(rig.bus(bus), frame)
        if progress is not None:
            progress(player.sent, len(steps))
        due_ns = player.next_deadline_ns()
        if due_ns is not None:
            left_s = max(0, due_ns - runtime.now_ns()) / 1e9
            runtime.wait_until(_changed(player, due_ns), left_s)
    runtime.run_for(_TAIL_S)
    return HostRun(player, player.pairs)


def _changed(player: HostPlayer, due_ns: int) -> Callable[[], bool]:
    return lambda: player.next_deadline_ns() != due_ns


def _hear_bus(rig: "Rig", name: str, player: HostPlayer) -> None:
    def hear(frame: bytes, time_ns: int, transmitted: bool) -> None:
        player.heard(name, frame, time_ns, transmitted)

    rig.runtime.listen(rig.bus(name), hear)


def _hear_line(rig: "Rig", name: str, player: HostPlayer) -> None:
    line = rig.line(name)
    rest = bytearray()

    def hear(data: bytes, time_ns: int) -> None:
        rest.extend(data)
        size = answer_size(bytes(rest), line.framing == "tcp")
        if size is not None and len(rest) >= size:
            player.answered(name, rest[6 if line.framing == "tcp" else 0], time_ns)
            rest.clear()

    line.listen(hear)


def compared(
    recording: Path, live: Path, pairs: list[tuple[int, int]], tolerance: Tolerance
) -> tuple[list[ObjectFidelity], list[Difference]]:
    """How far the live devices behaved like the recorded ones, and where they began not to.

    Raises:
        TraceError: one of the files cannot be read.
    """
    first = retimed(_meaning(recording), pairs) if pairs else _meaning(recording)
    second = _meaning(live)
    return fidelity(first, second, tolerance), differences(first, second, tolerance)


def _meaning(path: Path) -> Meaning:
    with read_trace(path) as trace:
        return told_by_nodes(meaning_of(trace))
