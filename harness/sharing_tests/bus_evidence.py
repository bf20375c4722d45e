"""Evidence from a recorded bus: who commanded a motor, and who owned it then.

    evidence = read_evidence("run.mcap", {"left": ("can0", 1)})
    print(evidence.table())
    evidence.require_sound()

The recording has every frame with its sender, and every handover of a motor with its owner and
token (`OwnershipRecord`). While one process owns a motor, until it releases or loses it, no
commanding frame of another process may be on the bus. A *commanding* frame may start or change
motion or settings: an RPDO, a request of an SDO download, NMT to the node. A controlword that only
stops (disable voltage, quick stop, halt, disable operation) is not commanding, since stopping needs
no ownership. SDO uploads, SYNC, heartbeats and NMT start are not commanding either; a joining host
uses NMT start to make a node transmit. A frame passed to the bus just before its sender lost the
motor may follow later, by its waiting time on the bus. `late_s` allows for that, and such frames
are counted.

Settings of the next owner (no RPDOs) may appear before the recorded end of an ownership. This
happens if its owner died or lost it, or if its release was recorded too late. A death is not
reported. A joining program sets up the drive under the lock, before it owns the motor for its own
operation. Only the latter ownership is reported.
"""

import os
import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import CAN_FRAME
from motorhil.traces.semantics.ownership import Ended, OwnershipRecord, Tenure, read_ownership

_NODE: Final = 0x7F
_RPDO: Final = (0x200, 0x300, 0x400, 0x500)  # CiA 301, predefined connection set
_SDO_REQUEST: Final = 0x600
_NMT_START: Final = 0x01
_CONTROLWORD: Final = struct.Struct("<H")
_SHOWN: Final = 5


@final
@dataclass(frozen=True, slots=True)
class BusFrame:
    """A complete frame on a bus, with its time [ns] and its sender."""

    bus: str
    time_ns: int
    sender: str
    can_id: int
    data: bytes

    def __str__(self) -> str:
        return f"{self.time_ns / 1e9:.6f} s {self.sender}: {self.can_id:03X}h {self.data.hex(' ')}"


@final
@dataclass(frozen=True, slots=True)
class Evidence:
    """The proof that the frames of a recording give for its motors.

    Attributes:
        counts: commanding frames by motor and owner at that time: "own", "late" (the sender's
            shortly before), "next" (see above), "free" (no owner), "foreign".
        foreign: the foreign frames, with the owner at that time.
        contradictions: contradictions in the ownership record.
        unseen: motors without any commanding frame, about which nothing is proved.
    """

    counts: Mapping[str, int]
    foreign: tuple[tuple[BusFrame, Tenure], ...]
    contradictions: tuple[str, ...]
    unseen: tuple[str, ...]

    def table(self) -> str:
        """Return the counts as text."""
        return "\n".join(f"{count:8d}  {name}" for name, count in sorted(self.counts.items()))

    def require_sound(self) -> None:
        """Raise SharingViolated if a frame commanded another owner's motor, or if none was seen.

        A recording without a commanding frame of a motor (wrong bus or node-ID) proves nothing.
        """
        if self.contradictions:
            raise SharingViolated("\n".join(self.contradictions))
        if self.foreign:
            lines = [f"    {frame}\n  while {tenure}" for frame, tenure in self.foreign[:_SHOWN]]
            raise SharingViolated(
                f"{len(self.foreign)} commanding frames from a process that did not own the "
                "motor:\n" + "\n".join(lines)
            )
        if self.unseen:
            raise SharingViolated(
                f"nothing is proved about {', '.join(self.unseen)}: no frame commands it; give "
                "the bus and the node-ID of each moved motor"
            )


def commanded_node(can_id: int, data: bytes) -> int | None:
    """Return the node whose motion or settings the frame may change (0: all), or None.

    Source: CiA 301 (predefined connection set; SDO command specifiers; NMT), CiA 402-2 (commands in
    the controlword, halt). The controlword is assumed to be the first object of an RPDO.
    """
    if can_id == 0:
        return data[1] if len(data) > 1 and data[0] != _NMT_START else None
    function, node = can_id & ~_NODE, can_id & _NODE
    if function == _SDO_REQUEST and data:
        specifier = data[0] >> 5  # 0: download segment, 1: initiate download, 6: block download
        if specifier not in (0, 1, 6):
            return None
        is_controlword = specifier == 1 and data[1:4] == b"\x40\x60\x00"
        return None if is_controlword and _only_stops(data[4:6]) else node
    if function in _RPDO and node:
        return None if _only_stops(data) else node
    return None


