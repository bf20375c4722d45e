"""The verb `list registers NAME`: the register map of a Modbus controller."""

import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from harness.exit_status import PASSED, WRONG_USAGE
from harness.plugins import CONTROLLERS, installed
from harness.text_table import print_table

if TYPE_CHECKING:
    from emulators.modbus.registers import Register


def with_registers() -> list[str]:
    """Return the names of the controllers that have a register map."""
    return [name for name in installed(CONTROLLERS) if _registers_of(name) is not None]


def list_registers(name: str, *, as_json: bool) -> int:
    """Print the register map; return 0, or 2 if there is none of that name."""
    found = _registers_of(name) if name in installed(CONTROLLERS) else None
    if found is None:
        known = ", ".join(with_registers())
        problem = f'"{name}" has no register map (known: {known})'
        print(f"motorhil list registers: {problem}", file=sys.stderr)
        return WRONG_USAGE
    rows = sorted(found(), key=lambda row: row.address)
    if as_json:
        print(json.dumps([_facts(row) for row in rows]))
        return PASSED
    head = ("address", "name", "type", "unit", "access", "default", "behaviour")
    table = [
        (
            *(f"{row.address:04X}h", row.name, row.kind.value, row.unit, row.access.value),
            *(str(row.default), row.behaviour),
        )
        for row in rows
    ]
    print_table(head, table, words=(0, 1, 2, 3, 4, 6))
    return PASSED


def _facts(row: "Register") -> dict[str, object]:
    return {
        "address": row.address,
        "name": row.name,
        "type": row.kind.value,
        "unit": row.unit,
        "access": row.access.value,
        "default": row.default,
        "low": row.low,
        "high": row.high,
        "behaviour": row.behaviour,
    }


def _registers_of(name: str) -> "Callable[[], Sequence[Register]] | None":
    try:
        build = installed(CONTROLLERS)[name].load()
    except (Exception, SystemExit):
        return None
    found: Callable[[], Sequence[Register]] | None = getattr(build, "registers", None)
    return found
