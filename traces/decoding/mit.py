"""MIT frames and RobStride's frames in words, for `motorhil show`.

The values of a frame are codes over ranges, which a frame does not tell. With the controller's
table of a recorded rig the ranges are those of its model; without it, values are parts of the
range, from -1 to 1.
"""

from collections.abc import Callable, Mapping
from math import pi
from typing import Final

from motorhil.traces.can_frame import EFF, ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Signal

_DAMIAO: Final = {
    "dm4310": (30, 10),
    "dm4310_48v": (50, 10),
    "dm4340": (8, 28),
    "dm4340_48v": (10, 28),
    **{"dm6006": (45, 20), "dm8006": (45, 40), "dm8009": (45, 54)},
    **{"dm10010l": (25, 200), "dm10010": (20, 200), "dmh3510": (280, 1), "dmg62xx": (45, 10)},
}
_MODELS: Final[dict[str, tuple[float, float]]] = {  # velocity [rad/s], torque [N m]
    "mini_cheetah": (65, 40),
    **{"ak80_6_v1": (45, 18), "ak80_6_v1_1": (22.5, 12), "ak80_6_v2": (76, 12)},
    **{"ak80_9_v1_1": (22.5, 18), "ak80_9_v2": (25.64, 18), "ak70_10": (50, 24)},
    **{"ak10_9": (50, 65), "ak60_6": (50, 15), "ak80_64": (8, 144)},
    **_DAMIAO,
    **{"cybergear": (30, 12), "rs00": (33, 14), "rs01": (44, 17), "rs04": (15, 120)},
    "rs05": (50, 5.5),
}
_LONG: Final = {"ak80_6_v1": 95.5}
_KEYS: Final = ("p_max_rad", "v_max_rad_s", "t_max_n_m", "kp_max_n_m_rad", "kd_max_n_m_s_rad")
_UNITS: Final = ("rad", "rad/s", "N m", "N m/rad", "N m s/rad")
_NAMES: Final = ("p", "v", "t", "kp", "kd")
_SPECIAL: Final = {0xFB: "Clear_Errors", 0xFC: "Enter", 0xFD: "Leave", 0xFE: "Set_Zero"}
_OPERATIONS: Final = {0x33: "read", 0x55: "write", 0xAA: "store", 0xCC: "ask for the state"}
_STATES: Final = {0: "disabled", 1: "enabled", 8: "over voltage", 9: "under voltage"} | {
    **{0xA: "over current", 0xB: "MOSFET over temperature", 0xC: "rotor over temperature"},
    **{0xD: "communication lost", 0xE: "overload"},
}
_TYPES: Final = {0: "Get_Id", 1: "Motion", 2: "Feedback", 3: "Enable", 4: "Stop", 6: "Set_Zero"} | {
    **{7: "Set_Id", 17: "Read", 18: "Write", 21: "Fault"},
}

Decode = Callable[[bytes], BusMessage | None]


class _Scale:
    """The ranges of one drive."""

    def __init__(self, settings: Mapping[str, object], position: float, model: str) -> None:
        name = str(settings.get("model", model))
        velocity, torque = _MODELS.get(name, (1.0, 1.0))
        gains = (5000.0, 100.0) if name == "rs04" else (500.0, 5.0)
        known = (_LONG.get(name, position), velocity, torque, *gains)
        self._is_known: Final = bool(settings)
        self._limits: Final = [
            float(own) if isinstance(own := settings.get(key), int | float) else limit
            for key, limit in zip(_KEYS, known, strict=True)
        ]

    def signal(self, which: int, code: int, bits: int) -> Signal:
        """Return the value of a code; `which`: 0 to 4 for p, v, t, kp, kd."""
        part = code / ((1 << bits) - 1)
        if which < 3:
            part = 2.0 * part - 1.0
        limit, unit = (self._limits[which], _UNITS[which]) if self._is_known else (1.0, "of range")
        return Signal(_NAMES[which], float(f"{part * limit:.4g}"), unit)


