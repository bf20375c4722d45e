"""`[[fault]]` tables of a rig: faults of buses and lines.

`[[fault]]` tables for Modbus lines: faults of transmitted characters.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final, final

from motorhil.emulators.can.controller_config import HOST as INTERFACE
from motorhil.emulators.can.fault_rules import (
    RATE_MAX,
    FaultKind,
    FaultRule,
    FrameError,
    WireLevel,
)
from motorhil.emulators.can.frame import EFF_FLAG, EFF_MASK
from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.frozen import frozen
from motorhil.harness.rig.config.buses import MODBUS_TCP, SERIAL, BusDescription
from motorhil.harness.rig.config.toml import Table
from motorhil.settings import (
    REQUIRED,
    HexBytes,
    Items,
    Rule,
    SettingError,
    Text,
    declaration,
    flag,
    listed,
    nearest,
    number,
    setting,
    text,
    whole,
    word,
)

HOST: Final = INTERFACE  # name of the application's ports on every bus
_FURTHER_HOST: Final = re.compile(rf"{HOST}-[2-9][0-9]*|{HOST}-1[0-9]+")
KINDS: Final = tuple(kind.value for kind in FaultKind)
LINE_FAULT_KINDS: Final = tuple(kind.value for kind in SerialFaultKind)
ON_TCP: Final = ("lose", "delay", "truncate", "pause")
_LINE_KEYS: Final = ("unit", "function", "after", "noise")
_CAN_KEYS: Final = (
    *("identifier", "identifier_mask", "extended", "nodes"),
    *("bit", "error", "bit_error_rate", "data", "level"),
)
_CONDITIONS: Final = ("probability", "skip", "limit")
_SFF_MASK: Final = 0x7FF
_DATA_MAX: Final = 8
_ADU_MAX: Final = 260
_COUNT_MAX: Final = 2**31
_TIME_S: Final = (1e-6, 86_400.0)


def _only(kinds: tuple[str, ...], *keys: str) -> Rule:
    message = f'belongs to kind "{kinds[0]}"'
    return Rule("kind", kinds, otherwise=True, refused=keys, message=message)


def _lasting(*kinds: str, refused: tuple[str, ...]) -> Rule:
    message = f"a {' or '.join(kinds)} has no condition but its time"
    return Rule("kind", kinds, refused=(*_CONDITIONS, *refused), message=message)


def _needs(kinds: tuple[str, ...], key: str, example: str) -> Rule:
    return Rule("kind", kinds, required=(key,), remedy=f"write {key} = {example}")


@frozen(kw_only=True, slots=False)
class FaultBusTable:
    """Where a fault is, and what happens there."""

    bus: str = text(REQUIRED, "The bus or line.", example='"can0"')
    kind: str = word(
        REQUIRED, dict.fromkeys((*KINDS, *LINE_FAULT_KINDS)), "fault kind", "What happens."
    )


@final
@frozen(kw_only=True, slots=False)
class FaultTable(FaultBusTable):
    """A fault of a bus or a line, each time that it matches."""

    name: str | None = text(None, "Its name; absent: its number.")
    identifier: int | None = whole(
        None, 0, EFF_MASK, "", "Frames with this identifier; absent: all.", example="0x181"
    )
    identifier_mask: int = whole(EFF_MASK, 0, EFF_MASK, "", "Bits of it that matter.")
    extended: bool = flag(False, "The identifier has 29 bits.")
    sender: str | None = text(
        None,
        'Frames of this controller, of the "host", or of its second connection, "host-2"; absent:'
        " of all.",
        example='"left"',
    )
    nodes: tuple[str, ...] = setting(
        (), Items(Text(), least=1, shown='["left"]'), "Nodes that the fault concerns; absent: all."
    )
    from_s: float = number(0.0, 0.0, 1e9, "s", "From this time of the rig on.", plausible=_TIME_S)
    until_s: float | None = number(
        None, 0.0, 1e9, "s", "Until this time; absent: for ever.", plausible=_TIME_S
    )
    probability: float = number(1.0, 0.0, 1.0, "", "Probability that it happens to a match.")
    skip: int = whole(0, 0, _COUNT_MAX, "", "Matches that it spares at first.")
    limit: int | None = whole(None, 1, _COUNT_MAX, "", "Times that it happens; absent: no limit.")
    delay_s: float | None = number(
        None, 1e-9, 1e6, "s", "How much later.", example="0.01", plausible=(1e-9, 60.0)
    )
    flip: bytes | None = setting(
        None, HexBytes(_ADU_MAX, must_change=True), "Bits to invert in the data, in hex."
    )
    bit: int | None = whole(None, 0, 1023, "", "Bit of the frame that is destroyed.", example="20")
    error: str | None = word(None, [one.value for one in FrameError], "error", "Its error.")
    bit_error_rate: float | None = number(
        None, 1e-12, RATE_MAX, "", "Probability that a bit is inverted.", example="1e-6"
    )
    data: bytes | None = setting(None, HexBytes(_DATA_MAX), "Data of a babbling node, in hex.")
    level: str | None = word(None, [one.value for one in WireLevel], "level", "Level of a short.")
    unit: int | None = whole(None, 0, 255, "", "Transmissions to and from this unit.")
    function: int | None = whole(None, 0, 127, "", "Transmissions with this function code.")
    after: int | None = whole(
        None, 1, _ADU_MAX, "characters", "Characters before it happens.", example="3"
    )
    noise: bytes | None = setting(None, HexBytes(_ADU_MAX), "Bytes to send first, in hex.")
    by_hand: bool = flag(
        False, "The bus learns of it only when it begins, as of a fault from the live page."
    )

    RULES: ClassVar = (
        _only(("delay", "pause", "repeat"), "delay_s"),
        _only(("corrupt",), "flip"),
        _only(("error",), "bit", "error"),
        _only(("noise",), "bit_error_rate", "noise"),
        _only(("babble",), "data"),
        _only(("short",), "level"),
        _only(("truncate", "pause"), "after"),
        _needs(("delay", "pause", "repeat"), "delay_s", "0.01"),
        _needs(("truncate", "pause"), "after", "3"),
        _needs(("short",), "level", '"dominant"'),
        _needs(("babble",), "identifier", "0x080"),
        _needs(("babble",), "sender", '"left"'),
        _needs(("cut", "split"), "nodes", '["left"]: those that lose the bus'),
        Rule(
            "kind",
            ("error",),
            required=("bit", "error"),
            remedy='write bit = 20, or error = "crc"',
        ),
        Rule(
            "bit",
            refused=("error",),
            message="an error has a bit or an error, not both",
            remedy="take one out",
        ),
        Rule(
            "kind",
            ("noise",),
            required=("bit_error_rate", "noise"),
            remedy='write bit_error_rate = 1e-6, or on a line noise = "FF 00"',
        ),
        _lasting("cut", "split", refused=("identifier", "sender")),
        _lasting("short", refused=("identifier", "sender")),
        _lasting("babble", refused=("nodes",)),
        Rule(
            "kind",
            ("babble",),
            refused=("identifier_mask",),
            message="a babble sends one identifier",
            remedy="take it out",
        ),
        Rule(
            "bit_error_rate",
            refused=(*_CONDITIONS, "identifier", "sender", "noise"),
            message="a noise has no condition but its time",
            remedy="take it out",
        ),
        Rule(
            "identifier",
            otherwise=True,
            refused=("identifier_mask", "extended"),
            message="goes with an identifier",
            remedy="write identifier = 0x181",
        ),
        Rule(
            "kind",
            tuple(kind for kind in LINE_FAULT_KINDS if kind not in KINDS),
            refused=_CAN_KEYS,
            message="is for CAN buses",
            remedy="take it out",
        ),
        Rule(
            "kind",
            tuple(kind for kind in KINDS if kind not in LINE_FAULT_KINDS),
            refused=_LINE_KEYS,
            message="is for Modbus lines",
            remedy="take it out",
        ),
        Rule("noise", refused=_CAN_KEYS, message="is for CAN buses", remedy="take it out"),
    )
    SCHEMA: ClassVar[Mapping[str, object]] = {
        "anyOf": [
            {"properties": {"identifier": {"maximum": _SFF_MASK}}},
            {"properties": {"extended": {"const": True}}, "required": ["extended"]},
        ],
    }

    def __post_init__(self) -> None:
        """Refuse an identifier with too many bits, and an end before the start (SettingError)."""
        if not self.extended and (self.identifier or 0) > _SFF_MASK:
            remedy = f"allowed: 0 to {_SFF_MASK}, or extended = true"
            raise SettingError(("identifier",), f"{self.identifier} is out of range", remedy)
        if self.until_s is not None and not self.until_s > self.from_s:
            message = f"{self.until_s} s is not after from_s = {self.from_s} s"
            raise SettingError(("until_s",), message, "exchange them")

    def common(self) -> dict[str, Any]:
        """Return the arguments of rules for CAN buses and for lines."""
        return {
            "sender": self.sender,
            "from_ns": round(self.from_s * 1e9),
            "until_ns": None if self.until_s is None else round(self.until_s * 1e9),
            "probability": self.probability,
            "skip": self.skip,
            "limit": self.limit,
            "delay_ns": round((self.delay_s or 0.0) * 1e9),
            "flip": self.flip or b"",
        }

    def frame_rule(self, name: str) -> FaultRule:
        """Return the rule for a CAN bus.

        Raises:
            ValueError: the values do not go together.
        """
        identifier = self.identifier
        own: dict[str, Any] = {"bit": self.bit, "bit_error_rate": self.bit_error_rate}
        own["error"] = None if self.error is None else FrameError(self.error)
        own["level"] = None if self.level is None else WireLevel(self.level)
        own["data"] = self.data
        if identifier is not None and self.extended:
            identifier |= EFF_FLAG
        return FaultRule(
            name=name,
            kind=FaultKind(self.kind),
            identifier=identifier,
            mask=EFF_FLAG | self.identifier_mask,
            ports=self.nodes,
            **self.common(),
            **{key: value for key, value in own.items() if value is not None},
        )

    def line_rule(self, name: str) -> SerialFaultRule:
        """Return the rule for a line."""
        return SerialFaultRule(
            name=name,
            kind=SerialFaultKind(self.kind),
            unit=self.unit,
            function=self.function,
            after=self.after or 0,
            noise=self.noise or b"",
            **self.common(),
        )


@final
@frozen
class FaultDescription:
    """A fault rule, and the bus or line to which it applies.

    `by_hand`: the rule is added to the bus when it begins, and removed when it ends.
    """

    bus: str
    rule: FaultRule | SerialFaultRule
    by_hand: bool = False


def read_faults(
    root: Table,
    controllers: Mapping[str, Sequence[str]],
    buses: Mapping[str, BusDescription],
) -> tuple[FaultDescription, ...]:
    """Return the faults of a rig in the order of the file; `controllers` are grouped by bus.

    Raises:
        RigError: the first error in them.
    """
    faults: list[FaultDescription] = []
    for index, table in enumerate(root.listed_tables("fault"), 1):
        fault = _fault(index, table, controllers, buses)
        if fault.rule.name in [other.rule.name for other in faults]:
            raise table.error("name", f'"{fault.rule.name}" is a fault already', "rename one")
        faults.append(fault)
    return tuple(faults)


def _fault(
    index: int,
    table: Table,
    controllers: Mapping[str, Sequence[str]],
    buses: Mapping[str, BusDescription],
) -> FaultDescription:
    table.refuse_unknown(tuple(declaration(FaultTable).keys))
    on = table.part(FaultBusTable)
    table.require("bus", on.bus, list(controllers))
    bus = buses[on.bus]
    kinds = KINDS
    if bus.is_line:
        kinds = ON_TCP if bus.kind == MODBUS_TCP else LINE_FAULT_KINDS
    if on.kind not in kinds:
        problem = f'unknown fault kind "{on.kind}" (known: {listed(kinds)})'
        raise table.error("kind", problem, nearest(on.kind, kinds))
    for key in ("unit", "function") if bus.kind == SERIAL else ():
        if table.has(key):
            problem = f'bus "{on.bus}" is of kind {SERIAL}, whose protocol is not known'
            raise table.error(key, problem, "write sender instead")
    for key in _CAN_KEYS if bus.is_line else _LINE_KEYS:
        if table.has(key):
            problem = f'bus "{on.bus}" is {"" if bus.is_line else "not "}a line'
            remedy = "take it out" if bus.is_line else "remove it: it is for Modbus"
            raise table.error(key, problem, remedy)
    own = table.read(FaultTable)
    name = own.name or f"fault {index}"
    ports = (HOST, *controllers[own.bus], *bus.silent)
    if own.sender is not None and not _FURTHER_HOST.fullmatch(own.sender):
        table.require("sender", own.sender, ports, "controller")
    for place, node in enumerate(own.nodes):
        table.require("nodes", node, ports, "controller", place)
    if bus.is_line:
        return FaultDescription(own.bus, own.line_rule(name), own.by_hand)
    if own.flip is not None and len(own.flip) > _DATA_MAX:
        problem = f"must be 1 to {_DATA_MAX} bytes, and change a bit"
        raise table.error("flip", problem, 'write flip = "00 FF"')
    try:
        return FaultDescription(own.bus, own.frame_rule(name), own.by_hand)
    except ValueError as error:
        raise table.source.error(table.path, str(error), "see the keys of [[fault]]") from None
