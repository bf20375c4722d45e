"""One emulated CAN drive alone: frames in and out as text, time by hand."""

from pathlib import Path

from motorhil.emulators.controller import ControllerContext

MS = 1_000_000
EXTENDED = 0x8000_0000


class CanBench:
    """A drive without a bus; `heard` has (time [ms], identifier, data in hexadecimal digits)."""

    def __init__(self, build, **table):
        table = {"plant": {"preset": "wheel_60w"}, **table}
        self.drive = build(table, ControllerContext(name="drive", folder=Path(), seed=1))
        self.now_ns = 0
        self.heard = []
        self.events = []
        self.drive.start(0)
        self._collect()

    def run(self, ms):
        """Let time pass, deadline by deadline."""
        end_ns = self.now_ns + round(ms * MS)
        while (due_ns := self.drive.next_deadline_ns()) is not None and due_ns <= end_ns:
            self.now_ns = max(self.now_ns, due_ns)
            self.drive.expire(self.now_ns)
            self._collect()
        self.now_ns = end_ns
        return self

    def tell(self, can_id, data="", flags=0):
        """Send a frame to the drive; an identifier above 7FFh needs the flag EXTENDED."""
        payload = bytes.fromhex(data)
        frame = (can_id | flags).to_bytes(4, "little") + bytes((len(payload), 0, 0, 0))
        self.drive.receive(frame + payload.ljust(8, b"\0"), self.now_ns)
        self._collect()
        return self

    def ask(self, can_id, data="", flags=0):
        """Send a frame, and return what the drive sends at once: (identifier, data)."""
        before = len(self.heard)
        self.tell(can_id, data, flags)
        return [(one, told) for _, one, told in self.heard[before:]]

    def true(self, what):
        """Return a true value of the drive now."""
        return self.drive.snapshot(self.now_ns)[what]

    def stimulate(self, name, value):
        """Set a physical input."""
        self.drive.stimulate(name, value, self.now_ns)
        self._collect()
        return self

    def _collect(self):
        for frame in self.drive.take_output():
            can_id = int.from_bytes(frame[:4], "little") & 0x1FFF_FFFF
            self.heard.append((self.now_ns / MS, can_id, frame[8 : 8 + frame[4]].hex()))
        self.events += self.drive.take_events()
