"""EMCY producer (CiA 301, 7.2.7): emergency messages, error register, error history.

A device reports its own errors with `report`. Errors found by the node itself (a short RPDO, a lost
heartbeat) are kept by key until they are repaired. The error register 1001h therefore stays
correct: bit 0 (generic error) and bit 4 (communication error) are set while any such error lasts.
The history is 1003h.

Two EMCYs are separated by at least the inhibit time (1015h, in 100 us); waiting ones are sent in
order. At most `WAITING_MAX` wait; older ones are dropped and reported as an event.

The state of the CAN controller has these effects. Error passive is an error as long as it lasts
(EMCY 8120h). Bus-off is a communication error like a lost heartbeat. 1029h:1 gives the NMT state
that it leads to. The device around the node decides on other effects (6007h). A bus-off node cannot
send, so it reports the bus-off after recovery (EMCY 8140h). The node does not boot then: its
configuration stays.

Frames that waited for the bus at bus-off are lost. New frames wait as in the mailboxes of a CAN
controller, one for each identifier: newer data replace older data. Emergencies are all kept.

Source: CiA 301, 7.2.7.1 (table 26) and 1029h; Linux include/uapi/linux/can/error.h.
"""

from collections import deque
from enum import IntEnum, unique
from typing import Final, Protocol, final

from motorhil.emulators.can import error_confinement as e
from motorhil.emulators.can.frame import pack
from motorhil.emulators.canopen.codes import INVALID, UPPER_BITS, AbortCode, is_restricted
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.canopen.outbox import NEVER, Outbox

# Error codes (CiA 301, table 26)
ERROR_RESET: Final = 0x0000
COMMUNICATION: Final = 0x8100
HEARTBEAT_LOST: Final = 0x8130
PDO_NOT_PROCESSED: Final = 0x8210  # because of a length error
PDO_LENGTH_EXCEEDED: Final = 0x8220
SYNC_LENGTH: Final = 0x8240
RPDO_TIMEOUT: Final = 0x8250

# Keys of errors found by the node: for a length error the number of the RPDO; greater values for
# others.
RPDO_TIMEOUT_KEY: Final = 0x1000  # + number
SYNC_LENGTH_KEY: Final = 0x2000
WINDOW_KEY: Final = 0x2001
HEARTBEAT_KEY: Final = 0x1_0000  # + node-ID; + 0: node guarding
BUS_KEY: Final = 0x2_0000

WAITING_MAX: Final = 32

_GENERIC: Final = 0x01
_COMMUNICATION: Final = 0x10
_RESERVED: Final = 1 << 30  # of 1014h
_VENDOR_BYTES: Final = 5
_LONG_AGO: Final = -NEVER

ERROR_PASSIVE: Final = 0x8120
BUS_OFF_RECOVERED: Final = 0x8140

_EMCY_FUNCTION: Final = 0x080
_PASSIVE: Final = e.RX_PASSIVE | e.TX_PASSIVE
_ACTIVE: Final = e.ERROR_ACTIVE | e.RX_WARNING | e.TX_WARNING


class ChangeListener(Protocol):
    """A listener for changes of values by the device itself."""

    def object_changed(self, index: int, subindex: int, now_ns: int) -> None:
        """Handle a new value of the variable."""