def build(node_id: int, settings: Mapping[str, object] | None = None) -> Decode:
    """Return the decoder of one drive's frames; `settings`: its table in the rig."""
    table = settings or {}
    model = str(table.get("model", "ak80_6_v2"))
    scale = _Scale(table, 12.5, "ak80_6_v2")
    master, is_damiao = table.get("master_id", 0), model in _DAMIAO

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        if told.can_id & (EFF | ERR | RTR) or told.fd:
            return None
        data, bits = told.data, int.from_bytes(told.data, "big")
        if told.can_id == node_id:
            return _request(scale, data, bits)
        if told.can_id == 0x7FF and len(data) >= 4 and data[0] | data[1] << 8 == node_id:
            return BusMessage(f"Parameter {data[3]}: {_OPERATIONS.get(data[2], f'{data[2]:02X}h')}")
        number = data[0] & 0xF if data and is_damiao else data[0] if data else None
        if told.can_id != master or number != (node_id & 0xF if is_damiao else node_id):
            return None
        if len(data) not in (6, 7, 8):
            return BusMessage("State", problem=f"{len(data)} bytes; 6 to 8 are needed")
        head = int.from_bytes(data[1:6], "big")
        codes = ((0, head >> 24, 16), (1, head >> 12 & 0xFFF, 12), (2, head & 0xFFF, 12))
        more = []
        if is_damiao:
            more.append(Signal("state", _STATES.get(data[0] >> 4, data[0] >> 4), ""))
        if len(data) == 8:
            more.append(Signal("temperature", data[6], "deg C"))
            more.append(Signal("rotor" if is_damiao else "fault", data[7], ""))
        return BusMessage("State", (*(scale.signal(*one) for one in codes), *more))

    return decode


def _request(scale: _Scale, data: bytes, bits: int) -> BusMessage:
    if len(data) != 8:
        return BusMessage("Command", problem=f"{len(data)} bytes; 8 are needed")
    if data[:7] == b"\xff" * 7 and data[7] in _SPECIAL:
        return BusMessage(_SPECIAL[data[7]])
    codes = ((0, bits >> 48, 16), (1, bits >> 36 & 0xFFF, 12), (3, bits >> 24 & 0xFFF, 12))
    last = ((4, bits >> 12 & 0xFFF, 12), (2, bits & 0xFFF, 12))
    return BusMessage("Command", tuple(scale.signal(*one) for one in (*codes, *last)))


def build_robstride(node_id: int, settings: Mapping[str, object] | None = None) -> Decode:
    """Return the decoder of one RobStride drive's frames; `settings`: its table in the rig."""
    scale = _Scale(settings or {}, 4.0 * pi, "rs01")

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        if not told.can_id & EFF or told.can_id & (ERR | RTR) or told.fd:
            return None
        kind, area, target = (told.can_id >> shift & mask for shift, mask in _PARTS)
        is_report = kind in (0, 2, 17, 21) and area & 0xFF == node_id and target != node_id
        if (target != node_id and not is_report) or kind not in _TYPES:
            return None
        name, data = _TYPES[kind], told.data
        if len(data) != 8:
            return BusMessage(name, problem=f"{len(data)} bytes; 8 are needed")
        words = [int.from_bytes(data[at : at + 2], "big") for at in range(0, 8, 2)]
        if kind == 1:
            codes = (*enumerate(words[:2]), *enumerate(words[2:], 3), (2, area))
            return BusMessage(name, tuple(scale.signal(one, code, 16) for one, code in codes))
        if kind == 2:
            state = Signal("mode", area >> 14 & 3, ""), Signal("faults", area >> 8 & 0x3F, "")
            values = [scale.signal(one, code, 16) for one, code in enumerate(words[:3])]
            return BusMessage(name, (*values, Signal("winding", words[3] / 10.0, "deg C"), *state))
        if kind in (17, 18):
            return BusMessage(f"{name} {data[1] << 8 | data[0]:04X}h", (_value(data),))
        return BusMessage(name)

    return decode


_PARTS: Final = ((24, 0x1F), (8, 0xFFFF), (0, 0xFF))


def _value(data: bytes) -> Signal:
    return Signal("value", data[4:].hex(" ").upper(), "")
