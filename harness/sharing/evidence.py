"""What a bus itself proves: who commanded a motor, and whose it was just then.

    evidence = read_evidence("run.mcap", {"left": ("can0", 1)})
    print(evidence.table())
    evidence.require_sound()

The recording has every frame with who sent it, and every handover of a motor with who has it under
what token (`harness.ownership_record`). Between the moment that one is told to have it and the
moment that he gives it back, or that it is taken from him, no commanding frame of anybody else may
be on the bus. A *commanding* frame is one that may start or change motion or settings: an RPDO, a
request of an SDO download, NMT to the node. A controlword that only stops (disable voltage, quick
stop, halt, disable operation) is none: stopping takes nobody's permission; nor are questions, SYNC,
heartbeats, and NMT start, by which whoever joins makes a node speak. A frame that was handed to the
bus by its owner just before he lost the motor may come after it, by as long as it waited for its
turn: that is what `late_s` allows, and it is counted.
So are settings of the next owner (no RPDOs) in what looks like the end of the time of one who died
or lost it, or was heard to give it back too late: nobody tells when one dies, and a program that
joins sets the drive up under the lock before it has the motor for an operation of its own, which
alone is told.
"""

import os
import struct
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

from harness.ownership_record import (
    Ended,
    OwnershipRecord,
    Tenure,
    read_ownership,
)
from harness.sharing.history import SharingViolated
from traces.protobuf import decode
from traces.reader import read_trace
from traces.schema import CAN_FRAME

_NODE: Final = 0x7F
_RPDO: Final = (0x200, 0x300, 0x400, 0x500)  # CiA 301, predefined connection set
_SDO_REQUEST: Final = 0x600
_NMT_START: Final = 0x01
_CONTROLWORD: Final = struct.Struct("<H")
_SHOWN: Final = 5


@final
@dataclass(frozen=True, slots=True)
class BusFrame:
    """A frame that was on a bus: when it was complete, and who sent it."""

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
    """What the frames of a recording prove of its motors.

    Attributes:
        counts: commanding frames by motor and by whose the motor was: "own", "late" (the sender's
            shortly before), "next" (see above), "free" (nobody's), "foreign".
        foreign: the last kind, with whose the motor was.
        contradictions: of what was told of ownership.
        unseen: motors of which nothing is proven: no frame commanded them, if there are any at all.
    """

    counts: Mapping[str, int]
    foreign: tuple[tuple[BusFrame, Tenure], ...]
    contradictions: tuple[str, ...]
    unseen: tuple[str, ...]

    def table(self) -> str:
        """The counts, for people."""
        return "\n".join(f"{count:8d}  {name}" for name, count in sorted(self.counts.items()))

    def require_sound(self) -> None:
        """Raises SharingViolated if somebody commanded a motor that was another's, or nobody did.

        A recording without a commanding frame of a motor (a wrong bus, or node-ID) proves nothing.
        """
        if self.contradictions:
            raise SharingViolated("\n".join(self.contradictions))
        if self.foreign:
            lines = [f"    {frame}\n  while {tenure}" for frame, tenure in self.foreign[:_SHOWN]]
            raise SharingViolated(
                f"{len(self.foreign)} commanding frames of one who did not have the motor:\n"
                + "\n".join(lines)
            )
        if self.unseen:
            raise SharingViolated(
                f"nothing is proven of {', '.join(self.unseen)}: no frame there commands it;"
                " give the bus and the node-ID of each motor that was moved"
            )


def commanded_node(can_id: int, data: bytes) -> int | None:
    """Which node's motion or settings the frame may change (0: all); None: nobody's.

    Source: CiA 301 (predefined connection set; SDO command specifiers; NMT), CiA 402-2 (commands
    in the controlword, halt). The controlword is taken to be the first object of an RPDO.
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
    """Whether the controlword in front stops, or switches off, and nothing else."""
    if len(data) < _CONTROLWORD.size:
        return False
    word: int = _CONTROLWORD.unpack_from(data)[0]
    if word & 0x80:
        return False  # a reset of a fault changes the drive's state
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
    """What the frames prove; of any source.

    Args:
        frames: in any order.
        ownership: who had which motor when, by the same clock.
        nodes: (bus, node-ID) of each motor.
        late_s: how long after he lost or gave back the motor a frame of one who had it may come.
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
                whose, tenure = _whose(ownership.tenures.get(motor, ()), frame, late_ns)
                counts[f"{motor}: {whose}"] += 1
                if whose == "foreign" and tenure is not None:
                    foreign.append((frame, tenure))
    seen = {name.rpartition(": ")[0] for name in counts}
    unseen = (
        [
            f"{motor} ({bus} node {node})"
            for motor, (bus, node) in nodes.items()
            if motor not in seen
        ]
        if nodes
        else ["any motor (none is named)"]
    )
    return Evidence(dict(counts), tuple(foreign), ownership.contradictions, tuple(unseen))


def _whose(tenures: Sequence[Tenure], frame: BusFrame, late_ns: int) -> tuple[str, Tenure | None]:
    """Whose the motor was when the frame was sent."""
    owner = next((one for one in reversed(tenures) if one.has(frame.time_ns)), None)
    if owner is None:
        return "free", None
    if not owner.sender or owner.sender == frame.sender:
        return "own", owner
    after = tenures.index(owner) + 1
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


def read_evidence(
    recording: str | os.PathLike[str],
    nodes: Mapping[str, tuple[str, int]],
    *,
    late_s: float = 0.002,
) -> Evidence:
    """What a recording proves; arguments as of `judge_frames`.

    Raises:
        TraceError: it cannot be read.
    """
    frames: list[BusFrame] = []
    with read_trace(recording) as trace:
        ownership = read_ownership(trace)
        for channel, time_ns, data in trace.messages():
            if not channel.topic.startswith("/can/"):
                continue
            facts = decode(CAN_FRAME, data)
            if facts.get("extended") or facts.get("remote") or facts.get("error"):
                continue  # of no use in CANopen, or not sent by anybody
            can_id, payload, sender = (facts.get(name) for name in ("id", "data", "sender"))
            if isinstance(can_id, int) and isinstance(payload, bytes) and isinstance(sender, str):
                bus = channel.topic[len("/can/") :]
                frames.append(BusFrame(bus, time_ns, sender, can_id, payload))
    return judge_frames(frames, ownership, nodes, late_s=late_s)
