"""Oracles of commands to a drive: states they exclude, and the signs of its modes.

A controlword counts only if the drive has confirmed it by SDO: a node that is not operational
ignores RPDOs.

Source: CiA 402-2: PDS FSA transitions 6, 7, 10 and 12, quick stop option code 605Ah, modes 6060h,
6061h and 6502h, set-point acknowledge (statusword bit 12 in pp), homing methods 6098h.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import (
    BIT_12,
    BIT_13,
    CONTROLWORD,
    DISABLED,
    ENABLED,
    FAULT,
    MODE,
    MODE_DISPLAY,
    MS,
    QUICK_STOP,
    REACTION,
    READY,
    STATUSWORD,
    SWITCHED_ON,
    TARGET_REACHED,
    Axis,
    Oracle,
    Place,
    RecordingContext,
    forget,
)
from motorhil.traces.decoding.cia402 import STATES
from motorhil.traces.decoding.events import DecodedEvent, Kind

_PATIENCE_NS: Final = 500 * MS
"""A drive may need a moment for a command; these need no ramp."""
_REMOTE: Final = 0x0200
_VOLTAGE: Final = 0x0010
_OPTION: Final = 0x605A
_STAYS: Final = range(5, 9)
_MODES: Final = 0x6502
_METHOD: Final = 0x6098
_RESERVED: Final = (15, 16, 31, 32)
_EDGE: Final = 0x0010
_TWICE: Final = 2
"""A single statusword may be from before a change of the mode."""
_PP, _HM = 1, 6


@final
@dataclass(slots=True)
class _Commanded:
    """The controlwords to one axis.

    Attributes:
        word: the last one heard.
        since_ns: when it was confirmed; None: it was not.
        state: the last state reported, since `state_ns`.
        may_leave: True if disable voltage was heard since quick stop was commanded.
    """

    word: int | None = None
    since_ns: int | None = None
    state: int | None = None
    state_ns: int = 0
    may_leave: bool = False


@final
class CommandsObeyed(Oracle):
    """The oracle `commands-obeyed`."""

    id = "commands-obeyed"
    promise = (
        "A drive under remote control leaves the states that a confirmed controlword excludes; "
        "it leaves quick stop active as 605Ah says"
    )
    source = "CiA 402-2, PDS FSA, transitions 6, 7, 10, 12; quick stop option code 605Ah"
    needs = "no controlword was confirmed by SDO and followed by a statusword"
    objects: ClassVar[Mapping[int, bool]] = {STATUSWORD: False, CONTROLWORD: False, _OPTION: True}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._commanded: dict[Place, _Commanded] = {}

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the commands to a node that has booted."""
        forget(self._commanded, bus, node)

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Take the confirmation of a controlword."""
        if event.index != CONTROLWORD or event.kind is not Kind.SDO_RESPONSE:
            return
        one = self._commanded.get((bus, event.node or 0, 1))
        if one is not None and one.since_ns is None and data[0] >> 5 == 3:
            one.since_ns = time_ns

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a controlword, or examine a statusword."""
        one = self._commanded.setdefault(axis.place, _Commanded())
        if index == CONTROLWORD and is_written:
            if value != one.word:
                one.word, one.since_ns = value, None
            one.may_leave = not value & 2 or (one.may_leave and value & 6 == 2)
        elif index == STATUSWORD and not is_written:
            self._status(time_ns, axis, one, value)

    def _status(self, time_ns: int, axis: Axis, one: _Commanded, word: int) -> None:
        before, state = one.state, axis.state
        if state != before:
            one.state_ns = time_ns
        one.state = state
        if state is None or not word & _REMOTE:
            return
        option = axis.objects.get((_OPTION, 0))
        bus = axis.place[0]
        excluded = _excluded(one.word)
        is_due = one.since_ns is not None and time_ns - one.since_ns > _PATIENCE_NS
        if is_due and excluded and self.examine(time_ns, bus) and state in excluded:
            since = (one.since_ns or 0) / 1e9
            text = f"{STATES[state][2]}, but controlword {one.word:04X}h is confirmed since"
            self.absent(axis.violation(time_ns, f"{text} {since:.6f} s"))
        if option == 0 and state == QUICK_STOP and time_ns - one.state_ns > _PATIENCE_NS:
            text = "quick stop active, but 605Ah = 0 disables the drive at once"
            self.absent(axis.violation(time_ns, text))
        leaves = before == QUICK_STOP and state == DISABLED and word & _VOLTAGE
        if option in _STAYS and leaves and self.examine(time_ns, bus) and not one.may_leave:
            text = f"left quick stop active without a command, but 605Ah = {option} stays there"
            self.absent(axis.violation(time_ns, text))


def _excluded(word: int | None) -> tuple[int, ...]:
    """Return the states that end without a ramp under this controlword."""
    if word is None or word & 0x80:
        return ()
    if not word & 2 or not word & 4:  # disable voltage, quick stop
        return (READY, SWITCHED_ON)
    return () if word & 1 else (SWITCHED_ON,)  # shutdown


