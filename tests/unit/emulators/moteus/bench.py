"""A moteus alone, with frames by hand: its medium carries every frame at once."""

from pathlib import Path

import moteus

from motorhil.emulators.can.frame import EFF_FLAG, can_id_of, data_of, pack_fd
from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.moteus.drive import build

MS = 1_000_000
FREE = {"position_min_rev": "none", "position_max_rev": "none"}


class Bench:
    """The drive, the time [ns], and the library's client for it."""

    def __init__(self, **table) -> None:
        self.drive = build({**FREE, **table}, ControllerContext("drive", Path(), 1))
        self.now = 0
        self.client = moteus.Controller(id=table.get("node_id", 1), transport=object())
        self.drive.start(0)

    def run(self, ms: float) -> "Bench":
        """Let time pass, deadline by deadline."""
        end = self.now + round(ms * MS)
        while (due := self.drive.next_deadline_ns()) is not None and due <= end:
            assert due >= self.now
            self.now = due
            self.drive.expire(due)
        self.now = end
        return self

    def frame(self, frame: bytes) -> list[bytes]:
        """Pass a frame; return the replies."""
        self.drive.receive(frame, self.now)
        return list(self.drive.take_output())

    def send(self, can_id: int, data: bytes) -> bytes | None:
        """Send the data in a CAN FD frame; return the data of the reply, or None."""
        flag = EFF_FLAG if can_id > 0x7FF else 0
        size = next(one for one in (*range(9), 12, 16, 20, 24, 32, 48, 64) if one >= len(data))
        replies = self.frame(pack_fd(can_id | flag, data.ljust(size, b"\x50")))
        return data_of(replies[0]) if replies else None

    def tell(self, hex_data: str, can_id: int = 0x8001) -> str | None:
        """Send data in hex; return the reply in hex."""
        reply = self.send(can_id, bytes.fromhex(hex_data))
        return None if reply is None else reply.hex()

    def library(self, command) -> dict:
        """Send a command of the library; return the values that it reads in the reply."""
        can_id = (0x8000 if command.reply_required else 0) | command.source << 8
        reply = self.send(can_id | command.destination, command.data)
        if reply is None:
            return {}
        message = type("Message", (), {"arbitration_id": 0x100, "data": reply})
        return moteus.moteus.parse_message(message).values

    def read(self, *registers: int) -> list[float]:
        """Return registers, read as float by the library."""
        query = self.client.make_custom_query(dict.fromkeys(registers, moteus.F32))
        values = self.library(query)
        return [values[one] for one in registers]

    def mode(self) -> int:
        """Return the mode."""
        return int(self.read(0)[0])

    def position(self, **command) -> "Bench":
        """Command mode 10, with the library's arguments."""
        self.library(self.client.make_position(**command))
        return self

    def powered(self, **command) -> "Bench":
        """Command mode 10 without a watchdog, and wait until it is entered."""
        self.position(**{"position": float("nan"), "watchdog_timeout": float("nan"), **command})
        return self.run(15)


__all__ = ["FREE", "MS", "Bench", "can_id_of"]