@final
class EmcyProducer:
    """The keeper of 1001h and 1003h; sends EMCY while allowed (PRE-OPERATIONAL, OPERATIONAL).

    Attributes:
        deadline_ns: when the next waiting EMCY may be sent.
    """

    def __init__(
        self, od: ObjectDictionary, node_id: int, outbox: Outbox, listener: ChangeListener
    ) -> None:
        self._od = od
        self._outbox = outbox
        self._listener = listener
        self._can_id = 0  # 0: EMCY does not exist
        self._device_register = 0
        self._register = 0  # as last reported
        self._standing: dict[int, int] = {}  # key -> error code
        self._history = tuple(sub for sub in od.subindices(0x1003) if sub)
        self._inhibit_ns = 0
        self._waiting: deque[bytes] = deque()
        self._sent_ns: int = _LONG_AGO
        self._may_send = False
        self.deadline_ns: int = NEVER
        self._cob_id = od.ensure(0x1014, 0, DataType.UNSIGNED32, 0x80 + node_id, True)
        self._cob_id.writer = self.check_cob_id
        count = od.get(0x1003)
        if count is not None:
            count.writer = self.check_history

    def configure(self, now_ns: int) -> None:
        """Read identifier and inhibit time from 1014h and 1015h; waiting EMCYs follow these."""
        cob_id = self._cob_id.integer()
        self._can_id = 0 if cob_id & INVALID else cob_id & 0x7FF
        self._inhibit_ns = self._od.integer(0x1015, 0, 0) * 100_000
        if self._waiting:
            self._move()
            self.deadline_ns = max(self.deadline_ns, now_ns)  # the new time may be over already

    def allow(self, may_send: bool) -> None:
        """Allow or forbid EMCY by NMT state; forbidding discards waiting messages."""
        self._may_send = may_send
        if not may_send and self._waiting:
            self._waiting.clear()
            self._move()

    def reset(self, whole: bool) -> None:
        """Forget the node's own errors except CAN errors; on reset node the device's as well."""
        of_can = self._standing.get(BUS_KEY)
        self._standing.clear()
        if of_can is not None:  # a reset of the node does not repair the bus
            self._standing[BUS_KEY] = of_can
        self._sent_ns = _LONG_AGO
        if whole:
            self._device_register = 0
        self._register = self._keep_register()

    def report(self, code: int, register: int, vendor: bytes, now_ns: int) -> None:
        """Report an error of the device; `register` are its own bits of 1001h from now on."""
        self._device_register = register
        self._emit(code, vendor, now_ns)

    def stand(self, register: int, now_ns: int) -> None:
        """Set the device's own bits of 1001h without sending an EMCY."""
        self._device_register = register
        self._tell_register(now_ns)

    def find(self, key: int, code: int, vendor: bytes, now_ns: int) -> None:
        """Record a communication error found by the node; report it only the first time."""
        if self._standing.get(key) != code:
            self._standing[key] = code
            self._emit(code, vendor, now_ns)

    def repair(self, key: int, now_ns: int) -> None:
        """End the error with this key."""
        if key in self._standing:
            del self._standing[key]
            self._emit(ERROR_RESET, b"", now_ns)

    def expire(self, now_ns: int) -> None:
        """Send the next waiting EMCY after the inhibit time; without inhibit time send all."""
        while self._waiting and self._sent_ns + self._inhibit_ns <= now_ns:
            self._outbox.frames.append(self._waiting.popleft())
            self._sent_ns = now_ns
        self._move()

    def history_length(self) -> int:
        """Return the number of errors in the history 1003h."""
        return self._od.integer(0x1003, 0, 0)

    def check_cob_id(self, value: int) -> int:
        """Return the abort code for a new value of 1014h, or 0."""
        old = self._cob_id.integer()
        if value & (UPPER_BITS | _RESERVED):
            return AbortCode.INVALID_VALUE
        if not value & INVALID:
            if is_restricted(value & 0x7FF):
                return AbortCode.INVALID_VALUE
            if not old & INVALID and (old ^ value) & 0x7FF:
                return AbortCode.INVALID_VALUE  # set it invalid first
        return 0

    def check_history(self, value: int) -> int:
        """Accept only 0 for 1003h:0, which clears the history."""
        return AbortCode.INVALID_VALUE if value else 0

    def _keep_register(self) -> int:
        register = self._device_register
        if self._standing:
            register |= _COMMUNICATION
        if register:
            register |= _GENERIC
        variable = self._od.get(0x1001)
        if variable is not None:
            variable.value = register
        return register

    def _tell_register(self, now_ns: int) -> int:
        register = self._keep_register()
        if register != self._register:
            self._register = register
            self._listener.object_changed(0x1001, 0, now_ns)
        return register

    def _emit(self, code: int, vendor: bytes, now_ns: int) -> None:
        register = self._keep_register()
        if code != ERROR_RESET:
            self._remember(code | int.from_bytes(vendor[:2], "little") << 16)
        if self._may_send and self._can_id:
            head = bytes((code & 0xFF, code >> 8 & 0xFF, register))
            tail = vendor[:_VENDOR_BYTES].ljust(_VENDOR_BYTES, b"\0")
            self._send(pack(self._can_id, head + tail), now_ns)
        self._tell_register(now_ns)

    def _send(self, frame: bytes, now_ns: int) -> None:
        if not self._inhibit_ns and not self._waiting:
            self._outbox.frames.append(frame)
            return
        if not self._waiting and self._sent_ns + self._inhibit_ns <= now_ns:
            self._sent_ns = now_ns
            self._outbox.frames.append(frame)
            return
        self._waiting.append(frame)
        if len(self._waiting) > WAITING_MAX:
            self._waiting.popleft()
            text = (
                f"more than {WAITING_MAX} EMCYs wait for the inhibit time: the oldest is left out"
            )
            self._outbox.events.append(("warning", text))
        self._move()

    def _move(self) -> None:
        self.deadline_ns = self._sent_ns + self._inhibit_ns if self._waiting else NEVER
        self._outbox.deadlines_moved = True

    def _remember(self, entry: int) -> None:
        """Insert the entry as the newest of the history; the oldest is dropped."""
        count = self._od.get(0x1003)
        if count is None or not self._history:
            return
        held = min(self.history_length() + 1, len(self._history))
        values = [self._od.integer(0x1003, sub, 0) for sub in self._history[: held - 1]]
        for sub, value in zip(self._history[:held], [entry, *values], strict=True):
            variable = self._od.get(0x1003, sub)
            if variable is not None:
                variable.value = value
        count.value = held