@final
@dataclass(slots=True)
class _Mode:
    """The mode of one axis.

    Attributes:
        written, written_ns: the last confirmed 6060h; None: none.
        idle_ns: since when bit 4 of the controlword is 0.
        held_ns: since when bits 10 and 12 are both set in that time.
        homing_ns: when homing was started by an edge of bit 4; None: it was not.
        is_attained: True if the last statusword reported homing as attained.
        was_busy: True if one since then, or the last one before, did not.
        is_fresh: True if bit 4 was 0 since the drive was enabled; `strange`: bit 12 was set.
    """

    written: int | None = None
    written_ns: int = 0
    idle_ns: int | None = None
    held_ns: int | None = None
    homing_ns: int | None = None
    is_attained: bool = False
    was_busy: bool = False
    is_fresh: bool = False
    strange: int = 0


@final
class ModeSigns(Oracle):
    """The oracle `mode-signs`."""

    id = "mode-signs"
    promise = (
        "6061h shows the mode that 6502h claims and 6060h has; in pp, bit 12 falls after bit 4; "
        "a reserved homing method attains nothing"
    )
    source = "CiA 402-2, 6060h, 6061h, 6502h; pp, statusword bit 12; homing method 6098h"
    needs = "no mode of operation was heard together with a statusword or 6502h"
    objects: ClassVar[Mapping[int, bool]] = {
        **{STATUSWORD: False, CONTROLWORD: False, MODE: True, MODE_DISPLAY: True},
        **{_MODES: False, _METHOD: True},
    }

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._modes: dict[Place, _Mode] = {}

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the modes of a node that has booted."""
        forget(self._modes, bus, node)

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Take a command, or examine a report."""
        one = self._modes.setdefault(axis.place, _Mode())
        if index == CONTROLWORD and is_written:
            self._controlled(time_ns, axis, one, value)
        elif index == MODE and is_written:
            one.written, one.written_ns, one.homing_ns = value, time_ns, None
        elif index == MODE_DISPLAY and not is_written:
            self._shown(time_ns, axis, one, value)
        elif index == STATUSWORD and not is_written:
            if axis.state != ENABLED:
                one.is_fresh, one.strange, one.is_attained = one.idle_ns is not None, 0, False
                return
            self._acknowledged(time_ns, axis, one, value)
            self._attained(time_ns, axis, one, value)

    def _controlled(self, time_ns: int, axis: Axis, one: _Mode, word: int) -> None:
        if not word & _EDGE:
            if one.idle_ns is None:
                one.idle_ns = time_ns
            return
        if one.idle_ns is not None and axis.mode == _HM:
            one.homing_ns, one.was_busy = time_ns, not one.is_attained
        one.idle_ns = one.held_ns = None
        one.is_fresh = False

    def _shown(self, time_ns: int, axis: Axis, one: _Mode, shown: int) -> None:
        supported, mode = axis.objects.get((_MODES, 0), 0), one.written
        if mode is None or mode <= 0 or not supported >> mode - 1 & 1:
            return
        if time_ns - one.written_ns < _PATIENCE_NS or axis.state in (REACTION, FAULT, QUICK_STOP):
            return
        if self.examine(time_ns, axis.place[0]) and shown != mode:
            text = f"6061h = {shown}, but 6060h = {mode} since {one.written_ns / 1e9:.6f} s"
            self.absent(axis.violation(time_ns, f"{text}, and 6502h claims it"))

    def _acknowledged(self, time_ns: int, axis: Axis, one: _Mode, word: int) -> None:
        both = TARGET_REACHED | BIT_12
        if axis.mode != _PP or not axis.has_display or one.idle_ns is None:
            one.held_ns = None
            return
        if word & both != both:
            one.held_ns = None
        elif one.held_ns is None:
            one.held_ns = time_ns
        one.strange = one.strange + 1 if one.is_fresh and word & BIT_12 else 0
        if one.strange == _TWICE:
            text = "set-point acknowledge without a set-point since the drive was enabled"
            self.absent(axis.violation(time_ns, text))
        begun_ns = max(one.idle_ns, one.held_ns or time_ns)
        if self.examine(time_ns, axis.place[0]) and time_ns - begun_ns > _PATIENCE_NS:
            text = f"set-point acknowledge stays set, bit 4 is 0 since {one.idle_ns / 1e9:.6f} s"
            self.absent(axis.violation(time_ns, text))

    def _attained(self, time_ns: int, axis: Axis, one: _Mode, word: int) -> None:
        method = axis.objects.get((_METHOD, 0))
        is_attained = word & (TARGET_REACHED | BIT_12 | BIT_13) == TARGET_REACHED | BIT_12
        one.is_attained = is_attained and axis.mode == _HM
        if one.homing_ns is None or axis.mode != _HM or method is None:
            return
        one.was_busy = one.was_busy or not is_attained
        is_new = one.was_busy and is_attained and self.examine(time_ns, axis.place[0])
        if is_new and method in _RESERVED:
            text = f"homing attained by method {method}, which is reserved"
            self.absent(axis.violation(time_ns, text))
