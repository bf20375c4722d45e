"""Oracles of a node's services: NMT states, refusals by SDO, errors and their history.

Source: CiA 301: NMT state machine, boot-up protocol, SDO abort codes, objects 1001h, 1003h, 1010h
and 1011h.
"""

from collections.abc import Mapping
from typing import ClassVar, Final, final

from motorhil.harness.oracles.base import MS, Axis, Oracle, RecordingContext
from motorhil.traces.decoding.events import DecodedEvent, Kind

_Node = tuple[str, int]
_SETTLE_NS: Final = 100 * MS
"""A message from before a command may still wait for the bus."""
_RESETS: Final = (0x81, 0x82)
_LEAVES: Final = {0x02: "stop", 0x80: "enter pre-operational"}
_OPERATIONAL: Final = 5
_NO_OBJECT: Final = 0x0602_0000
_SIGNATURES: Final = {0x1010: 0x6576_6173, 0x1011: 0x6461_6F6C}  # "save", "load"
_MANDATORY: Final = (0x1000, 0x1001)  # 1018h was optional before version 4
_MAPPINGS: Final = (range(0x1600, 0x1800), range(0x1A00, 0x1C00))
_BOOT_NS: Final = 10_000 * MS
"""A reset node boots within this time; CiA 301 names none."""
_LISTED_NS: Final = 2 * MS


@final
class NmtStates(Oracle):
    """The oracle `nmt-obeyed`."""

    id = "nmt-obeyed"
    promise = "A reset node sends its boot-up first; a node told to leave operational reports so"
    source = "CiA 301, NMT state machine, boot-up protocol, heartbeat protocol"
    needs = "no node was heard after an NMT command: reset, stop or enter pre-operational"

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._told: dict[tuple[str, int | None], tuple[int, int]] = {}  # time, command
        self._booted: dict[_Node, int] = {}

    def nmt(self, time_ns: int, bus: str, node: int | None, command: int) -> None:
        """Take a command."""
        self._told[bus, node] = time_ns, command

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Take a boot-up: earlier commands are done."""
        self._booted[bus, node] = time_ns

    def heartbeat(self, time_ns: int, bus: str, node: int, state: int) -> None:
        """Examine a state."""
        told_ns, command = self._last(bus, node)
        if not command or time_ns - told_ns <= _SETTLE_NS or self.context.is_program(bus, node):
            return
        self._after_reset(time_ns, (bus, node))
        if command in _LEAVES and self.examine(time_ns, bus) and state == _OPERATIONAL:
            text = f"operational, {_LEAVES[command]} was commanded at {told_ns / 1e9:.6f} s"
            self.absent(self.context.violation_of(time_ns, text, (bus, node)))

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Examine an answer after a reset."""
        if event.kind is Kind.SDO_RESPONSE and event.node is not None:
            self._after_reset(time_ns, (bus, event.node))

    def end(self, time_ns: int) -> None:
        """Examine the reset nodes that have been silent since."""
        for bus, node in self.context.seen_nodes:
            told_ns, _ = self._last(bus, node)
            if time_ns - told_ns > _BOOT_NS and not self.context.is_program(bus, node):
                self._after_reset(time_ns, (bus, node))

    def _last(self, bus: str, node: int) -> tuple[int, int]:
        """Return time and number of the last command since the boot-up; 0, 0: none."""
        told = max(self._told.get((bus, one), (0, 0)) for one in (node, None))
        return told if told[0] > self._booted.get((bus, node), -1) else (0, 0)

    def _after_reset(self, time_ns: int, node: _Node) -> None:
        told_ns, command = self._last(*node)
        if command not in _RESETS or time_ns - told_ns <= _SETTLE_NS:
            return
        self._booted[node] = time_ns
        if self.examine(time_ns, node[0]):
            text = f"no boot-up since the reset at {told_ns / 1e9:.6f} s"
            self.absent(self.context.violation_of(time_ns, text, node))


@final
class Refusals(Oracle):
    """The oracle `sdo-refusals`."""

    id = "sdo-refusals"
    promise = (
        "No SDO abort denies an object that the node has shown, or that is mandatory; 1010h and "
        "1011h take nothing but their signatures"
    )
    source = "CiA 301, SDO abort codes, 1010h store parameters, 1011h restore default parameters"
    needs = "no node refused an SDO request, and none was told to store or restore parameters"
    objects: ClassVar[Mapping[int, bool]] = dict.fromkeys(_SIGNATURES, False)

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._shown: dict[tuple[str, int, int], None] = {}

    def sdo(self, time_ns: int, bus: str, event: DecodedEvent, data: bytes) -> None:
        """Take a shown object, or examine an abort."""
        node, index = event.node, event.index
        if event.kind is not Kind.SDO_RESPONSE or node is None or index is None or len(data) < 8:
            return
        if int.from_bytes(data[1:3], "little") != index:
            return
        if data[0] >> 5 in (2, 3):
            self._shown[bus, node, index] = None
        elif data[0] == 0x80 and self.examine(time_ns, bus):
            code = int.from_bytes(data[4:8], "little")
            is_known = index in _MANDATORY or (bus, node, index) in self._shown
            if any(index in mappings for mappings in _MAPPINGS):
                is_known = False  # the code is of the object to be mapped
            if code == _NO_OBJECT and is_known:
                why = "it is mandatory" if index in _MANDATORY else "it was shown before"
                text = f"{index:04X}h:{data[3]} refused as an unknown object; {why}"
                self.broken(self.context.violation_of(time_ns, text, (bus, node)))

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine a confirmed signature."""
        is_told = is_written and subindex > 0 and self.examine(time_ns, axis.place[0])
        if is_told and value != _SIGNATURES[index]:
            text = f"{index:04X}h:{subindex} takes {value:08X}h, which is not its signature"
            self.broken(axis.violation(time_ns, text))


@final
class ErrorsListed(Oracle):
    """The oracle `errors-listed`."""

    id = "errors-listed"
    promise = "An EMCY with an error code has an error register other than 0, and 1003h lists it"
    source = "CiA 301, EMCY write protocol, 1001h error register, 1003h pre-defined error field"
    needs = "no EMCY with an error code was heard"
    objects: ClassVar[Mapping[int, bool]] = {0x1003: False}

    def __init__(self, context: RecordingContext) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(context)
        self._sent: dict[_Node, tuple[int, int]] = {}  # time and code

    def boot(self, time_ns: int, bus: str, node: int) -> None:
        """Forget the errors of a node that has booted."""
        self._sent.pop((bus, node), None)

    def emergency(self, time_ns: int, bus: str, node: int, code: int, register: int) -> None:
        """Examine the error register."""
        if not code or not self.examine(time_ns, bus):
            return
        self._sent.setdefault((bus, node), (time_ns, code))
        if not register:  # some drives set the bit of the kind of error alone
            text = f"EMCY {code:04X}h with the error register 00h, which is no error"
            self.broken(self.context.violation_of(time_ns, text, (bus, node)))

    def value(
        self, time_ns: int, axis: Axis, index: int, subindex: int, value: int, is_written: bool
    ) -> None:
        """Examine the number of listed errors."""
        node = axis.place[:2]
        if subindex or node not in self._sent:
            return
        since_ns, code = self._sent[node]
        if is_written:
            del self._sent[node]
        elif time_ns - since_ns > _LISTED_NS and self.examine(time_ns, node[0]) and not value:
            text = f"1003h lists no error after EMCY {code:04X}h at {since_ns / 1e9:.6f} s"
            self.absent(axis.violation(time_ns, text))
