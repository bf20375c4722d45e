"""The `[[fault]]` tables of a rig: what goes wrong on a bus, when, and to whom."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, final

from emulators.media.can_frame import EFF_FLAG, EFF_MASK
from emulators.media.faults import FaultKind, FaultRule
from harness.settings import Table

HOST: Final = "host"  # what the application's ports are called on every bus
KINDS: Final = tuple(kind.value for kind in FaultKind)
FAULT_KEYS: Final = (
    *("name", "bus", "kind", "identifier", "identifier_mask", "extended", "sender", "nodes"),
    *("from_s", "until_s", "probability", "skip", "limit", "delay_s", "flip"),
)
_SFF_MASK: Final = 0x7FF
_TIME_MAX_S: Final = 1e9
_COUNT_MAX: Final = 2**31


@final
@dataclass(frozen=True, slots=True)
class FaultDescription:
    """A rule for what goes wrong, and the bus it is for."""

    bus: str
    rule: FaultRule


def read_faults(
    root: Table, controllers: Mapping[str, Sequence[str]]
) -> tuple[FaultDescription, ...]:
    """The faults of a rig, in the order of the file; `controllers` on each of its buses.

    Raises:
        RigError: the first thing wrong in them.
    """
    faults: list[FaultDescription] = []
    for number, table in enumerate(root.listed_tables("fault"), 1):
        fault = _fault(number, table, controllers)
        if fault.rule.name in [other.rule.name for other in faults]:
            raise table.error("name", f'"{fault.rule.name}" is a fault already', "rename one")
        faults.append(fault)
    return tuple(faults)


def _fault(number: int, table: Table, controllers: Mapping[str, Sequence[str]]) -> FaultDescription:
    table.refuse_unknown(FAULT_KEYS)
    bus = table.name_of("bus", list(controllers), "bus")
    kind = FaultKind(table.one_of("kind", KINDS, "fault kind"))
    for key, owner in (("delay_s", FaultKind.DELAY), ("flip", FaultKind.CORRUPT)):
        if table.has(key) and kind is not owner:
            raise table.error(key, f'belongs to kind "{owner.value}"', "take it out")
    if kind is FaultKind.CUT:
        _refuse_conditions(table)
    identifier, mask = _identifier(table)
    ports = (HOST, *controllers[bus])
    nodes = table.texts("nodes", (), example='["left"]')
    for index, node in enumerate(nodes):
        if node not in ports:
            path = (*table.path, "nodes", index)
            raise table.source.no_such(path, node, ports, "controller")
    start_s, end_s = _times(table)
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
            flip=_flip(table),
        )
    except ValueError as error:
        raise table.source.error(table.path, str(error), "see the keys of [[fault]]") from None
    return FaultDescription(bus, rule)


def _refuse_conditions(cut: Table) -> None:
    if not cut.values.get("nodes"):
        raise cut.error("nodes", "a cut names who loses the bus", 'write nodes = ["left"]')
    for key in ("identifier", "sender", "probability", "skip", "limit"):
        if cut.has(key):
            raise cut.error(key, "a cut has no condition but its time", "take it out")


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


def _times(table: Table) -> tuple[float, float | None]:
    start_s = table.number("from_s", 0.0, low=0.0, high=_TIME_MAX_S, unit="s")
    if not table.has("until_s"):
        return start_s, None
    end_s = table.number("until_s", low=0.0, high=_TIME_MAX_S, unit="s")
    if not end_s > start_s:
        raise table.error(
            "until_s", f"{end_s} s is not after from_s = {start_s} s", "exchange them"
        )
    return start_s, end_s


def _limit(table: Table) -> int | None:
    return table.integer("limit", low=1, high=_COUNT_MAX) if table.has("limit") else None


def _flip(table: Table) -> bytes:
    if not table.has("flip"):
        return b""
    text = table.text("flip")
    example = 'write hex bytes, first byte first: flip = "00 FF"'
    try:
        flip = bytes.fromhex(text)
    except ValueError:
        raise table.error("flip", f'not hex bytes ("{text}")', example) from None
    if not any(flip) or len(flip) > 8:
        raise table.error("flip", "must be 1 to 8 bytes, and change a bit", example)
    return flip
