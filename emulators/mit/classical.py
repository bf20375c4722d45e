"""MIT frames of eight bytes: the mini cheetah's firmware, CubeMars AK, Damiao.

A command holds p (16 bits), v, kp, kd and t (12 each), most significant bit first. FFh seven times
and a code from FBh on are special, although they are also legal commands. Every frame has one
answer, with the state before it acted.

| firmware     | answer: number, p 16, v 12, t 12, then                   | zero         |
| ------------ | -------------------------------------------------------- | ------------ |
| mini cheetah | the DC link's voltage; values out of range overflow      | at rest only |
| CubeMars     | temperature, fault                                       | any time     |
| Damiao       | two temperatures; the number holds the state as well     | any time     |

Damiao's drives have parameters at 7FFh. Not emulated: their modes 2 to 4, storing, and the servo
mode of CubeMars.

Source: bgkatz/motorcontrol, Core/Src/{can,fsm,stm32f4xx_it}.c; CubeMars, AK Series Manual 1.0.8,
p. 48 and 49; cmjang/DM_Control_Python.
"""

from collections.abc import Sequence
from struct import Struct
from typing import Final, final

from motorhil.emulators.api import ControllerContext, drive_builder, to_code, truncated
from motorhil.emulators.mit.drive import MitDrive
from motorhil.emulators.mit.settings import DAMIAO, MINI_CHEETAH, MODELS, MitTable, Ranges

SPECIAL: Final = b"\xff" * 7
CLEAR, ENTER, LEAVE, ZERO = range(0xFB, 0xFF)
PARAMETERS: Final = 0x7FF
READ, WRITE, STORE, ASK = 0x33, 0x55, 0xAA, 0xCC
MASTER_ID, ESC_ID, TIMEOUT, MODE, GEAR, P_MAX, V_MAX, T_MAX = 7, 8, 9, 10, 20, 21, 22, 23
FAULT_OF_TIMEOUT: Final = 0xD
_MIT_MODE: Final = 1
_TICK_NS: Final = 50_000  # of TIMEOUT
_BUS_V_MAX: Final = 80.0
_PARAMETER: Final = Struct("<HBB")
_FLOAT: Final = Struct("<f")
_WHOLE: Final = (MASTER_ID, ESC_ID, TIMEOUT, MODE, 13, 14, 15, 16)


@final
class ClassicalDrive(MitDrive):
    """Implements `motorhil.emulators.api.Controller`."""

    def __init__(self, table: MitTable, context: ControllerContext) -> None:
        super().__init__(table, MODELS[table.model], context)
        self._master_id: int = table.master_id
        self._length: Final = table.answer_bytes or self.firmware.answer_bytes
        self._gear: Final = self.plant.gear_ratio

    def identifiers(self) -> Sequence[int] | None:
        """Return the identifier of requests; Damiao's also that of parameters."""
        return [self.node_id, *([PARAMETERS] if self.firmware is DAMIAO else [])]

    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a request; the answer precedes the effect."""
        if can_id != self.node_id:
            self._parameter(data)
            return
        if len(data) != 8:
            self.warn(f"request of {len(data)} bytes is ignored; expected 8")
            return
        self._answer()
        if data[:7] == SPECIAL and data[7] in range(CLEAR, ZERO + 1):
            self._special(data[7])
            return
        bits = int.from_bytes(data, "big")
        self.order_codes((bits >> 48, *(bits >> at & 0xFFF for at in (36, 24, 12, 0))), 12)

    def timed_out(self) -> None:
        """Make the motor limp; Damiao's drives have a fault."""
        if self.firmware is DAMIAO:
            self.fail(FAULT_OF_TIMEOUT)
        else:
            super().timed_out()

    def _special(self, code: int) -> None:
        if code == ENTER:
            self.enable()
        elif code == LEAVE:
            self.leave()
        elif code == ZERO and self.is_on and self.firmware is MINI_CHEETAH:
            self.warn("zero not set: the drive is in motor mode; leave it first")
        elif code == ZERO:
            self.set_zero()
        elif self.firmware is DAMIAO:
            self.clear()

    def _answer(self) -> None:
        saturates = self.firmware is not MINI_CHEETAH
        p_code, v_code, t_code = self.measured_codes(12, saturates=saturates)
        stage_c, winding_c = (truncated(c, 8, signed=False) for c in self.temperatures_c())
        number, tail = self.node_id, (stage_c, self.fault)
        if self.firmware is DAMIAO:
            number = (self.fault or self.is_on) << 4 | number & 0xF
            tail = (stage_c, winding_c)
        elif self.firmware is MINI_CHEETAH:
            tail = (to_code(self.axis.dc_link_v(), _BUS_V_MAX, 8, 0.0), 0)
        state = (p_code >> 8, p_code, v_code >> 4, (v_code << 4) + (t_code >> 8), t_code)
        data = bytes(byte & 0xFF for byte in (number, *state, *tail))
        self.send(self._master_id, data[: self._length])

    # --- Damiao's parameters -----------------------------------------------------------------

    def _parameter(self, data: bytes) -> None:
        """Handle a frame to 7FFh: node number, operation, parameter, value."""
        if len(data) < _PARAMETER.size:
            return
        node_id, operation, number = _PARAMETER.unpack_from(data)
        if node_id != self.node_id:
            return
        if operation == ASK:
            self._answer()
        elif operation == STORE or operation not in (READ, WRITE):
            self.warn(f"operation {operation:02X}h on parameters is not emulated")
        else:
            if operation == WRITE and len(data) == 8:
                self._write(number, data[4:])
            value = self._parameters().get(number)
            if value is None:
                self.warn(f"parameter {number} is not emulated")
                return
            told = round(value).to_bytes(4, "little") if number in _WHOLE else _FLOAT.pack(value)
            self.send(self._master_id, _PARAMETER.pack(node_id, operation, number) + told)

    def _parameters(self) -> dict[int, float]:
        ranges = self.ranges
        return {
            **{MASTER_ID: self._master_id, ESC_ID: self.node_id, MODE: _MIT_MODE},
            **{TIMEOUT: self.watchdog_ns / _TICK_NS, GEAR: self._gear, 14: 1},
            **{P_MAX: ranges.p, V_MAX: ranges.v, T_MAX: ranges.t},
        }

    def _write(self, number: int, data: bytes) -> None:
        raw, value = int.from_bytes(data, "little"), _FLOAT.unpack(data)[0]
        if number == MASTER_ID and raw <= 0x7FF:
            self._master_id = raw
        elif number == TIMEOUT:
            self.watchdog_ns: int = raw * _TICK_NS
        elif number in (P_MAX, V_MAX, T_MAX) and 0.0 < value <= 1e6:
            name = {P_MAX: "p", V_MAX: "v", T_MAX: "t"}[number]
            self.ranges: Ranges = self.ranges._replace(**{name: value})
        else:
            self.warn(f"parameter {number} = {data.hex()} is refused")


build: Final = drive_builder(MitTable, ClassicalDrive, api=1)
