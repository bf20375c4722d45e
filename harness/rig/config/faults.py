"""`[[fault]]` tables of a rig: faults of buses and lines.

`[[fault]]` tables for Modbus lines: faults of transmitted characters.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from motorhil.emulators.can.fault_rules import (
    LASTING,
    PARTING,
    RATE_MAX,
    FaultKind,
    FaultRule,
    FrameError,
    WireLevel,
)
from motorhil.emulators.can.frame import EFF_FLAG, EFF_MASK
from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.emulators.simulation.can_network import HOST as INTERFACE
from motorhil.harness.rig.config.buses import MODBUS_TCP, BusDescription
from motorhil.harness.rig.config.toml import Table

LINE_FAULT_KINDS: Final = tuple(kind.value for kind in SerialFaultKind)
_ON_TCP: Final = ("lose", "delay", "truncate", "pause")
LINE_KEYS: Final = ("unit", "function", "after", "noise")
"""Keys of faults on lines that faults on CAN buses lack."""
_COMMON: Final = (
    *("name", "bus", "kind", "sender", "from_s", "until_s"),
    *("probability", "skip", "limit"),
)
_OF_KIND: Final = {
    "delay": ("delay_s",),
    "pause": ("delay_s", "after"),
    "repeat": ("delay_s",),
    "truncate": ("after",),
    "corrupt": ("flip",),
    "noise": ("noise",),
}
_TIME_MAX_S: Final = 1e9
_ADU_MAX: Final = 260


def read_line_fault(
    name: str, table: Table, ports: Sequence[str], bus: BusDescription
) -> SerialFaultRule:
    """Read the fault rule of a table; `ports` are the names of the ports on the line.

    Raises:
        RigError: the first error in it.
    """
    kinds = _ON_TCP if bus.kind == MODBUS_TCP else LINE_FAULT_KINDS
    kind = table.one_of("kind", kinds, "fault kind")
    known = (*_COMMON, "unit", "function", *_OF_KIND.get(kind, ()))
    for key in table.values:
        if key not in known:
            of = [one for one, keys in _OF_KIND.items() if key in keys]
            what = f'belongs to kind "{of[0]}"' if of else f'bus "{bus.name}" is a line'
            raise table.error(key, what, "take it out")
    if kind == "noise" and not table.has("noise"):
        raise table.missing("noise", 'write the bytes to send first, in hex: noise = "FF 00"')
    start_s, end_s = read_times(table)
    delay_s = 0.0
    if "delay_s" in known:
        delay_s = table.number("delay_s", low=1e-9, high=1e6, unit="s", example="0.01")
    after = 0
    if "after" in known:
        after = table.integer("after", low=1, high=_ADU_MAX, unit="characters", example="3")
    return SerialFaultRule(
        name=table.text("name", name),
        kind=SerialFaultKind(kind),
        sender=table.name_of("sender", ports, "controller") if table.has("sender") else None,
        unit=_optional(table, "unit", 255),
        function=_optional(table, "function", 127),
        from_ns=round(start_s * 1e9),
        until_ns=None if end_s is None else round(end_s * 1e9),
        probability=table.number("probability", 1.0, low=0.0, high=1.0),
        skip=table.integer("skip", 0, low=0, high=_COUNT_MAX),
        limit=table.integer("limit", low=1, high=_COUNT_MAX) if table.has("limit") else None,
        delay_ns=round(delay_s * 1e9),
        after=after,
        flip=read_hex(table, "flip", _ADU_MAX, must_change=True),
        noise=read_hex(table, "noise", _ADU_MAX, must_change=False),
    )


def _optional(table: Table, key: str, high: int) -> int | None:
    return table.integer(key, low=0, high=high) if table.has(key) else None


def read_times(table: Table) -> tuple[float, float | None]:
    """Return (from_s, until_s) of a fault [s]; until_s is None if the fault has no end."""
    start_s = table.number("from_s", 0.0, low=0.0, high=_TIME_MAX_S, unit="s")
    if not table.has("until_s"):
        return start_s, None
    end_s = table.number("until_s", low=0.0, high=_TIME_MAX_S, unit="s")
    if not end_s > start_s:
        raise table.error(
            "until_s", f"{end_s} s is not after from_s = {start_s} s", "exchange them"
        )
    return start_s, end_s


def read_hex(table: Table, key: str, longest: int, *, must_change: bool) -> bytes:
    """Return the bytes of a hex text, or b"" if the key is absent."""
    if not table.has(key):
        return b""
    text = table.text(key)
    example = f'write hex bytes, first byte first: {key} = "00 FF"'
    try:
        data = bytes.fromhex(text)
    except ValueError:
        raise table.error(key, f'not hex bytes ("{text}")', example) from None
    if not data or len(data) > longest or (must_change and not any(data)):
        change = ", and change a bit" if must_change else ""
        raise table.error(key, f"must be 1 to {longest} bytes{change}", example)
    return data


HOST: Final = INTERFACE  # name of the application's ports on every bus
KINDS: Final = tuple(kind.value for kind in FaultKind)
FAULT_KEYS: Final = (
    *("name", "bus", "kind", "identifier", "identifier_mask", "extended", "sender", "nodes"),
    *("from_s", "until_s", "probability", "skip", "limit", "delay_s", "flip"),
    *("bit", "error", "bit_error_rate", "data", "level"),
)
ERRORS: Final = tuple(error.value for error in FrameError)
LEVELS: Final = tuple(level.value for level in WireLevel)
BIT_MAX: Final = 1023
RATE_MIN: Final = 1e-12
_OWNERS: Final = {
    "delay_s": FaultKind.DELAY,
    "flip": FaultKind.CORRUPT,
    "bit": FaultKind.ERROR,
    "error": FaultKind.ERROR,
    "bit_error_rate": FaultKind.NOISE,
    "data": FaultKind.BABBLE,
    "level": FaultKind.SHORT,
}
_CONDITIONS: Final = ("probability", "skip", "limit")
_SFF_MASK: Final = 0x7FF
_DATA_MAX: Final = 8
_COUNT_MAX: Final = 2**31


@final
@dataclass(frozen=True, slots=True)
class FaultDescription:
    """A fault rule, and the bus or line to which it applies."""

    bus: str
    rule: FaultRule | SerialFaultRule


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
    for number, table in enumerate(root.listed_tables("fault"), 1):
        fault = _fault(number, table, controllers, buses)
        if fault.rule.name in [other.rule.name for other in faults]:
            raise table.error("name", f'"{fault.rule.name}" is a fault already', "rename one")
        faults.append(fault)
    return tuple(faults)


def _fault(
    number: int,
    table: Table,
    controllers: Mapping[str, Sequence[str]],
    buses: Mapping[str, BusDescription],
) -> FaultDescription:
    table.refuse_unknown((*FAULT_KEYS, *LINE_KEYS))
    bus = table.name_of("bus", list(controllers), "bus")
    if buses[bus].is_line:
        ports = (HOST, *controllers[bus])
        return FaultDescription(bus, read_line_fault(f"fault {number}", table, ports, buses[bus]))
    for key in LINE_KEYS:
        if table.has(key):
            raise table.error(key, f'bus "{bus}" is not a line', "remove it: it is for Modbus")
    kind = FaultKind(table.one_of("kind", KINDS, "fault kind"))
    for key, owner in _OWNERS.items():
        if table.has(key) and kind is not owner:
            raise table.error(key, f'belongs to kind "{owner.value}"', "take it out")
    if kind in LASTING:
        _refuse_conditions(table, kind)
    if kind is FaultKind.ERROR and table.has("bit") is table.has("error"):
        if not table.has("bit"):
            raise table.missing("bit", 'write bit = 20, or error = "crc"')
        raise table.error("error", "an error has a bit or an error, not both", "take one out")
    identifier, mask = _identifier(table)
    ports = (HOST, *controllers[bus], *buses[bus].silent)
    nodes = _nodes(table, ports)
    start_s, end_s = read_times(table)
    delay_s = 0.0
    if kind is FaultKind.DELAY:
        delay_s = table.number("delay_s", low=1e-9, high=1e6, unit="s", example="0.01")
    try:
        rule = FaultRule(
            name=table.text("name", f"fault {number}"),
            kind=kind,
            identifier=identifier,
            mask=mask,
            sender=table.name_of("sender", ports, "controller") if table.has("sender") else None,
            ports=nodes,
            from_ns=round(start_s * 1e9),
            until_ns=None if end_s is None else round(end_s * 1e9),
            probability=table.number("probability", 1.0, low=0.0, high=1.0),
            skip=table.integer("skip", 0, low=0, high=_COUNT_MAX),
            limit=_limit(table),
            delay_ns=round(delay_s * 1e9),
            flip=read_hex(table, "flip", _DATA_MAX, must_change=True),
            **_own(table, kind),
        )
    except ValueError as error:
        raise table.source.error(table.path, str(error), "see the keys of [[fault]]") from None
    return FaultDescription(bus, rule)


def _nodes(table: Table, ports: Sequence[str]) -> tuple[str, ...]:
    nodes = table.texts("nodes", (), example='["left"]')
    for index, node in enumerate(nodes):
        path = (*table.path, "nodes", index)
        if node not in ports:
            raise table.source.no_such(path, node, ports, "controller")
        if node in nodes[:index]:
            raise table.source.error(path, f'"{node}" is named twice', "take one out")
    return nodes


def _refuse_conditions(table: Table, kind: FaultKind) -> None:
    """Refuse conditions of a lasting fault other than its time and the nodes it concerns."""
    if kind in PARTING and not table.values.get("nodes"):
        raise table.error(
            "nodes",
            f"a {kind.value} must name the nodes that lose the bus",
            'write nodes = ["left"]',
        )
    refused = list(_CONDITIONS)
    if kind is FaultKind.BABBLE:
        for key, example in (("identifier", "0x080"), ("sender", '"left"')):
            if not table.has(key):
                raise table.missing(key, f"write {key} = {example}")
        if table.has("identifier_mask"):
            raise table.error("identifier_mask", "a babble sends one identifier", "take it out")
    else:
        refused += ["identifier", "sender"]
    if kind is FaultKind.BABBLE:
        refused.append("nodes")
    for key in refused:
        if table.has(key):
            raise table.error(key, f"a {kind.value} has no condition but its time", "take it out")


def _own(table: Table, kind: FaultKind) -> dict[str, Any]:
    """Return the arguments that only this kind of fault has."""
    if kind is FaultKind.ERROR and table.has("bit"):
        return {"bit": table.integer("bit", low=0, high=BIT_MAX, example="20")}
    if kind is FaultKind.ERROR:
        return {"error": FrameError(table.one_of("error", ERRORS, "error"))}
    if kind is FaultKind.NOISE:
        rate = table.number("bit_error_rate", low=RATE_MIN, high=RATE_MAX, example="1e-6")
        return {"bit_error_rate": rate}
    if kind is FaultKind.SHORT:
        return {"level": WireLevel(table.one_of("level", LEVELS, "level"))}
    if kind is FaultKind.BABBLE:
        return {"data": read_hex(table, "data", _DATA_MAX, must_change=False)}
    return {}


def _identifier(table: Table) -> tuple[int | None, int]:
    extended = table.flag("extended", False)
    high = EFF_MASK if extended else _SFF_MASK
    mask = EFF_FLAG | table.integer("identifier_mask", EFF_MASK, low=0, high=EFF_MASK)
    if not table.has("identifier"):
        for key in ("identifier_mask", "extended"):
            if table.has(key):
                raise table.error(key, "goes with an identifier", "write identifier = 0x181")
        return None, mask
    identifier = table.integer("identifier", low=0, high=high, example="0x181")
    return identifier | (EFF_FLAG if extended else 0), mask


def _limit(table: Table) -> int | None:
    return table.integer("limit", low=1, high=_COUNT_MAX) if table.has("limit") else None
