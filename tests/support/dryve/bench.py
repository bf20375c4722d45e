"""A dryve D1 on its Modbus TCP line in virtual time, with a host's raw telegrams."""

from pathlib import Path

from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.dryve.drive import build
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

MS = 1_000_000
PLANT = {"preset": "wheel_60w", "gear_ratio": 1.0, "load_inertia_kg_m2": 1e-5}


class Bench:
    """A booted drive; the host's end is `ask`, `read` and `write`."""

    def __init__(self, boot=True, **table):
        self.world = World(EventQueue())
        self.world.add_tcp(BytePipe("line"), None)
        settings = {"unit": 1, "plant": PLANT, **table}
        drive = build(settings, ControllerContext("drive", Path(), 1))
        self.world.add_controller("drive", drive, "line")
        self.heard = []
        self._host = self.world.add_line_host("line", "host", self._hear)
        if boot:
            self.run_ms(400)

    def _hear(self, data, now_ns, transmitted):
        if not transmitted:
            self.heard.append(data)

    def run_ms(self, time_ms):
        self.world.queue.run_until(self.world.queue.now_ns + round(time_ms * MS))
        return self

    def ask(self, telegram, time_ms=5.0):
        """Send a telegram in hexadecimal digits, and return what comes back, likewise."""
        self.heard.clear()
        self._host.send(bytes.fromhex(telegram))
        self.run_ms(time_ms)
        return b"".join(self.heard).hex().upper()

    def read(self, index, count, subindex=0):
        """Return the data of an object, or the exception as hexadecimal digits."""
        head = "0000 0000 000D 00 2B 0D 00 00 00"
        answer = self.ask(f"{head} {index:04X} {subindex:02X} 0000 00 {count:02X}")
        return answer[38:] if answer[14:16] == "2B" else answer[14:]

    def write(self, index, data, subindex=0):
        """Write an object; return "" or the exception."""
        count = len(bytes.fromhex(data))
        head = f"0000 0000 {13 + count:04X} 00 2B 0D 01 00 00"
        answer = self.ask(f"{head} {index:04X} {subindex:02X} 0000 00 {count:02X} {data}")
        return answer[38:] if answer[14:16] == "2B" else answer[14:]

    def status(self):
        """Return the data bytes of 6041h."""
        return self.read(0x6041, 2)

    def position(self):
        """Return 6064h."""
        return int.from_bytes(bytes.fromhex(self.read(0x6064, 4)), "little", signed=True)

    def enable(self):
        """Enable operation as the maker's sample program does."""
        for word in ("06 00", "07 00", "0F 00"):
            self.write(0x6040, word)
            self.run_ms(30)

    def stimulate(self, name, value):
        self.world.stimulate("drive", name, value)

    def true(self, what):
        return self.world.snapshot("drive")[what]
