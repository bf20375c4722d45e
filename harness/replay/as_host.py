"""The host of a recording drives a rig; what its devices answer is compared with the recording."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from emulators.media.can_bits import INTERMISSION_BITS, KEY_SHIFT, measure
from harness.replay.host_player import PATIENCE_NS, HostPlayer
from harness.settings import RigError
from traces.fidelity import ObjectFidelity, fidelity, retimed, told_by_nodes
from traces.host_tape import Listener
from traces.meaning import Meaning, meaning_of
from traces.reader import read_trace
from traces.recorded_host import answer_size, host_of
from traces.semantic_diff import Difference, Tolerance, differences

if TYPE_CHECKING:
    from harness.rig import Rig

_BITS: Final = (1 << KEY_SHIFT) - 1
_TAIL_S: Final = 0.1
"""How long what the last frame brings about is heard [s]."""


def drive(
    rig: "Rig",
    recording: Path,
    speed: float = 1.0,
    patience_ns: int = PATIENCE_NS,
) -> HostPlayer:
    """The rig has been told all that the recorded host sent.

    Args:
        rig: open, in virtual time or the wall's.
        recording: with a host in it.
        speed: how much faster the host's pauses are than recorded.
        patience_ns: how long something is waited for that was told in the recording [ns].

    Raises:
        TraceError: the recording cannot be read.
        RigError: there is no host in it, or it uses a bus or line that the rig does not have.
    """
    buses, lines = rig.world.bus_names(), rig.world.line_names()
    bits_ns = {bus: rig.world.bus(bus).bit_ns for bus in buses}

    def length_ns(bus: str, frame: bytes) -> int:
        return ((measure(frame) & _BITS) - INTERMISSION_BITS) * bits_ns.get(bus, 1000)

    with read_trace(recording) as trace:
        steps = host_of(trace, Listener({}), length_ns)
        begin_ns = 0 if "run" in trace.metadata else (trace.span_ns() or (0, 0))[0]
    if not steps:
        raise RigError(
            recording, "holds no frame of a host", "give a recording with commands to devices"
        )
    used = list(dict.fromkeys(step.bus for step in steps))
    for bus in used:
        if bus not in (*buses, *lines):
            known = ", ".join((*buses, *lines))
            problem = f"has no bus or line {bus!r}, on which the recorded host sends"
            raise RigError(rig.description.source.path, problem, f"name one of them so: {known}")
    player = HostPlayer(steps, Listener({}), begin_ns, lines, speed, patience_ns)
    for name in used:
        if name in lines:
            _hear_line(rig, name, player)
        else:
            _hear_bus(rig, name, player)
    _play(rig, player)
    return player


def _play(rig: "Rig", player: HostPlayer) -> None:
    runtime, lines = rig.runtime, rig.world.line_names()
    player.start(runtime.now_ns())
    while not player.is_over():
        for bus, frame in player.take(runtime.now_ns()):
            if bus in lines:
                rig.line(bus).send(frame)
            else:
                runtime.send(rig.bus(bus), frame)
        due_ns = player.next_deadline_ns()
        if due_ns is not None:
            left_s = max(0, due_ns - runtime.now_ns()) / 1e9
            runtime.wait_until(_changed(player, due_ns), left_s)
    runtime.run_for(_TAIL_S)


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
