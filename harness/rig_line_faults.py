"""`[[fault]]` tables for Modbus lines: faults of transmitted characters."""

from collections.abc import Sequence
from typing import Final

from emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from harness.rig_buses import MODBUS_TCP, BusDescription
from harness.settings import Table

KINDS: Final = tuple(kind.value for kind in SerialFaultKind)
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
_COUNT_MAX: Final = 2**31
_ADU_MAX: Final = 260


def read_line_fault(
    name: str, table: Table, ports: Sequence[str], bus: BusDescription
) -> SerialFaultRule:
    """Read the fault rule of a table; `ports` are the names of the ports on the line.

    Raises:
        RigError: the first error in it.
    """
    kinds = _ON_TCP if bus.kind == MODBUS_TCP else KINDS
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
