"""RobStride and CyberGear: their frames, and the builder of such a motor.

Identifier: type (bits 28 to 24), 16 bits of data, target. The data of a command are p, v, kp and
kd, its torque is in the identifier. Feedback has mode and faults in its identifier.

Source: the client robstride 0.1.0.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from math import pi
from typing import ClassVar, Final, final

from motorhil.motorapi.adaptations.mit.frames import (
    Answer,
    Command,
    Frames,
    Maker,
    Ranges,
    Special,
    code_of,
    value_of,
)
from motorhil.motorapi.adaptations.mit.hardware import MitHwMotor, MitOptions
from motorhil.motorapi.adaptations.mit.motor import MitMotor
from motorhil.motorapi.api import REQUIRED, CanBuilder, adaptation, text, whole, word

ROBSTRIDES: Final = {
    "cybergear": Ranges(4 * pi, 30, 12),
    "rs00": Ranges(4 * pi, 33, 14),
    "rs01": Ranges(4 * pi, 44, 17),
    "rs04": Ranges(4 * pi, 15, 120, 5000, 100),
    "rs05": Ranges(4 * pi, 50, 5.5),
}
_COMMAND, _FEEDBACK = 1 << 24, 2 << 24
_TYPES: Final = {Special.ENTER: 3, Special.LEAVE: 4, Special.CLEAR: 4, Special.ZERO: 6}
_WRITE: Final = 18
_NAMING: Final = (3, 4, 6, _WRITE)  # types of requests that name their host
_REFERENCES: Final = (0x7005, 0x7006, 0x700A, 0x7016)  # parameters: run mode, and what moves in it
_RUN: Final = 2
_FACTORY_HOST: Final = 0xFD


@final
class RobstrideFrames(Frames):
    """The frames of one drive; `master_id` is the number of the host.

    Commands do not name their host: a drive answers the one whose request was the last, at first
    the factory's. Answers to others are heard without faults, and with all once one has come.
    """

    def __init__(self, node_id: int, master_id: int, maker: Maker, ranges: Ranges) -> None:
        super().__init__(node_id, master_id, maker, ranges)
        self._hosts = dict.fromkeys((master_id, _FACTORY_HOST))

    def command(self, command: Command) -> tuple[int, bytes]:
        """Return the frame of a command."""
        r = self.ranges
        torque = code_of(command.t, -r.t, r.t, 16)
        codes = (
            *(code_of(command.p, -r.p, r.p, 16), code_of(command.v, -r.v, r.v, 16)),
            *(code_of(command.kp, 0.0, r.kp, 16), code_of(command.kd, 0.0, r.kd, 16)),
        )
        data = b"".join(code.to_bytes(2, "big") for code in codes)
        return _COMMAND | torque << 8 | self.node_id, data

    def special(self, special: Special) -> tuple[int, bytes]:
        """Return the frame of a special request."""
        first = special in (Special.CLEAR, Special.ZERO)
        return self._id(_TYPES[special], self.master_id), bytes((first, 0, 0, 0, 0, 0, 0, 0))

    def answers(self) -> Iterable[int]:
        """Return the identifiers of feedback: each mode, each set of faults, to known hosts.

        The first one is that of a drive that runs without a fault.
        """
        modes = (_RUN, 0, 1)
        known = product(self._hosts, modes, range(64))
        unknown = (host for host in range(256) if host not in self._hosts)
        others = product(unknown, modes, (0,))
        place = _FEEDBACK | self.node_id << 8
        states = (*known, *others)
        return (place | mode << 22 | faults << 16 | host for host, mode, faults in states)

    def more_answers(self, can_id: int) -> Iterable[int]:
        """Return the identifiers of feedback to the host of a frame, if it was not known."""
        host = can_id & 0xFF if can_id >> 24 == _FEEDBACK >> 24 else can_id >> 8 & 0xFF
        if host in self._hosts:
            return ()
        self._hosts[host] = None
        return self.answers()

    def requests(self) -> Iterable[int]:
        """Return the identifiers of requests of other hosts, except commands."""
        return (self._id(kind, host) for kind, host in product(_NAMING, range(256)))

    def answer(self, can_id: int, data: bytes) -> Answer | str:
        """Return the answer in a frame; in words, if it has the wrong length."""
        if len(data) != 8:
            return f"an answer of {len(data)} bytes, not 8"
        p, v, t = (int.from_bytes(data[at : at + 2], "big") for at in (0, 2, 4))
        r, is_on = self.ranges, can_id >> 22 & 3 == _RUN
        values = value_of(p, r.p, 16), value_of(v, r.v, 16), value_of(t, r.t, 16)
        return Answer(*values, is_on, can_id >> 16 & 0x3F)

    def asked(self, can_id: int, data: bytes) -> Special | bool:
        """Return what a request asks for."""
        if can_id >> 24 == _WRITE:
            return int.from_bytes(data[:2], "little") in _REFERENCES
        return {3: Special.ENTER, 4: Special.LEAVE, 6: Special.ZERO}[can_id >> 24]

    def _id(self, kind: int, host: int) -> int:
        return kind << 24 | host << 8 | self.node_id


@dataclass(frozen=True, slots=True, kw_only=True)
class RobstrideOptions(MitOptions):
    """The options of a hardware object of a RobStride or CyberGear drive."""

    drive: str = word("rs01", ROBSTRIDES, "model", "Its model, which determines the ranges.")
    host_id: int = whole(_FACTORY_HOST, 0, 0xFF, "", "Number of this host.")

    def frames(self, node_id: int) -> Frames:
        """Return the frames of the drive with this number."""
        ranges = self.ranges(ROBSTRIDES[self.drive])
        return RobstrideFrames(node_id, self.host_id, Maker.ROBSTRIDE, ranges)


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RobstrideTable(RobstrideOptions):
    """A motor behind a RobStride or CyberGear drive."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Number of the motor.", example="1")
    drive: str = word(REQUIRED, ROBSTRIDES, "model", "Its model, which determines the ranges.")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class RobstrideHwMotor(MitHwMotor):
    """One RobStride or CyberGear drive; see `MitHwMotor`."""

    OPTIONS: type[MitOptions] = RobstrideOptions
    EXTENDED: ClassVar[bool] = True


build: Final = adaptation(api=1)(CanBuilder(RobstrideTable, RobstrideHwMotor, MitMotor))
