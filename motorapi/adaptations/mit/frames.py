"""Frames of five numbers: MIT's, as mini cheetah, CubeMars AK and Damiao have them.

A request has p (16 bits), v, kp, kd and t (12 each). An answer has the drive's number, p, v and t.
CubeMars adds temperature and fault, Damiao two temperatures, the mini cheetah the bus voltage.
Damiao's number has the state, too.

A code is linear over the range of its number. Ranges belong to a model and its firmware edition; a
wrong range scales without notice. The two codes next to 0 are read as 0, which has no code.

Source: CubeMars, AK Series Manual 1.0.8, p. 48 and 49; cmjang/DM_Control_Python; openarm_can; the
client robstride 0.1.0.
"""

from collections.abc import Iterable
from enum import Enum
from typing import Final, NamedTuple, final

from motorhil.motorapi.api import texts_of


class Ranges(NamedTuple):
    """The largest position [rad], velocity [rad/s], torque [N m], kp and kd."""

    p: float
    v: float
    t: float
    kp: float = 500.0
    kd: float = 5.0


class Command(NamedTuple):
    """torque = kp (p - position) + kd (v - velocity) + t, in SI units at the output."""

    p: float = 0.0
    v: float = 0.0
    kp: float = 0.0
    kd: float = 0.0
    t: float = 0.0


class Answer(NamedTuple):
    """An answer: position, velocity, torque; is_on: None if it does not tell; fault: 0 is none."""

    p: float
    v: float
    t: float
    is_on: bool | None
    fault: int


@final
class Special(Enum):
    """A request that is not a command, by its last byte in MIT frames."""

    CLEAR = 0xFB
    ENTER = 0xFC
    LEAVE = 0xFD
    ZERO = 0xFE


@final
class Maker(Enum):
    """A family of firmware: duration of setting the zero [s]; its faults by code."""

    MINI_CHEETAH = (0.1, dict[int, str]())
    CUBEMARS = (
        1.5,
        {
            **{1: "over temperature", 2: "over current", 3: "over voltage", 4: "under voltage"},
            **{5: "encoder", 6: "phase currents unbalanced"},
        },
    )
    DAMIAO = (
        0.1,
        {
            **{8: "over voltage", 9: "under voltage", 0xA: "over current"},
            **{0xB: "MOSFET over temperature", 0xC: "rotor over temperature"},
            **{0xD: "communication lost", 0xE: "overload"},
        },
    )
    ROBSTRIDE = (
        0.1,
        {
            **{1: "under voltage", 2: "over current", 4: "over temperature"},
            **{8: "magnetic encoder", 16: "hall encoder", 32: "not calibrated"},
        },
    )

    def __init__(self, zero_s: float, faults: dict[int, str]) -> None:
        self.zero_s = zero_s
        self.faults = faults

    def text_of(self, code: int) -> str:
        """Return the text of a fault, or of several."""
        return self.faults.get(code) or texts_of(code, self.faults)

    def has_fault(self, code: int) -> bool:
        """Return whether its drives can report this; RobStride reports several by their sum."""
        several = sum(self.faults) if self is Maker.ROBSTRIDE else 0
        return code in (0, *self.faults) or (bool(several) and not code & ~several)


_AK: Final = (
    *(
        ("80_6_v1_1", 22.5, 12),
        ("80_6_v2", 76, 12),
        ("80_9_v1_1", 22.5, 18),
        ("80_9_v2", 25.64, 18),
    ),
    *(("70_10", 50, 24), ("10_9", 50, 65), ("60_6", 50, 15), ("80_64", 8, 144)),
)
_DM: Final = (
    *(("4310", 30, 10), ("4310_48v", 50, 10), ("4340", 8, 28), ("4340_48v", 10, 28)),
    *(("6006", 45, 20), ("8006", 45, 40), ("8009", 45, 54), ("10010l", 25, 200)),
    *(("10010", 20, 200), ("h3510", 280, 1), ("g62xx", 45, 10)),
)
MODELS: Final[dict[str, tuple[Maker, Ranges]]] = {
    "mini_cheetah": (Maker.MINI_CHEETAH, Ranges(12.5, 65, 40)),
    "ak80_6_v1": (Maker.CUBEMARS, Ranges(95.5, 45, 18)),
    **{f"ak{name}": (Maker.CUBEMARS, Ranges(12.5, v, t)) for name, v, t in _AK},
    **{f"dm{name}": (Maker.DAMIAO, Ranges(12.5, v, t)) for name, v, t in _DM},
}


