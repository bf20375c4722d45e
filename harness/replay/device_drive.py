"""Recorded drives with a protocol of their own, as controllers on a CAN bus or a serial line.

They answer each request as the recorded drive did; see `ExchangePlayer`. A request that the
recording cannot answer is reported as an error. A servo refuses it, by a status; the protocols on
CAN have no refusal, so that no answer comes.

Source: the maker's manual of Protocol 2.0, error 1 of a status: the instruction could not be done.
"""

from collections.abc import Sequence
from typing import Final, final

from motorhil.emulators.dynamixel.packets import Error, status
from motorhil.harness.replay.player import ExchangePlayer
from motorhil.harness.replay.recorded_controller import RecordedController, timed_log
from motorhil.traces.can_frame import ERR, RTR
from motorhil.traces.decoding.dynamixel import Packets, unit_of
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.exchange.drive_kinds import Decode, Read, Told
from motorhil.traces.exchange.drives import drive_key, packet_key, role_of
from motorhil.traces.exchange.steps import ExchangeLog, Key, Role, Sent


class _Drive(RecordedController):
    """The common part of recorded drives.

    Args:
        log: the exchange log of the drive.
        readers: decoder and meaning of its messages.
        note: a remark about the recording, reported at power-on.
        any_set_point: True to ignore the content of motions.
    """

    def __init__(
        self, log: ExchangeLog, readers: tuple[Decode, Read], note: str, any_set_point: bool
    ) -> None:
        super().__init__(ExchangePlayer(log), "drive", note)
        self._decode, self._read = readers
        self._any_set_point = any_set_point

    def _answer(self, key: Key, message: BusMessage, told: Told, now_ns: int) -> bool:
        """Answer a message to the drive as recorded; return False if there is no such message."""
        if role_of(told) is Role.COMMAND:
            step = self.player.command(key, now_ns)
        else:  # a host that streams polls at other places than the recorded one
            step = self.player.poll(key, now_ns) or self.player.nearest(key)
        if step is None:
            mismatch = self.player.refuse(key, str(message), now_ns)
            self._events.append(("error", str(mismatch)))
            return False
        if step.turns:
            self.player.answer(step.turns[0].answers, now_ns)
        return True

    def expire(self, now_ns: int) -> None:
        """Send the frames that are due."""
        self._output += self.player.take(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return None: its kind decides by content, too."""
        return None


@final
class RecordedDrive(_Drive):
    """Implementation of `motorhil.emulators.controller.Controller` for a drive on a CAN bus.

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
        super().__init__(timed, readers, "; ".join(notes), any_set_point)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle a frame that was on the bus."""
        if int.from_bytes(data[:4], "little") & (ERR | RTR):
            return
        message = self._decode(data)
        told = None if message is None else self._read(data, message)
        if message is not None and told is not None and not told.is_own:
            self._answer(drive_key(data, told, self._any_set_point), message, told, now_ns)
        self.expire(now_ns)


@final
class RecordedServo(_Drive):
    """Implementation of `motorhil.emulators.controller.Controller` for a drive on a serial line.

    Args:
        log: the exchange log of the drive.
        unit: its id.
        readers: decoder and meaning of its packets.
        note: a remark about the recording, reported at power-on.
        any_set_point: True to ignore the values of motions.
    """

    def __init__(
        self,
        log: ExchangeLog,
        unit: int,
        readers: tuple[Decode, Read],
        note: str = "",
        any_set_point: bool = False,
    ) -> None:
        super().__init__(log, readers, note, any_set_point)
        self.unit: Final = unit
        self._packets: Final = Packets()

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle characters that were on the line."""
        for packet in self._packets.feed(data):
            message = self._decode(packet)
            if message is None or message.problem:
                continue
            told = self._read(packet, message)
            if told.is_own:  # of another device with this id
                continue
            key = packet_key(message, told, self._any_set_point)
            is_known = self._answer(key, message, told, now_ns)
            if not is_known and unit_of(packet) == self.unit:
                self.player.answer([Sent(0, status(self.unit, Error.RESULT_FAIL))], now_ns)
        self.expire(now_ns)
