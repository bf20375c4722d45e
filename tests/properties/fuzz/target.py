"""A fuzzed drive: its steps, its invariants and the states it reached.

The drive must not raise, enter a state that CiA 402 forbids (`Watched`), or have current without
power. Afterwards an NMT reset node must bring it back: it boots and answers an SDO upload.
"""

import struct
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from motorhil.emulators.canopen.nmt import NmtState
from tests.properties.fuzz.frames import Frames, Step, frame
from tests.support.cia402.bench import MS
from tests.support.cia402.stranger import LIGHT, OBJECTS
from tests.support.cia402.watched import Watched

EPISODE: Final = 2_000
"""Number of frames to one drive; then a new drive follows."""
DEVICE_TYPE: Final = bytes.fromhex("4300100092010200")  # CiA 402, servo drive


class Reached:
    """Counts of what the drives reached."""

    def __init__(self) -> None:
        self.frames = 0
        self.answers = 0
        self.nmt: Counter[str] = Counter()
        self.states: Counter[str] = Counter()
        self.transitions: Counter[int] = Counter()
        self.aborts: Counter[int] = Counter()
        self.emergencies: Counter[int] = Counter()

    def add(self, drive: Watched, frames: int) -> None:
        """Add the counts of a drive after its episode."""
        self.frames += frames
        self.transitions.update(drive.taken)
        self.states.update(state.name for state in drive.visited)
        self.aborts.update(drive.aborts)
        self.emergencies.update(drive.all_emergencies)
        self.answers += drive.answers

    def table(self) -> str:
        """Return the counts as a table for people."""
        rows = ["transition, how often"]
        rows.extend(f"{number:>6}{self.transitions[number]:>10}" for number in range(17))
        for title, counts in (
            ("FSA state, drives that were in it", self.states),
            ("NMT state, frames that came in it", self.nmt),
        ):
            rows.append(title)
            rows.extend(f"      {name:<28}{count:>8}" for name, count in sorted(counts.items()))
        rows.append(f"SDO answers {self.answers}; abort code, how often")
        rows.extend(f"      {code:08X}h{count:>27}" for code, count in sorted(self.aborts.items()))
        rows.append("EMCY, how often")
        rows.extend(
            f"      {code:04X}h{count:>31}" for code, count in self.emergencies.most_common()
        )
        return "\n".join(rows)


def new_drive() -> Watched:
    """Return a light drive that boots quickly and monitors a heartbeat."""
    objects = {key: value for key, value in OBJECTS.items() if key != "1029h:1"}
    drive = Watched(strict=False, objects=objects, timing={"boot_up_s": 0.01}, plant=LIGHT)
    drive.run(10 * MS)
    return drive


def episode(seed: int, number: int, count: int = EPISODE) -> Iterator[Step]:
    """Return the steps of one drive's episode."""
    return Frames(f"fuzz {seed}:{number}", new_drive().drive.od).take(count)


def endure(steps: Iterable[Step], reached: Reached | None = None) -> None:
    """Apply all steps to a new drive and check that it still works.

    Raises:
        Exception: an exception of the drive, or a violated invariant.
    """
    drive = new_drive()
    drive.tell(frame(0x000, b"\x01\x00"))
    node = drive.drive._node
    seen: Counter[int] = Counter()
    done = 0
    for pause, can_id, what in steps:
        if pause:
            drive.run(pause)
        if isinstance(what, bytes):
            drive.tell(frame(can_id, what))
        else:
            name, _, value = str(what).partition(" ")
            drive.stimulate(name, float(value))
        seen[node.state] += 1
        done += 1
        drive.forget()
    if reached is not None:
        reached.nmt.update({NmtState(state).name: count for state, count in seen.items()})
        reached.add(drive, done)
    still_answers(drive)


def still_answers(drive: Watched) -> None:
    """Check boot-up after NMT reset node, and the device type by SDO at its present node-ID."""
    drive.run(1_000 * MS)
    drive.forget()
    drive.tell(frame(0x000, b"\x81\x00"))
    drive.run(1_000 * MS)
    nodes = [can_id & 0x7F for _, can_id, data in drive.sent if can_id >> 7 == 14 and data == b"\0"]
    assert len(nodes) == 1, f"{len(nodes)} boot-ups after reset node"
    drive.tell(frame(0x600 + nodes[0], struct.pack("<BHB4x", 0x40, 0x1000, 0)))
    drive.run(50 * MS)
    answers = [data for _, can_id, data in drive.sent if can_id == 0x580 + nodes[0]]
    assert answers == [DEVICE_TYPE], f"1000h is answered with {[data.hex() for data in answers]}"


def shrunk(steps: Sequence[Step], tries: int = 300) -> list[Step]:
    """Return fewer steps that still fail, by removing ever smaller parts."""
    kept = list(steps)
    size = len(kept) // 2
    while size and tries:
        place = 0
        while place < len(kept) and tries:
            tries -= 1
            shorter = kept[:place] + kept[place + size :]
            if fails(shorter):
                kept = shorter
            else:
                place += size
        size //= 2
    return kept


def fails(steps: Iterable[Step]) -> Exception | None:
    """Return the exception that these steps cause, or None."""
    try:
        endure(steps)
    except Exception as error:
        return error
    return None