def code_of(value: float, low: float, high: float, bits: int) -> int:
    """Return the nearest code of a value, limited to the range."""
    top = (1 << bits) - 1
    return min(max(round((value - low) * top / (high - low)), 0), top)


def value_of(code: int, limit: float, bits: int) -> float:
    """Return the value of a code over -limit..limit; the two codes next to 0 are 0."""
    top = (1 << bits) - 1
    return 0.0 if 2 * code in (top - 1, top + 1) else code * 2.0 * limit / top - limit


class Frames:
    """The frames of one drive: identifier and data. Here MIT's, of eight bytes.

    Args:
        node_id: identifier of requests.
        master_id: identifier of answers.
        maker: its firmware.
        ranges: those of its model.
    """

    def __init__(self, node_id: int, master_id: int, maker: Maker, ranges: Ranges) -> None:
        self.node_id: Final = node_id
        self.master_id: Final = master_id
        self.maker: Final = maker
        self.ranges: Final = ranges

    def command(self, command: Command) -> tuple[int, bytes]:
        """Return the frame of a command."""
        r = self.ranges
        bits = code_of(command.p, -r.p, r.p, 16)
        for value, low, high in (
            *((command.v, -r.v, r.v), (command.kp, 0.0, r.kp), (command.kd, 0.0, r.kd)),
            (command.t, -r.t, r.t),
        ):
            bits = bits << 12 | code_of(value, low, high, 12)
        return self.node_id, bits.to_bytes(8, "big")

    def special(self, special: Special) -> tuple[int, bytes]:
        """Return the frame of a special request."""
        return self.node_id, b"\xff" * 7 + bytes((special.value,))

    def answers(self) -> Iterable[int]:
        """Return the identifiers of answers."""
        return (self.master_id,)

    def more_answers(self, can_id: int) -> Iterable[int]:
        """Return the identifiers of further answers, after a frame that shows another host."""
        return ()

    def requests(self) -> Iterable[int]:
        """Return the identifiers of requests that are handled if other programs send them."""
        return (self.node_id,)

    def answer(self, can_id: int, data: bytes) -> Answer | str:
        """Return the answer in a frame; or, in words, another one on this identifier."""
        is_damiao = self.maker is Maker.DAMIAO
        if len(data) < (8 if is_damiao else 6):
            return f"an answer of {len(data)} bytes, too short for this model"
        mask = 0xF if is_damiao else 0xFF
        if data[0] & mask != self.node_id & mask:
            return f"motor {data[0] & mask}"
        bits, r = int.from_bytes(data[1:6], "big"), self.ranges
        state = data[0] >> 4 if is_damiao else data[7] if len(data) == 8 else 0
        return Answer(
            value_of(bits >> 24, r.p, 16),
            value_of(bits >> 12 & 0xFFF, r.v, 12),
            value_of(bits & 0xFFF, r.t, 12),
            state == 1 if is_damiao else None,
            0 if is_damiao and state <= 1 else state,
        )

    def asked(self, can_id: int, data: bytes) -> Special | bool:
        """Return what a request asks for; True: any command but to be limp, which only reads."""
        bits = int.from_bytes(data.ljust(8, b"\0"), "big")
        if bits >> 8 == (1 << 56) - 1 and data[7] in {one.value for one in Special}:
            return Special(data[7])
        return bool(bits >> 12 & 0xFFFFFF) or bits & 0xFFF not in (0x7FF, 0x800)
