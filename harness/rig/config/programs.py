"""`[program.NAME]` tables of a rig: programs that share its time."""

from typing import final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import Table
from motorhil.settings import REQUIRED, Items, Text, flag, number, setting


@final
@frozen(kw_only=True, slots=False)
class ProgramTable:
    """A program that `motorhil run RIG` starts, in a process of its own."""

    command: tuple[str, ...] = setting(
        REQUIRED,
        Items(Text(), least=1, unique=False, shown='["python", "drive.py"]'),
        "The program and its arguments; it runs in the rig's folder.",
    )
    joins: bool = flag(True, "It shares the rig's time; false: it runs beside it, on the wall's.")
    may_leave: bool = flag(
        False, "It may be killed, or lose its connection, without a failure of the run."
    )
    stall_s: float = number(
        10.0, 0.1, 86_400.0, "s", "How long it may compute, on the wall clock, before it waits."
    )


@final
@frozen
class ProgramDescription:
    """A program of a rig. Attributes: as the keys of its table."""

    name: str
    command: tuple[str, ...]
    joins: bool
    may_leave: bool
    stall_s: float


def read_program(name: str, table: Table) -> ProgramDescription:
    """Return a program of a rig.

    Raises:
        RigError: the first error in it.
    """
    own = table.read(ProgramTable)
    if not own.command[0]:
        raise table.error("command", "names no program", 'name one: ["python", "drive.py"]')
    return ProgramDescription(name, own.command, own.joins, own.may_leave, own.stall_s)