def _only_stops(data: bytes) -> bool:
    """Return True if the leading controlword only stops or switches off."""
    if len(data) < _CONTROLWORD.size:
        return False
    word: int = _CONTROLWORD.unpack_from(data)[0]
    if word & 0x80:
        return False  # a fault reset changes the drive's state
    if not word & 0x02 or not word & 0x04:
        return True  # disable voltage, quick stop
    return not word & 0x08 or bool(word & 0x100)  # shutdown, switch on = disable operation; halt


def judge_frames(
    frames: Iterable[BusFrame],
    ownership: OwnershipRecord,
    nodes: Mapping[str, tuple[str, int]],
    *,
    late_s: float = 0.002,
) -> Evidence:
    """Judge frames of any source.

    Args:
        frames: in any order.
        ownership: the owners of each motor, by the same clock.
        nodes: (bus, node-ID) of each motor.
        late_s: how long a frame may follow after its sender lost or released the motor [s].
    """
    counts: Counter[str] = Counter()
    foreign: list[tuple[BusFrame, Tenure]] = []
    motors: dict[tuple[str, int], list[str]] = {}
    for motor, place in nodes.items():
        motors.setdefault(place, []).append(motor)
    late_ns = round(late_s * 1e9)
    for frame in frames:
        node = commanded_node(frame.can_id, frame.data)
        if node is None:
            continue
        for (bus, number), named in motors.items():
            if bus != frame.bus or node not in (0, number):
                continue
            for motor in named:
                kind, tenure = _tenure_of(ownership.tenures.get(motor, ()), frame, late_ns)
                counts[f"{motor}: {kind}"] += 1
                if kind == "foreign" and tenure is not None:
                    foreign.append((frame, tenure))
    seen = {name.rpartition(": ")[0] for name in counts}
    unseen = (
        [
            f"{motor} ({bus} node {node})"
            for motor, (bus, node) in nodes.items()
            if motor not in seen
        ]
        if nodes
        else ["any motor (no motor is named)"]
    )
    return Evidence(dict(counts), tuple(foreign), ownership.contradictions, tuple(unseen))


def _tenure_of(
    tenures: Sequence[Tenure], frame: BusFrame, late_ns: int
) -> tuple[str, Tenure | None]:
    """Return the relation of the frame's sender to the motor, and the owner's tenure."""
    after = bisect_right(tenures, frame.time_ns, key=_start_of)  # no two overlap
    owner = tenures[after - 1] if after else None
    if owner is None or not owner.has(frame.time_ns):
        return "free", None
    if not owner.sender or owner.sender == frame.sender:
        return "own", owner
    is_next = after < len(tenures) and tenures[after].sender == frame.sender
    gave_back = owner.ended is Ended.RELEASED and not owner.crossed_ns
    if is_next and not gave_back and frame.can_id & ~_NODE not in _RPDO:
        return "next", owner
    for tenure in tenures:
        if tenure.sender != frame.sender or tenure.to_ns is None:
            continue
        if 0 <= frame.time_ns - tenure.to_ns <= late_ns:
            return "late", tenure
    return "foreign", owner


def _start_of(tenure: Tenure) -> int:
    return tenure.from_ns


def read_evidence(
    recording: str | os.PathLike[str],
    nodes: Mapping[str, tuple[str, int]],
    *,
    late_s: float = 0.002,
) -> Evidence:
    """Judge a recording; the arguments are those of `judge_frames`.

    Raises:
        TraceError: the recording cannot be read.
    """
    frames: list[BusFrame] = []
    with read_trace(recording) as trace:
        ownership = read_ownership(trace)
        for channel, time_ns, data in trace.messages():
            if not channel.topic.startswith("/can/"):
                continue
            facts = decode(CAN_FRAME, data)
            if facts.get("extended") or facts.get("remote") or facts.get("error"):
                continue  # not used in CANopen, or not sent by a node
            can_id, payload, sender = (facts.get(name) for name in ("id", "data", "sender"))
            if isinstance(can_id, int) and isinstance(payload, bytes) and isinstance(sender, str):
                bus = channel.topic[len("/can/") :]
                frames.append(BusFrame(bus, time_ns, sender, can_id, payload))
    return judge_frames(frames, ownership, nodes, late_s=late_s)
