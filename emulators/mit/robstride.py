"""RobStride's and CyberGear's variant: the same five numbers, in extended frames.

Identifier: type (bits 28 to 24), 16 bits of data, target. All codes have 16 bits, most significant
first. The torque of a command is in the identifier. Feedback (type 2) answers commands and
settings; its identifier holds mode and faults. Values of parameters are little endian.

Not emulated: fault reports (type 21) by themselves, run mode csp.

Source: robstride 0.1.0 (client.py); maker's manual as told by public drivers.
"""

from collections.abc import Sequence
from math import isfinite
from struct import Struct
from typing import ClassVar, Final, final

from motorhil.emulators.api import EFF_FLAG, ControllerContext, drive_builder
from motorhil.emulators.mit.drive import MitDrive
from motorhil.emulators.mit.settings import ROBSTRIDES, RobstrideTable

GET_ID, MOTION, FEEDBACK, ENABLE, STOP, ZERO, SET_ID = 0, 1, 2, 3, 4, 6, 7
READ, WRITE = 17, 18
RUN_MODE, IQ_REF, SPD_REF, LIMIT_TORQUE = 0x7005, 0x7006, 0x700A, 0x700B
LOC_REF, LIMIT_SPD, LIMIT_CUR = 0x7016, 0x7017, 0x7018
MECHPOS, IQF, MECHVEL, VBUS = 0x7019, 0x701A, 0x701B, 0x701C
_FOUR: Final = Struct(">4H")
_INDEX: Final = Struct("<HH")
_FLOAT: Final = Struct("<f")
_RUN: Final = 2
_STEEP: Final = 1e4  # ramps of position and speed modes [rad/s^2]
_SERIAL: Final = b"motorhil"


@final
class RobstrideDrive(MitDrive):
    """Implements `motorhil.emulators.api.Controller`."""

    FLAG: ClassVar[int] = EFF_FLAG

    def __init__(self, table: RobstrideTable, context: ControllerContext) -> None:
        super().__init__(table, ROBSTRIDES[table.model], context)
        self._host = 0xFD  # the last one that told its number; a command does not
        self._values: dict[int, float] = {
            **dict.fromkeys((RUN_MODE, IQ_REF, SPD_REF, LOC_REF), 0.0),
            **{LIMIT_SPD: 2.0, LIMIT_CUR: self.plant.current_max_a, LIMIT_TORQUE: self.ranges.t},
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return None: the target is in the lower bits of any identifier."""
        return None

    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a frame to this drive."""
        kind, area, target = can_id >> 24, can_id >> 8 & 0xFFFF, can_id & 0xFF
        if target != self.node_id or kind == FEEDBACK:
            return
        if len(data) != 8:
            self.warn(f"type {kind} with {len(data)} bytes is ignored; expected 8")
        elif kind == GET_ID:
            self.send(self.node_id << 8 | 0xFE, _SERIAL)
        elif kind == READ:
            self._read(data, area & 0xFF)
        elif kind == SET_ID:
            self.node_id: int = area >> 8
            self.renumber()
            self.send(self.node_id << 8 | 0xFE, _SERIAL)
        elif kind in (MOTION, ENABLE, STOP, ZERO, WRITE):
            if kind != MOTION:
                self._host = area & 0xFF
            self._feedback()
            self._obey(kind, area, data)
        else:
            self.warn(f"frames of type {kind} are not emulated")

    def _obey(self, kind: int, area: int, data: bytes) -> None:
        if kind == MOTION:
            if not self._values[RUN_MODE]:
                self.order_codes((*_FOUR.unpack(data), area), 16)
        elif kind == ENABLE:
            self.enable()
            self._run()
        elif kind == STOP:
            self.leave()
            if data[0] == 1:
                self.clear()
        elif kind == ZERO and data[0] == 1:
            self.set_zero()
        elif kind == WRITE:
            self._write(data)

    def _feedback(self) -> None:
        decidegrees = min(max(round(10.0 * self.temperatures_c()[1]), 0), 0xFFFF)
        mode = _RUN if self.is_on else 0
        can_id = FEEDBACK << 24 | mode << 22 | self.fault << 16 | self.node_id << 8 | self._host
        self.send(can_id, _FOUR.pack(*self.measured_codes(16), decidegrees))

    # --- parameters --------------------------------------------------------------------------

    def _read(self, data: bytes, host: int) -> None:
        index = _INDEX.unpack_from(data)[0]
        p, v, _ = self.measured()
        axis = self.axis
        measured = {MECHPOS: p, MECHVEL: v, IQF: axis.current_a(), VBUS: axis.dc_link_v()}
        value = {**self._values, **measured}.get(index)
        if value is None:
            self.warn(f"parameter {index:04X}h is not emulated")
            return
        told = bytes((int(value), 0, 0, 0)) if index == RUN_MODE else _FLOAT.pack(value)
        self.send(READ << 24 | self.node_id << 8 | host, _INDEX.pack(index, 0) + told)

    def _write(self, data: bytes) -> None:
        index = _INDEX.unpack_from(data)[0]
        value = float(data[4]) if index == RUN_MODE else _FLOAT.unpack_from(data, 4)[0]
        if index not in self._values or not isfinite(value):
            self.warn(f"parameter {index:04X}h = {data[4:].hex()} is refused")
        elif index == RUN_MODE and (value > 3 or self.is_on):
            self.warn(f"run mode {value:g} is refused; 0 to 3, while stopped")
        else:
            self._values[index] = value
            self._run()

    def _run(self) -> None:
        """Execute the references of run modes 1 to 3; mode 0 has commands."""
        mode, values, axis = self._values[RUN_MODE], self._values, self.axis
        if not self.is_on or not mode:
            return
        inc, steep = self.inc_rad, _STEEP * self.inc_rad
        axis.set_current_limit(abs(values[LIMIT_CUR]))
        if mode == 1:
            axis.move_to(round(values[LOC_REF] * inc), abs(values[LIMIT_SPD]) * inc, steep, steep)
        elif mode == 2:
            axis.run_at(values[SPD_REF] * inc, steep, steep)
        else:
            axis.follow_current(values[IQ_REF], 0)


build: Final = drive_builder(RobstrideTable, RobstrideDrive, api=1)
