"""A CANopen node (CiA 301): NMT and services over one dictionary.

SDO server, PDOs, SYNC, TIME, EMCY, error control, parameter store and LSS have modules of their own
and do not know the node. A drive contains a node, and implements `NodeHost` for it.

All communication objects must be in the dictionary before the node is created, because the node
attaches its checks to them. Their power-on values apply from `start` on. Each part of the node
validates a write first (by the variable's writer). Then it reads its settings from the dictionary
again, so the dictionary is the only place of a setting.

Frames are dispatched by one look-up in a dict, keyed by the four identifier bytes. The dict holds
only what the present NMT state accepts, so the parts need not check the state. Remote frames and
29-bit identifiers have no entry, except remote frames that guard this node or request its TPDOs.
"""

from collections.abc import Callable, Sequence
from typing import Final, final

from motorhil.emulators.can.frame import ERR_FLAG, RTR_FLAG
from motorhil.emulators.canopen.emcy import CanWatch, EmcyProducer
from motorhil.emulators.canopen.error_control import ErrorControl
from motorhil.emulators.canopen.files.parameter_storage import ParameterStore
from motorhil.emulators.canopen.lss import REQUEST_ID as LSS_REQUEST_ID
from motorhil.emulators.canopen.lss import UNCONFIGURED, LssSlave
from motorhil.emulators.canopen.nmt import (
    COMMUNICATION,
    DEVICE,
    TRANSITIONS,
    NmtCommand,
    NmtState,
    commanded,
    state_after,
)
from motorhil.emulators.canopen.object_dictionary import DictionaryAccess, ObjectDictionary
from motorhil.emulators.canopen.outbox import NEVER, NodeHost, NodeTiming, Outbox
from motorhil.emulators.canopen.pdo import PdoService
from motorhil.emulators.canopen.sdo_server import SdoServer, sdo_can_id
from motorhil.emulators.canopen.sync import SyncService, TimeConsumer
from motorhil.emulators.controller import NonvolatileMemory, RigMemory

Handler = Callable[[bytes, int], None]

_ERROR_BYTE: Final = ERR_FLAG >> 24


@final
class Routes:
    """The identifiers of a node in any state, and the handlers active in the present one.

    Attributes:
        handlers: by the identifier's four bytes.
    """

    def __init__(self) -> None:
        self.handlers: dict[bytes, Handler] = {}
        self._wanted: dict[int, None] = {}

    def add(self, can_id: int, handler: Handler, is_active: bool) -> None:
        """Listen to this identifier, in this state (`is_active`) or in another one."""
        self.want(can_id)
        if is_active:
            key = can_id.to_bytes(4, "little")
            taken = self.handlers.get(key)
            self.handlers[key] = handler if taken is None else _Both(taken, handler).receive

    def want(self, can_id: int) -> None:
        """Listen to this identifier without a handler."""
        self._wanted[can_id] = None

    def identifiers(self) -> tuple[int, ...]:
        """Return all identifiers listened to, ascending."""
        return tuple(sorted(self._wanted))


@final
class _Both:
    """Two parts of the node that listen to one identifier."""

    def __init__(self, first: Handler, second: Handler) -> None:
        self._first = first
        self._second = second

    def receive(self, frame: bytes, now_ns: int) -> None:
        self._first(frame, now_ns)
        self._second(frame, now_ns)


