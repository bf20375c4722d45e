"""The verb `list`: plug-ins, examples, owners of motors, quirks, registers.

`list quirks` shows known deviations of drives with their sources, `list registers NAME` the
register map of a Modbus controller.
"""

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from motorhil.emulators.cia402.settings import CATALOGUE, shown_parameters
from motorhil.harness.cli.main import PASSED, WRONG_USAGE
from motorhil.harness.cli.options import print_table
from motorhil.harness.plugins import ADAPTATIONS, CONTROLLERS, installed, own_eds
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_status import LockView, Occupant, look

if TYPE_CHECKING:
    from motorhil.emulators.modbus.registers import Register


_BRIEF: Final = ("-sdo", "-sync", "-sync-producer", "-exchange")
_ARMED: Final = "-armed-"
"""Locks of drive objects, SYNC, lines, armed set-points: listed only while held."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `list`."""
    parser.add_argument(
        "what",
        choices=("controllers", "adaptations", "examples", "motors", "quirks", "registers"),
    )
    parser.add_argument(
        "name", nargs="?", metavar="CONTROLLER", help="for list registers: the controller"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(options: argparse.Namespace) -> int:
    """Print the list; return 0, or 2 for wrong usage."""
    if (options.what == "registers") is not (options.name is not None):
        known = ", ".join(_with_registers())
        print(
            f"motorhil list: a controller is required for registers, and only there: {known}",
            file=sys.stderr,
        )
        return WRONG_USAGE
    if options.what == "registers":
        return _list_registers(options.name, as_json=options.json)
    if options.what == "quirks":
        return _list_quirks(as_json=options.json)
    listings = {
        "controllers": lambda: _plugins(CONTROLLERS),
        "adaptations": lambda: _plugins(ADAPTATIONS),
        "examples": _examples,
    }
    wrong: list[str] = []
    listing = _motors(wrong) if options.what == "motors" else listings[options.what]()
    for problem in wrong:
        print(f"motorhil list: {problem}", file=sys.stderr)
    status = WRONG_USAGE if wrong else PASSED
    if options.json:
        print(json.dumps(listing))
        return status
    if options.what == "motors":
        _show_motors(listing)
        return status
    for entry in listing:
        name, *facts = entry.values()
        print(f"{name:<16} " + "  ".join(facts))
    return PASSED


def _list_quirks(*, as_json: bool) -> int:
    """Print the catalogue; return 0."""
    if as_json:
        rows = [
            {
                "name": quirk.name,
                "what": quirk.what,
                "seen": quirk.seen,
                "parameters": dict(quirk.parameters),
            }
            for quirk in CATALOGUE
        ]
        print(json.dumps(rows))
        return PASSED
    for quirk in CATALOGUE:
        given = shown_parameters(quirk.parameters)
        print(quirk.name + (f" ({given})" if given else ""))
        print(f"    {quirk.what}")
        print(f"    seen: {quirk.seen}")
    return PASSED


def _with_registers() -> list[str]:
    """Return the names of the controllers that have a register map."""
    return [name for name in installed(CONTROLLERS) if _registers_of(name) is not None]


def _list_registers(name: str, *, as_json: bool) -> int:
    """Print the register map; return 0, or 2 if there is none of that name."""
    found = _registers_of(name) if name in installed(CONTROLLERS) else None
    if found is None:
        known = ", ".join(_with_registers())
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


def _locks(wrong: list[str]) -> Iterator[LockView]:
    """Yield the readable locks; append the errors of the others to `wrong`."""
    try:
        directory = LockDirectory()
        names = directory.names()
    except UsageError as error:
        wrong.append(str(error))
        return
    for name in names:
        try:
            yield look(directory, name)
        except UsageError as error:
            wrong.append(str(error))


def _motors(wrong: list[str]) -> list[dict[str, Any]]:
    """Return the shared motors of this host, with the holder and the waiters of each."""
    listing = []
    for view in _locks(wrong):
        if view.holder is None and (view.name.endswith(_BRIEF) or _ARMED in view.name):
            continue  # held for a moment only, unless its holder is paused
        if view.holder is None and not view.waiters and not _bus_exists(view.label):
            continue  # of a hub that no longer exists
        entry: dict[str, Any] = {"name": view.label, "lock": view.name}
        entry["holder"] = None if view.holder is None else _holder_facts(view, view.holder)
        entry["waiters"] = [_occupant_facts(one) for _, one in view.waiters]
        entry["abandoned"] = bool(view.abandoned)
        listing.append(entry)
    return sorted(listing, key=lambda entry: str(entry["name"]))


def _bus_exists(label: str) -> bool:
    """Return whether the label's bus exists: a hub if its socket does, others always."""
    bus = label.partition(" node ")[0]
    return not bus.startswith("/") or Path(bus).exists()


def _occupant_facts(one: Occupant) -> dict[str, Any]:
    record = one.record
    if record is None:
        return {"text": str(one)}
    return {
        "text": f"{one}, since {one.since}",
        "pid": record.pid,
        "program": record.program,
        "purpose": record.purpose,
        "since_s": one.age_s,
        "paused": one.is_paused,
    }


def _holder_facts(view: LockView, holder: Occupant) -> dict[str, Any]:
    """Return the facts of a holder: occupant, lease, and takeover from a living process."""
    entry = _occupant_facts(holder)
    facts: list[str] = []
    if view.is_writing and holder.is_paused:
        facts.append("during a write: cannot be taken over")
    if view.lease_s is not None:
        left_s = view.lease_left_s
        when = f"{left_s:.1f} s left" if left_s > 0.0 else f"expired {-left_s:.1f} s ago"
        facts.append(f"lease of {view.lease_s:g} s, {when}")
        entry |= {"lease_s": view.lease_s, "lease_left_s": left_s}
    if view.taken_over is not None:
        taken = view.taken_over
        whom = (
            f"pid {taken.from_pid} ({taken.from_program})"
            if taken.from_pid
            else "an unknown process"
        )
        facts.append(f"taken over from {whom}: {taken.reason}")
        entry["taken_over"] = {
            "from_pid": taken.from_pid,
            "from_program": taken.from_program,
            "reason": taken.reason,
        }
    if view.token:
        entry["token"] = view.token
    entry["text"] = "; ".join([entry["text"], *facts])
    return entry


def _show_motors(listing: list[dict[str, Any]]) -> None:
    for entry in listing:
        holder = entry["holder"]
        left = "free; its last owner died while it had it" if entry["abandoned"] else "free"
        print(f"{entry['name']:<24} {left if holder is None else holder['text']}")
        for place, waiter in enumerate(entry["waiters"], 1):
            print(f"{'':<24} waits ({place}): {waiter['text']}")


def _plugins(group: str) -> list[dict[str, str]]:
    listing = []
    for plugin in installed(group).values():
        entry = {"name": plugin.name, "builder": plugin.target, "package": plugin.package}
        eds = own_eds(plugin.target)
        if eds is not None:
            entry["eds"] = str(eds)
        listing.append(entry)
    return listing


def _examples() -> list[dict[str, str]]:
    from motorhil.harness.rig.config.scaffold import example_rigs, first_comment

    return [
        {"name": path.stem, "path": str(path), "about": first_comment(path)}
        for path in example_rigs()
    ]
