"""LSS slave (CiA 305): setting node-ID and bit timing over the bus.

The LSS address identifies a slave: vendor-ID, product code, revision and serial number (1018h). The
master switches it to *configuration*, alone by its address or together with all others. There it
accepts a pending node-ID and bit timing, and stores them on command. The pending node-ID becomes
active at the next reset of communication. A node without a node-ID (255) takes it when it is
switched back to waiting, and boots. Fastscan finds nodes without a node-ID: it queries the address
bit by bit, and switches the node that it has found.

The emulated bus has a single bit rate. A bit timing is therefore accepted, stored and reported, but
without effect. A node answers in any NMT state but INITIALISING, and always without a node-ID.

Source: CiA 305, LSS protocols; open points as in CANopenNode (305/CO_LSSslave.c).
"""

from collections import deque
from typing import Final, final

from motorhil.emulators.can.frame import pack
from motorhil.emulators.canopen.files.parameter_storage import UNSET, ParameterStore
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import NEVER, Outbox

REQUEST_ID: Final = 0x7E5
RESPONSE_ID: Final = 0x7E4
UNCONFIGURED: Final = 255

# Command specifiers
_SWITCH_GLOBAL: Final = 0x04
_NODE_ID: Final = 0x11
_BIT_TIMING: Final = 0x13
_ACTIVATE: Final = 0x15
_STORE: Final = 0x17
_SELECT: Final = 0x40  # to 43h: the four numbers of the address
_SELECTED: Final = 0x44
_IDENTIFY: Final = 0x46  # to 4Bh: vendor, product, and ranges of revision and serial number
_IDENTIFY_UNCONFIGURED: Final = 0x4C
_IDENTIFIED: Final = 0x4F
_UNCONFIGURED_IDENTIFIED: Final = 0x50
_FASTSCAN: Final = 0x51
_INQUIRE: Final = 0x5A  # to 5Dh: the four numbers of the address
_INQUIRE_NODE_ID: Final = 0x5E

_CONFIRM_ALL: Final = 128  # fastscan's bit check: any unconfigured slave answers
_BIT_TIMINGS: Final = (0, 1, 2, 3, 4, 6, 7, 8)  # allowed indices of table 0
_KBIT_S: Final = (1000, 800, 500, 250, 125, 0, 50, 20, 10)

_OK: Final = 0
_OUT_OF_RANGE: Final = 1
_NO_ACCESS: Final = 2  # to the nonvolatile memory


