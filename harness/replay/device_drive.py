"""A recorded drive with a protocol of its own, as a controller on an emulated CAN bus.

It answers each request as the recorded drive did; see `ExchangePlayer`. These protocols have no
refusal: a request that the recording cannot answer gets no answer, and is reported as an error.
"""

from collections.abc import Sequence
from typing import final

from motorhil.harness.replay.player import ExchangePlayer
from motorhil.harness.replay.recorded_controller import RecordedController, timed_log
from motorhil.traces.can_frame import ERR, RTR
from motorhil.traces.exchange.drive_kinds import Decode, Read
from motorhil.traces.exchange.drives import drive_key, role_of
from motorhil.traces.exchange.steps import ExchangeLog, Role


@final
class RecordedDrive(RecordedController):
    """Implementation of `motorhil.emulators.controller.Controller` for a recorded drive.

    Args:
        log: the exchange log of the drive.
        readers: decoder and meaning of its messages.
        bit_ns: bit time [ns], from which the start of recorded frames is computed.
        note: a remark about the recording, reported at power-on.
        data_bit_ns: data bit time of CAN FD [ns]; 0: its recorded CAN FD frames are left out.
        any_set_point: True to ignore the content of motions.
    """

    def __init__(
        self,
        log: ExchangeLog,
        readers: tuple[Decode, Read],
        bit_ns: int,
        note: str = "",
        data_bit_ns: int = 0,
        any_set_point: bool = False,
    ) -> None:
        timed, left_out = timed_log(log, bit_ns, data_bit_ns)
        notes = [note] if note else []
        if left_out:
            notes.append(f"{left_out} CAN FD frames of node {log.number} are left out: classical")
        super().__init__(ExchangePlayer(timed), "drive", "; ".join(notes))
        self._decode, self._read = readers
        self._any_set_point = any_set_point

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame that was on the bus."""
        if int.from_bytes(data[:4], "little") & (ERR | RTR):
            return
        message = self._decode(data)
        told = None if message is None else self._read(data, message)
        if told is not None and not told.is_own:
            key = drive_key(data, told, self._any_set_point)
            if role_of(told) is Role.COMMAND:
                step = self.player.command(key, now_ns)
            else:  # a host that streams polls at other places than the recorded one
                step = self.player.poll(key, now_ns) or self.player.nearest(key)
            if step is None:
                mismatch = self.player.refuse(key, str(message), now_ns)
                self._events.append(("error", str(mismatch)))
            elif step.turns:
                self.player.answer(step.turns[0].answers, now_ns)
        self.expire(now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the frames that are due."""
        self._output += self.player.take(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return None: its kind decides by content, too."""
        return None
