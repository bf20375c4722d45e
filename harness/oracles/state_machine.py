"""Oracle of the PDS FSA: the sequence of reported states must be possible.

A statusword is a sample. Between two samples a drive may have passed through several states. A
statusword may also have been delayed since a controlword before the previous sample. The second
state must be reachable from the first along the standard's transitions. All controlwords in force,
or heard since `LAG_NS` before the first, may be used for it.

Only transitions towards power need a controlword (2, 3, 4, 15, 16). All others may also start
inside the drive: option codes, a lost supply, a lost host, a local operator.

Source: CiA 402-2 (IEC 61800-7-201), PDS FSA: states, transitions 0 to 16, table of commands in the
controlword; bit 9 of the statusword (remote): the controlword is obeyed.
"""

from collections.abc import Mapping
from enum import Enum
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    CONTROLWORD,
    DISABLED,
    ENABLED,
    FAULT,
    MS,
    NOT_READY,
    QUICK_STOP,
    REACTION,
    READY,
    STATUSWORD,
    SWITCHED_ON,
    Axis,
    Oracle,
    Place,
    RecordingContext,
    Violation,
    forget,
)
from motorhil.traces.decoding.cia402 import STATES, UNKNOWN_STATE, state_number

LAG_NS: Final = 1_000 * MS
_REMOTE: Final = 0x0200


@final
class Command(Enum):
    """The commands of a controlword that may lead towards power."""

    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on"
    ENABLE_OPERATION = "enable operation"
    FAULT_RESET = "fault reset"


_C: Final = Command
# number, from, to, alternative commands; (): also without a command.
TRANSITIONS: Final[tuple[tuple[int, int, int, tuple[Command, ...]], ...]] = (
    (1, NOT_READY, DISABLED, ()),
    (2, DISABLED, READY, (_C.SHUTDOWN,)),
    (3, READY, SWITCHED_ON, (_C.SWITCH_ON, _C.ENABLE_OPERATION)),
    (4, SWITCHED_ON, ENABLED, (_C.ENABLE_OPERATION,)),
    (5, ENABLED, SWITCHED_ON, ()),
    (6, SWITCHED_ON, READY, ()),
    (7, READY, DISABLED, ()),
    (8, ENABLED, READY, ()),
    (9, ENABLED, DISABLED, ()),
    (10, SWITCHED_ON, DISABLED, ()),
    (11, ENABLED, QUICK_STOP, ()),
    (12, QUICK_STOP, DISABLED, ()),
    *((13, state, REACTION, ()) for state in range(REACTION)),
    (14, REACTION, FAULT, ()),
    (15, FAULT, DISABLED, (_C.FAULT_RESET,)),
    (16, QUICK_STOP, ENABLED, (_C.ENABLE_OPERATION,)),
)


def command_in(word: int, before: int | None) -> Command | None:
    """Return the command in a controlword that may lead towards power, or None.

    Args:
        word: the controlword.
        before: the previous one; None: unknown. A fault reset is the rising edge of bit 7.
    """
    if word & 0x80:
        return None if before is not None and before & 0x80 else Command.FAULT_RESET
    if word & 0x07 == 0x06:
        return Command.SHUTDOWN
    if word & 0x07 == 0x07:
        return Command.ENABLE_OPERATION if word & 0x08 else Command.SWITCH_ON
    return None


def reachable(state: int, commands: frozenset[Command]) -> frozenset[int]:
    """Return the states reachable from this one with these commands."""
    found = {state}
    grown = True
    while grown:
        grown = False
        for _, first, second, needs in TRANSITIONS:
            if first in found and second not in found and (not needs or commands & set(needs)):
                found.add(second)
                grown = True
    return frozenset(found)


@final
class _Observed:
    """The commands to one axis with their times, and its last state.

    Attributes:
        is_whole: True if all commands since its boot-up were heard.
    """

    def __init__(self, is_whole: bool) -> None:
        self.is_whole = is_whole
        self.word: int | None = None
        self.state: int | None = None
        self.status = 0
        self.status_ns = 0
        self._last_ns: dict[Command | None, int] = {}

    def command(self, time_ns: int, word: int) -> None:
        """Take a controlword."""
        self._last_ns[command_in(word, self.word)] = time_ns
        self.word = word

    def since(self, time_ns: int) -> frozenset[Command]:
        """Return the commands since then, with the one in force at that time."""
        commands = [command for command, at_ns in self._last_ns.items() if at_ns >= time_ns]
        before = {command: at for command, at in self._last_ns.items() if at < time_ns}
        if before:
            in_force = max(before, key=lambda command: before[command])
            if in_force is not Command.FAULT_RESET:
                commands.append(in_force)
        return frozenset(command for command in commands if command is not None)


@final
class StateMachine(Oracle):
    """The oracle `pds-legal`."""

    id = "pds-legal"
    promise = (
        "Each state that a drive reports can follow the previous one with the commands in between"
    )
    source = "CiA 402-2, PDS FSA"
    needs = "no drive reports a change of its state: no 6041h by SDO or in a mapped PDO"
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, CONTROLWORD: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._observed: dict[Place, _Observed] = {}
        self._booted: dict[tuple[str, int], None] = {}

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the commands to a node that has booted."""
        self._booted[bus, node] = None
        forget(self._observed, bus, node)

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a controlword, or examine a statusword."""
        observed = self._observed.get(axis.place)
        if observed is None:
            observed = self._observed[axis.place] = _Observed(axis.place[:2] in self._booted)
        if is_written == (index == CONTROLWORD):
            if is_written:
                observed.command(time_ns, value)
            elif value != observed.status or observed.state is None:
                self._status(time_ns, axis, observed, value)
            else:
                observed.status_ns = time_ns

    def _status(self, time_ns: int, axis: Axis, observed: _Observed, word: int) -> None:
        bus, node, number = axis.place
        before, remote = observed.state, word & observed.status & _REMOTE
        state, since_ns = state_number(word), observed.status_ns - LAG_NS
        observed.status, observed.status_ns = word, time_ns
        observed.state = None if state == UNKNOWN_STATE else state
        if state == UNKNOWN_STATE:
            text = f"statusword {word:04X}h matches none of the eight states"
            if self.examine(time_ns, bus):
                self.broken(Violation(time_ns, text, bus, node, number, axis.name))
            return
        if before is None or before == state:
            return
        commands = observed.since(since_ns)
        if state in reachable(before, commands):
            self.examine(time_ns, bus)
            return
        commanded = ", ".join(command.value for command in Command if command in commands)
        text = (
            f"{STATES[before][2]}, then {STATES[state][2]} (statusword {word:04X}h), after "
            f"{commanded or 'no command that leads there'}"
        )
        found = Violation(time_ns, text, bus, node, number, axis.name)
        if not remote and state != NOT_READY:
            self.cannot("drives are under local control (bit 9 of their statuswords is not set)")
        elif (bus, node) in self.context.unmapped:
            identifier = self.context.unmapped[bus, node]
            why = f"RPDO {identifier:03X}h may carry the controlword: its mapping is not known"
            self.doubt(found, why)
        elif observed.word is None and not observed.is_whole:
            self.cannot("no controlword to the drives was heard")
        elif self.examine(time_ns, bus):
            self.absent(found)