@final
class CanopenNode:
    """A CANopen slave, sans-I/O. Frames are Linux can_frame, 16 bytes; times int ns from 0.

    `state` is the NMT state. `outbox` holds the results of `take_output` and `take_events`, and
    whether `deadline_ns` may have changed. Both are read only for callers. `can` watches CAN
    itself.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        node_id: int,
        timing: NodeTiming,
        host: NodeHost,
        memory: NonvolatileMemory | None = None,
    ) -> None:
        if not 1 <= node_id <= 127 and node_id != UNCONFIGURED:
            raise ValueError(
                f"node_id {node_id}: invalid; expected 1..127, or {UNCONFIGURED} for none"
            )
        self.od = od
        self.node_id: int = node_id
        self.state: int = NmtState.INITIALISING
        self._timing = timing
        self._host = host
        self.outbox: Outbox = Outbox()
        if od.node_id == 0:
            od.node_id = 1 if node_id == UNCONFIGURED else node_id
        defaults_of = od.node_id
        self._store = ParameterStore(od, RigMemory() if memory is None else memory, self.outbox)
        self._emcy = EmcyProducer(od, defaults_of, self.outbox, self)
        self.can: CanWatch = CanWatch(self._emcy, self.outbox)
        self._sync = SyncService(od, self._emcy, self.outbox)
        self._sdo = SdoServer(DictionaryAccess(od, host, self), timing.sdo_reply_ns, self.outbox)
        self._pdos = PdoService(od, defaults_of, self._emcy, self._sync, self.outbox, host)
        self._error_control = ErrorControl(od, defaults_of, self._emcy, self.outbox)
        self._time = TimeConsumer(od, self.outbox)
        self._lss = LssSlave(od, node_id, self._store, timing.sdo_reply_ns, self.outbox)
        self._due_ns: int = NEVER  # boot-up, or a pending NMT reaction to a device error
        self._deadline_ns: int = NEVER
        self._pdos_deadline_ns: int = NEVER
        self._rest_deadline_ns: int = NEVER  # of all parts but PDOs and SDOs
        self._handlers: dict[bytes, Handler] = {}
        self._identifiers: tuple[int, ...] = ()
        self._identifiers_revision = 0

    # --- for a Controller

    def start(self, now_ns: int) -> None:
        """Power on: set all values to defaults or as stored; boot up after `boot_up_ns`."""
        self.outbox.frames.clear()
        self._store.load()
        self._reset(True, now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame on the bus; frames that are not for this node are ignored."""
        handler = self._handlers.get(data[:4])
        if handler is not None:
            handler(data, now_ns)
        elif data[3] & _ERROR_BYTE and self.can.hear(data, now_ns):
            self._pdos.abandon(now_ns)
            self._react(COMMUNICATION, now_ns)
            self._host.on_bus_off(now_ns)

    def sent(self, data: bytes, now_ns: int) -> None:
        """Confirm that an own frame has left the bus; required, because TPDOs wait for it."""
        self._pdos.confirm(data, now_ns)

    def wants_sent(self) -> bool:
        """Return True: `sent` must be called."""
        return True

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""
        deadline_ns = self.deadline_ns()
        return None if deadline_ns == NEVER else deadline_ns

    def deadline_ns(self) -> int:
        """Return `next_deadline_ns`, with NEVER for None."""
        if self.outbox.deadlines_moved:
            self._find_deadline()
        return self._deadline_ns

    def expire(self, now_ns: int) -> None:
        """Process everything due at `now_ns`."""
        if self.outbox.deadlines_moved:
            self._find_deadline()
        is_rare = self._rest_deadline_ns <= now_ns
        if is_rare and self._due_ns <= now_ns:
            self._due_ns = NEVER
            self.outbox.deadlines_moved = True
            if self.state == NmtState.INITIALISING:
                self._error_control.boot_up(now_ns)
                self._enter(NmtState.PRE_OPERATIONAL, now_ns)  # transition 2
            else:
                self._react(DEVICE, now_ns)
        if self._sdo.deadline_ns <= now_ns:
            self._sdo.expire(now_ns)
        if is_rare:
            self._expire_rest(now_ns)
        if self._pdos_deadline_ns <= now_ns:
            self._pdos.expire(now_ns)

    def _expire_rest(self, now_ns: int) -> None:
        if self._error_control.deadline_ns <= now_ns:
            for node_id in self._error_control.expire(now_ns):
                self._lose(node_id, now_ns)
        if self._emcy.deadline_ns <= now_ns:
            self._emcy.expire(now_ns)
        if self._sync.deadline_ns <= now_ns:
            self._send_sync(now_ns)
        if self._lss.deadline_ns <= now_ns:
            self._lss.expire(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to send now, in order; () if none."""
        frames = self.outbox.frames
        if not frames:
            return ()
        self.outbox.frames = []
        if self.can.is_off:
            self.can.hold(frames)
            return ()
        return frames

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of each event since the last call; () if none."""
        events = self.outbox.events
        if not events:
            return ()
        self.outbox.events = []
        return events

    def identifiers(self) -> Sequence[int]:
        """Return the CAN identifiers that this node listens to, in any NMT state."""
        return self._identifiers

    def identifiers_revision(self) -> int:
        """Return a number that increases with every change of `identifiers`."""
        return self._identifiers_revision

    # --- for the device around the node

    def emergency(self, code: int, error_register: int, vendor: bytes, now_ns: int) -> None:
        """Send EMCY (PRE-OPERATIONAL, OPERATIONAL) and update 1001h and the history 1003h.

        Args:
            code: the error code (603Fh); 0000h reports that errors are gone.
            error_register: the device's own bits of 1001h from now on. Bit 0 (generic error) is set
                with any other; communication errors found by the node are added.
            vendor: up to 5 manufacturer-specific bytes.
            now_ns: the time [ns].
        """
        self._emcy.report(code, error_register, vendor, now_ns)
        is_of_device = code != 0 and not 0x8100 <= code < 0x8300
        reacts = is_of_device and state_after(self.od, DEVICE, self.state) != self.state
        if reacts and self._due_ns == NEVER:
            self._due_ns = now_ns  # not from within the host's call
            self.outbox.deadlines_moved = True

    def errors_stand(self, error_register: int, now_ns: int) -> None:
        """Set the device's own bits of 1001h without sending an EMCY."""
        self._emcy.stand(error_register, now_ns)

    def object_changed(self, index: int, subindex: int, now_ns: int) -> None:
        """Trigger the TPDOs that map this variable: types 254, 255 at once, type 0 at SYNC."""
        self._pdos.changed(index, subindex, now_ns)

    # --- for the parts of the node

    def configured(self, index: int, subindex: int, now_ns: int) -> None:
        """Let the part concerned reread its settings after a write to 1000h..1FFFh."""
        if 0x1400 <= index <= 0x1BFF:
            self._pdos.configure(index, now_ns)
        elif index in (0x1005, 0x1006, 0x1007, 0x1019):
            self._sync.configure(index, now_ns)
            if index == 0x1019:
                self._pdos.configure_counter(now_ns)
        elif index == 0x1012:
            self._time.configure()
        elif index in (0x1014, 0x1015):
            self._emcy.configure(now_ns)
            return
        elif index in (0x100C, 0x100D, 0x1016, 0x1017):
            self._error_control.configure(index, subindex, now_ns)
        else:
            return
        self._listen()

    def _find_deadline(self) -> None:
        self.outbox.deadlines_moved = False
        deadline_ns = self._due_ns
        if self._error_control.deadline_ns < deadline_ns:
            deadline_ns = self._error_control.deadline_ns
        if self._sync.deadline_ns < deadline_ns:
            deadline_ns = self._sync.deadline_ns
        if self._emcy.deadline_ns < deadline_ns:
            deadline_ns = self._emcy.deadline_ns
        if self._lss.deadline_ns < deadline_ns:
            deadline_ns = self._lss.deadline_ns
        self._rest_deadline_ns = deadline_ns
        pdos_ns = self._pdos_deadline_ns = self._pdos.deadline_ns()
        if pdos_ns < deadline_ns:
            deadline_ns = pdos_ns
        if self._sdo.deadline_ns < deadline_ns:
            deadline_ns = self._sdo.deadline_ns
        self._deadline_ns = deadline_ns

    # --- NMT

    def _on_nmt_frame(self, frame: bytes, now_ns: int) -> None:
        command = commanded(frame, self.node_id)
        state = TRANSITIONS.get((self.state, command))
        if state is None:
            return
        if state == NmtState.INITIALISING:
            self._reset(command == NmtCommand.RESET_NODE, now_ns)
        else:
            self._enter(state, now_ns)

    def _reset(self, whole: bool, now_ns: int) -> None:
        self._sdo.stop()
        self._error_control.stop()
        self._enter(NmtState.INITIALISING, now_ns)
        if whole:
            self._lss.reset()
        self._lss.wait()
        self._take_node_id(self._lss.pending_node_id)
        first, last = (0, 0xFFFF) if whole else (0x1000, 0x1FFF)
        self.od.reset(first, last)
        self._store.apply(first, last)
        self._emcy.reset(whole)
        self._configure_all(now_ns)
        delay_ns = self._timing.boot_up_ns if whole else self._timing.reset_communication_ns
        self._due_ns = NEVER if self.node_id == UNCONFIGURED else now_ns + delay_ns
        self.outbox.deadlines_moved = True
        self._host.on_reset(whole, now_ns)

    def _take_node_id(self, node_id: int) -> None:
        """Use this node-ID from now on; UNCONFIGURED: none, only LSS can reach the node."""
        self.node_id = node_id
        if node_id != UNCONFIGURED:
            self.od.follow(node_id)
            self._error_control.take_node_id(node_id)

    def _on_lss(self, frame: bytes, now_ns: int) -> None:
        if self._lss.receive(frame, self.node_id, now_ns):
            self._reset(False, now_ns)

    def _configure_all(self, now_ns: int) -> None:
        self._sync.configure(0x1005, now_ns)
        self._emcy.configure(now_ns)
        self._time.configure()
        self._error_control.reset(now_ns)
        self._pdos.configure_all(now_ns)
        self._sdo.configure(sdo_can_id(self.od, 2, 0x580 + self.node_id))
        self._listen()

    def _enter(self, state: int, now_ns: int) -> None:
        """Change `state`; the only place that writes it."""
        before = self.state
        if state == before:
            return
        self.state = state
        self._error_control.state = state
        can_talk = state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
        self._emcy.allow(can_talk)
        self._sync.enter(can_talk, now_ns)
        if not can_talk:
            self._sdo.stop()
        if before == NmtState.OPERATIONAL:
            self._pdos.stop()
        self._listen()
        self._host.on_nmt(state, now_ns)
        if state == NmtState.OPERATIONAL:
            self._pdos.start(now_ns)

    # --- dispatching

    def _listen(self) -> None:
        """Set the handlers for the present state and settings."""
        routes = Routes()
        state = self.state
        can_talk = state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
        is_operational = state == NmtState.OPERATIONAL
        is_initialised = state != NmtState.INITIALISING
        if self.od.supports_lss:
            routes.add(LSS_REQUEST_ID, self._on_lss, is_initialised or self.node_id == UNCONFIGURED)
        routes.add(0x000, self._on_nmt_frame, is_initialised)
        routes.add(self._sync.can_id, self._sync_handler(), can_talk)
        routes.want(ERR_FLAG)
        if self._time.can_id:
            routes.add(self._time.can_id, self._time.receive, can_talk)
        routes.add(sdo_can_id(self.od, 1, 0x600 + self.node_id), self._sdo.receive, can_talk)
        routes.add(self._error_control.guard_id(), self._error_control.guard, is_initialised)
        for can_id in self._error_control.heartbeat_ids():
            routes.add(can_id, self._error_control.heartbeat, is_initialised)
        for rpdo in self._pdos.rpdos:
            if rpdo.can_id:
                receive = rpdo.receive if rpdo.is_plain() else rpdo.receive_watched
                routes.add(rpdo.can_id, receive, is_operational)
        for tpdo in self._pdos.tpdos:
            if tpdo.may_be_asked:
                routes.add(tpdo.can_id | RTR_FLAG, tpdo.requested, is_operational)
        self._handlers = routes.handlers
        identifiers = routes.identifiers()
        if identifiers != self._identifiers:
            self._identifiers = identifiers
            self._identifiers_revision += 1

    def _sync_handler(self) -> Handler:
        """Return the cheapest SYNC handler for the present state and settings."""
        if self.state != NmtState.OPERATIONAL:
            return self._on_idle_sync
        return self._on_sync if self._sync.is_plain() else self._on_watched_sync

    def _on_sync(self, frame: bytes, now_ns: int) -> None:
        """Handle SYNC in OPERATIONAL without counter and window, after a correct one."""
        if frame[4] == 0:
            self._pdos.sync(now_ns)
        else:
            self._sync.is_right(frame, now_ns)
            self._listen()

    def _on_idle_sync(self, frame: bytes, now_ns: int) -> None:
        self._sync.is_right(frame, now_ns)  # PRE-OPERATIONAL: without PDOs

    def _on_watched_sync(self, frame: bytes, now_ns: int) -> None:
        if self._sync.is_right(frame, now_ns):
            self._sync_now(frame[8], now_ns)
            if self._sync.is_plain():
                self._listen()

    def _sync_now(self, counter: int, now_ns: int) -> None:
        self._sync.open_window(now_ns)
        if self._sync.overflow:
            self._pdos.count(counter)
        self._pdos.sync(now_ns)

    def _send_sync(self, now_ns: int) -> None:
        """Send the own SYNC and process the own PDOs with it."""
        self._sync.expire(now_ns)
        if self.state == NmtState.OPERATIONAL:
            self._sync_now(self._sync.counter, now_ns)

    def _lose(self, node_id: int, now_ns: int) -> None:
        """Handle the loss of a node: EMCY, the reaction of 1029h, then the device."""
        self._error_control.tell_lost(node_id, now_ns)
        self._react(COMMUNICATION, now_ns)
        self._host.on_heartbeat_lost(node_id, now_ns)

    def _react(self, kind: int, now_ns: int) -> None:
        """Apply the reaction of 1029h."""
        self._enter(state_after(self.od, kind, self.state), now_ns)