@final
@unique
class CanState(IntEnum):
    """The participation of a CAN controller (ISO 11898-1, error confinement)."""

    ACTIVE = 0
    PASSIVE = 1
    OFF = 2


def state_in(message: bytes) -> CanState | None:
    """Return the state in an error message, or None if it contains none."""
    classes = int.from_bytes(message[:4], "little")
    if classes & e.MESSAGE_BUS_OFF:
        return CanState.OFF
    if classes & e.CONTROLLER:
        status = message[9]
        if status & _PASSIVE:
            return CanState.PASSIVE
        if status & _ACTIVE:
            return CanState.ACTIVE
    return CanState.ACTIVE if classes & e.RESTARTED else None


@final
class CanWatch:
    """The last reported state of the CAN controller of a node.

    Attributes:
        is_off: the node is off the bus.
    """

    def __init__(self, emcy: EmcyProducer, outbox: Outbox) -> None:
        self.is_off: bool = False
        self._state: CanState = CanState.ACTIVE
        self._emcy = emcy
        self._outbox = outbox
        self._mailboxes: dict[bytes, bytes] = {}

    def hear(self, message: bytes, now_ns: int) -> bool:
        """Process an error message and return whether the node has just gone off the bus."""
        state = state_in(message)
        before = self._state
        if state is None or state is before:
            return False
        self._state = state
        self.is_off = state is CanState.OFF
        if state is CanState.OFF:
            self._outbox.events.append(("error", "bus-off" + _counters(message)))
            return True
        if before is CanState.OFF:
            self._outbox.frames = [*self._mailboxes.values(), *self._outbox.frames]
            self._mailboxes.clear()
            self.recover(now_ns)
        if state is CanState.PASSIVE:
            self._outbox.events.append(("warning", "CAN error passive" + _counters(message)))
            self.find(ERROR_PASSIVE, now_ns)
        elif before is CanState.PASSIVE:
            self._outbox.events.append(("info", "CAN error active again"))
            self.repair(now_ns)
        return False

    def find(self, code: int, now_ns: int) -> None:
        """Report a CAN error, which lasts until `repair`."""
        self._emcy.find(BUS_KEY, code, b"", now_ns)

    def repair(self, now_ns: int) -> None:
        """End the CAN error."""
        self._emcy.repair(BUS_KEY, now_ns)

    def recover(self, now_ns: int) -> None:
        """Report a past bus-off after the node is on the bus again."""
        self._outbox.events.append(("info", "recovered from bus-off"))
        self.find(BUS_OFF_RECOVERED, now_ns)
        self.repair(now_ns)

    def hold(self, frames: list[bytes]) -> None:
        """Keep these frames until the node is on the bus again."""
        for frame in frames:
            function = int.from_bytes(frame[:2], "little") & 0x780
            self._mailboxes[frame if function == _EMCY_FUNCTION else frame[:4]] = frame


def _counters(message: bytes) -> str:
    classes = int.from_bytes(message[:4], "little")
    return f" (TEC {message[14]}, REC {message[15]})" if classes & e.COUNTERS else ""
