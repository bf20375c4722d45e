"""Recorded Modbus unit, as a controller on an emulated line.

The unit answers a live host as the recorded unit answered the recorded host; see `TapePlayer`. A
request that the recording cannot answer is refused with an exception and reported as an error.

Source: MODBUS over Serial Line V1.02, section 2; Application Protocol V1.1b3, section 7.
"""

from collections.abc import Sequence
from typing import Final, final

from emulators.modbus.crc import crc16, with_crc
from harness.replay.player import TapePlayer
from harness.replay.recorded_controller import RecordedController
from traces.decode_modbus import ModbusDecoder
from traces.modbus import Adu
from traces.modbus_tapes import request_key, role_of
from traces.tape import Role, Sent, Tape

_SHORTEST: Final = 4
DEVICE_FAILURE: Final = 4
"""Exception code: server device failure."""


@final
class RecordedUnit(RecordedController):
    """Implementation of `emulators.controller.Controller` for a recorded Modbus unit.

    Args:
        tape: the exchange log of the unit.
        unit: its server address on this line.

    Attributes:
        player: holds the matched commands and the mismatches.
    """

    def __init__(self, tape: Tape, unit: int, note: str = "") -> None:
        super().__init__(TapePlayer(tape), "unit", note)
        self.unit: Final = unit

    def receive(self, data: bytes, now_ns: int) -> None:
        """Handle the bytes between two silences on the line; b"": they were corrupted."""
        if len(data) < _SHORTEST or crc16(data[:-2]) != data[-2:]:
            return
        if data[0] not in (0, self.unit):
            return
        pdu = data[1:-2]
        key = request_key(pdu)
        is_command = role_of(pdu) is Role.COMMAND
        step = self.player.command(key, now_ns) if is_command else self.player.poll(key, now_ns)
        if step is not None:
            if data[0] and step.turns:
                self.player.answer(step.turns[0].answers, now_ns)
        else:
            adu = Adu(now_ns, None, True, 0, data[0], pdu)
            mismatch = self.player.refuse(key, ModbusDecoder().decode(adu).text, now_ns)
            self._events.append(("error", str(mismatch)))
            if data[0]:
                refusal = bytes([self.unit, pdu[0] | 0x80, DEVICE_FAILURE])
                self.player.answer([Sent(0, refusal)], now_ns)
        self.expire(now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the frames that are due."""
        address = bytes([self.unit])  # the recording may have another address
        self._output += [with_crc(address + frame[1:]) for frame in self.player.take(now_ns)]

    def identifiers(self) -> Sequence[int] | None:
        """Return None: every unit on a line hears everything."""
        return None