@final
class LssSlave:
    """An LSS slave.

    Attributes:
        pending_node_id: the node-ID from the next reset of communication on.
        is_configuring: it is in configuration state.
        deadline_ns: when the next response is due.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        node_id: int,
        store: ParameterStore,
        reply_ns: int,
        outbox: Outbox,
    ) -> None:
        self._od = od
        self._own_node_id = node_id
        self._store = store
        self._reply_ns = reply_ns
        self._outbox = outbox
        self._replies: deque[tuple[int, bytes]] = deque()
        self._address: list[int] = [0, 0, 0, 0]
        self._asked: list[int] = [0, 0, 0, 0, 0, 0]  # collected for selecting or identifying
        self._next = 0  # the number that must come next
        self._scanned = 0  # fastscan: the current number of the address
        self._bit_timing: int = UNSET
        self.pending_node_id: int = node_id
        self.is_configuring: bool = False
        self.deadline_ns: int = NEVER

    def reset(self) -> None:
        """Load the stored node-ID and bit timing, else the device's own (power-on, reset node)."""
        stored = self._store.stored
        self.pending_node_id = self._own_node_id if stored.node_id == UNSET else stored.node_id
        self._bit_timing = stored.bit_timing
        self._address = [self._od.integer(0x1018, subindex, 0) for subindex in (1, 2, 3, 4)]

    def wait(self) -> None:
        """Return to waiting at any reset: drop selections, scans and pending responses."""
        self._asked = [0, 0, 0, 0, 0, 0]
        self._next = 0
        self._scanned = 0
        self.is_configuring = False
        self._replies.clear()
        self._find_deadline()

    def receive(self, frame: bytes, node_id: int, now_ns: int) -> bool:
        """Process a request of the master, for the node with this node-ID (255: none).

        Returns:
            True if the node takes its pending node-ID now, by a reset of communication.
        """
        if frame[4] != 8:
            return False
        command = frame[8]
        number = int.from_bytes(frame[9:13], "little")
        is_without = node_id == UNCONFIGURED and self.pending_node_id == UNCONFIGURED
        if command == _SWITCH_GLOBAL:
            return self._switch(frame[9], node_id)
        if _IDENTIFY <= command < _IDENTIFY + 6:
            self._identify(command - _IDENTIFY, number, now_ns)
        elif command == _IDENTIFY_UNCONFIGURED:
            if is_without:
                self._reply(bytes((_UNCONFIGURED_IDENTIFIED,)), now_ns)
        elif self.is_configuring:
            self._configure(command, frame, node_id, now_ns)
        elif _SELECT <= command < _SELECT + 4:
            self._select(command - _SELECT, number, now_ns)
        elif command == _FASTSCAN and is_without:
            self._scan(number, frame[13], frame[14], frame[15], now_ns)
        return False

    def expire(self, now_ns: int) -> None:
        """Send the responses due by now."""
        while self._replies and self._replies[0][0] <= now_ns:
            self._outbox.frames.append(self._replies.popleft()[1])
        self._find_deadline()

    def _switch(self, mode: int, node_id: int) -> bool:
        was_configuring = self.is_configuring
        if mode in (0, 1):
            self.is_configuring = mode == 1
        is_new = node_id == UNCONFIGURED and self.pending_node_id != UNCONFIGURED
        return mode == 0 and was_configuring and is_new

    def _select(self, place: int, number: int, now_ns: int) -> None:
        self._collect(place, number)
        if place == 3 and self._next == 4 and self._asked[:4] == self._address:
            self.is_configuring = True
            self._reply(bytes((_SELECTED,)), now_ns)

    def _identify(self, place: int, number: int, now_ns: int) -> None:
        self._collect(place, number)
        if place != 5 or self._next != 6:
            return
        vendor, product, revision_low, revision_high, serial_low, serial_high = self._asked
        is_meant = self._address[:2] == [vendor, product]
        is_in_revision = revision_low <= self._address[2] <= revision_high
        if is_meant and is_in_revision and serial_low <= self._address[3] <= serial_high:
            self._reply(bytes((_IDENTIFIED,)), now_ns)

    def _collect(self, place: int, number: int) -> None:
        """Collect a number; only numbers in sequence count, from the first one on."""
        self._asked[place] = number
        if place == 0:
            self._next = 1
        elif place == self._next:
            self._next += 1
        else:
            self._next = 0

    def _scan(self, number: int, bit: int, place: int, following: int, now_ns: int) -> None:
        if place > 3 or following > 3 or (bit > 31 and bit != _CONFIRM_ALL):
            return
        if bit == _CONFIRM_ALL:
            self._scanned = 0
        elif place != self._scanned or (self._address[place] ^ number) >> bit:
            return
        else:
            self._scanned = following
            if bit == 0 and following < place:
                self.is_configuring = True  # this slave is identified
        self._reply(bytes((_IDENTIFIED,)), now_ns)

    def _configure(self, command: int, frame: bytes, node_id: int, now_ns: int) -> None:
        """Process a request that is valid in configuration state only."""
        if command == _NODE_ID:
            is_one = 1 <= frame[9] <= 127 or frame[9] == UNCONFIGURED
            if is_one:
                self.pending_node_id = frame[9]
            self._reply(bytes((command, _OK if is_one else _OUT_OF_RANGE)), now_ns)
        elif command == _BIT_TIMING:
            is_one = frame[9] == 0 and frame[10] in _BIT_TIMINGS
            if is_one:
                self._bit_timing = frame[10]
            self._reply(bytes((command, _OK if is_one else _OUT_OF_RANGE)), now_ns)
        elif command == _ACTIVATE:
            if self._bit_timing != UNSET:
                rate = _KBIT_S[self._bit_timing]
                text = f"LSS: bit timing {self._bit_timing} ({rate} kbit/s); the bus stays as it is"
                self._outbox.events.append(("info", text))
        elif command == _STORE:
            is_kept = self._store.save_lss(self.pending_node_id, self._bit_timing)
            self._reply(bytes((command, _OK if is_kept else _NO_ACCESS)), now_ns)
        elif _INQUIRE <= command < _INQUIRE + 4:
            number = self._address[command - _INQUIRE]
            self._reply(bytes((command,)) + number.to_bytes(4, "little"), now_ns)
        elif command == _INQUIRE_NODE_ID:
            self._reply(bytes((command, node_id)), now_ns)

    def _reply(self, data: bytes, now_ns: int) -> None:
        frame = pack(RESPONSE_ID, data.ljust(8, b"\0"))
        if not self._reply_ns:
            self._outbox.frames.append(frame)
            return
        self._replies.append((now_ns + self._reply_ns, frame))
        self._find_deadline()

    def _find_deadline(self) -> None:
        self.deadline_ns = self._replies[0][0] if self._replies else NEVER
        self._outbox.deadlines_moved = True
