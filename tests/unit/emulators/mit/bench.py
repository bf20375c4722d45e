"""A drive with MIT frames alone, frame by frame."""

from pathlib import Path

from motorhil.emulators.controller import Controller, ControllerContext
from motorhil.emulators.mit.classical import build as build_mit
from motorhil.emulators.mit.robstride import build as build_robstride

MS = 1_000_000
EFF = 0x8000_0000
ENTER, LEAVE, ZERO, CLEAR = (b"\xff" * 7 + bytes((code,)) for code in (0xFC, 0xFD, 0xFE, 0xFB))


class Bench:
    """A drive, booted; `ask` sends a frame and returns the answers."""

    def __init__(self, build=build_mit, **settings):
        self.drive: Controller = build(
            {"node_id": 1, **settings}, ControllerContext("it", Path(), 1)
        )
        self.now_ns = 0
        self.drive.start(0)
        self.run(100)

    def run(self, ms: float) -> None:
        end_ns = self.now_ns + round(ms * MS)
        due_ns = self.drive.next_deadline_ns()
        while due_ns is not None and due_ns <= end_ns:
            self.drive.expire(due_ns)
            due_ns = self.drive.next_deadline_ns()
        self.now_ns = end_ns

    def ask(self, data: bytes | str, can_id: int = 1) -> list[tuple[int, bytes]]:
        data = bytes.fromhex(data) if isinstance(data, str) else data
        frame = can_id.to_bytes(4, "little") + bytes((len(data), 0, 0, 0)) + data.ljust(8, b"\0")
        self.drive.receive(frame, self.now_ns)
        out = self.drive.take_output()
        return [(int.from_bytes(one[:4], "little"), one[8 : 8 + one[4]]) for one in out]

    def truth(self) -> dict[str, float]:
        return dict(self.drive.snapshot(self.now_ns))

    def events(self) -> str:
        return " ".join(text for _, text in self.drive.take_events())


def robstride(**settings) -> Bench:
    return Bench(build_robstride, **settings)
