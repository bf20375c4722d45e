"""One remote CANopen node as a host knows it: NMT state, heartbeat, EMCY, objects.

`node_locks` returns the locks by which processes share a node.
"""

import struct
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID, OPERATIONAL, STOPPED, CanopenBus
from motorhil.motorapi.adaptations.canopen.emcy import Emergency, last_error, standing_error
from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.canopen.objects import ObjectTable, Value
from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel, decode_answer
from motorhil.motorapi.adaptations.canopen.settings import NodeOptions
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorBusyError, MotorError
from motorhil.motorapi.locking.directory import bus_name
from motorhil.motorapi.locking.process_lock import ProcessLock, can_share_time
from motorhil.motorapi.runtime.api import ChangeCounter

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.runtime.api import Registration, Runtime

_EMCY_ID: Final = 0x080
_NMT_STATES: Final = {0x04: "STOPPED", 0x05: "OPERATIONAL", 0x7F: "PRE-OPERATIONAL"}
_PRE_OPERATIONAL: Final = 0x80
_LOST_REMEDY: Final = "check its power and cable, and the load of the bus"
_EMCY: Final = struct.Struct("<8xHB5s")
_EMERGENCIES_MAX: Final = 100
_ASK_AGAIN_NS: Final = 1_000_000_000


class CanopenNode:
    """The last state received from a node, written by frame handlers.

    Attributes:
        bus: its CANopen bus; `link`: the frames of that bus.
        objects: the objects known to its standards.
        emergencies: the EMCY messages received, oldest first (the last 100).
        error: the last EMCY with an error, while the error register (1001h) is not 0. An error of a
            frame or of the bus yields to others.
        boots: the number of boot-ups received; the program that configured the node compares it.
        lost_since_ns: the time since when the node is silent, or None.
        malformed: the number of frames of a wrong length.
        news: a counter of changes that may end a motion.
        on_loss: called with the error of a loss, and the time [ns], before a set-up forgets it.
    """

    def __init__(
        self, bus: CanopenBus, node_id: int, options: NodeOptions, objects: ObjectTable
    ) -> None:
        link = bus.link
        self.bus: Final = bus
        self.link: Final = link
        self.node_id: Final = node_id
        self.label: Final = f"{link.name} node {node_id}"
        self.objects: Final = objects
        self.sdo: Final = SdoChannel(
            link, node_id, timeout_s=options.sdo_timeout_s, quarantine_s=options.sdo_quarantine_s
        )
        self.news: Final = ChangeCounter()
        self.on_loss: Final[list[Callable[[MotorError, int], None]]] = []
        self.emergencies: Final[deque[Emergency]] = deque(maxlen=_EMERGENCIES_MAX)
        self.error: Emergency | None = None
        self.nmt_state: int | None = None
        self.boots: int = 0
        self.lost_since_ns: int | None = None
        self.malformed: int = 0
        self._options: Final = options
        self._operational_ns = -1  # time of the last such report
        self._keeps_host_heartbeat = False
        self._watches_nmt = False
        self._ask_again_ns = 0
        self._was_operational = False
        self._has_shown_state = False  # by a heartbeat since it was started, which may be older
        self._boots_known = 0
        self._heartbeat_ns = 0  # time of the last one
        self._silence: Registration | None = None
        self._heard_ids: list[int] = []
        link.on_bus_off.append(self.news.grow)
        link.handle(HEARTBEAT_ID + node_id, self._on_heartbeat)
        link.handle(_EMCY_ID + node_id, self._on_emergency)

    @property
    def _heartbeat_timeout_ms(self) -> int:
        return self._options.heartbeat_timeout_ms

    def keep_host_heartbeat(self) -> None:
        """Produce the host's heartbeat, which the node supervises, until `close`."""
        options = self._options
        if options.heartbeat_ms and not self._keeps_host_heartbeat:
            self.bus.produce_heartbeat(options.host_node_id, options.heartbeat_ms)
            self._keeps_host_heartbeat = True

    # --- EMCY and heartbeat --------------------------------------------------------------

    def _on_emergency(self, frame: bytes, time_ns: int) -> None:
        if frame[4] != 8:
            self.malformed += 1
            return
        code, register, vendor = _EMCY.unpack(frame)
        emergency = Emergency(code, register, vendor, time_ns)
        self.emergencies.append(emergency)
        self.error = standing_error(self.error, emergency)

    def _on_heartbeat(self, frame: bytes, time_ns: int) -> None:
        if frame[4] != 1:
            self.malformed += 1
            return
        state = frame[8] & 0x7F
        is_news = not state or state != self.nmt_state or self.lost_since_ns is not None
        if state == 0:
            self._note_boot_up()
        self.nmt_state = state
        if state == OPERATIONAL:
            self._operational_ns = time_ns
        if self._watches_nmt:
            self._was_operational |= state == OPERATIONAL or self._has_shown_state
            self._has_shown_state = True
        self.lost_since_ns = None
        self._heartbeat_ns = self.link.runtime.now_ns()
        if is_news:
            self.news.grow()

    def _note_boot_up(self) -> None:
        self.boots += 1
        self.error = None
        self.sdo.rebooted()

    def look_for_restart(self) -> None:
        """Ask a silent node whether it has restarted, unless it was asked a short time ago.

        Its boot-up message was lost then, and it produces no heartbeat before it is set up again.
        But it answers, and has forgotten the period of its heartbeat.
        """
        if self.lost_since_ns is None:
            return
        now_ns = self.link.runtime.now_ns()
        if now_ns < self._ask_again_ns:
            return
        self._ask_again_ns = now_ns + _ASK_AGAIN_NS
        with suppress(MotorError):
            if self.read_optional(0x1017) not in (None, self._options.heartbeat_ms):
                self._note_boot_up()
                self.news.grow()

    def expect_heartbeat(self) -> None:
        """Regard silence as the loss of the drive from now on; it has just answered."""
        if not self._heartbeat_timeout_ms:
            return
        self._heartbeat_ns = self.link.runtime.now_ns()
        self.lost_since_ns = None
        if self._silence is None:
            self._look_again_in(self._heartbeat_timeout_ms * 1_000_000)

    def _look_again_in(self, wait_ns: int) -> None:
        self._silence = self.link.runtime.every(wait_ns / 1e9, self._look_for_heartbeat)

    def _look_for_heartbeat(self) -> None:
        """Report the drive as lost if no heartbeat came since this check was scheduled."""
        if self._silence is None:
            return
        self._silence.cancel()
        now_ns = self.link.runtime.now_ns()
        timeout_ns = self._heartbeat_timeout_ms * 1_000_000
        left_ns = self._heartbeat_ns + timeout_ns - now_ns
        self._look_again_in(left_ns if left_ns > 0 else timeout_ns)
        if left_ns <= 0 and self.lost_since_ns is None:
            self.lost_since_ns = now_ns
            self.news.grow()

    def may_change_state(self) -> None:
        """Permit boot-ups and other NMT states during the bring-up; report a loss before it."""
        try:
            self.check_link()
        except LinkError as error:
            for report in self.on_loss:
                report(error, self.link.runtime.now_ns())
        self._watches_nmt = self._was_operational = False
        self._boots_known = self.boots
        self.news.grow()

    def stays_operational(self) -> None:
        """Regard any state but OPERATIONAL as a loss, from its second heartbeat on.

        The first one may be older than the command, unless it shows OPERATIONAL.
        """
        self._watches_nmt = True
        self._has_shown_state = False
        self._boots_known = self.boots
        self.news.grow()

    @property
    def is_lost(self) -> bool:
        """True if the drive is silent, or the bus is off."""
        return self.lost_since_ns is not None or self.link.status.is_off

    @property
    def has_booted(self) -> bool:
        """True if the drive has booted since its bring-up, and so lost its configuration."""
        return self._watches_nmt and self.boots != self._boots_known

    @property
    def is_up(self) -> bool:
        """True if the drive is still configured and OPERATIONAL."""
        left = self._was_operational and self.nmt_state != OPERATIONAL
        return not left and not self.has_booted

    def close(self) -> None:
        """Stop listening to the drive."""
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        first = (HEARTBEAT_ID, _EMCY_ID, 0x580, 0x600)
        for can_id in (*(base + self.node_id for base in first), *self._heard_ids):
            self.link.ignore(can_id)
        self.link.on_bus_off.remove(self.news.grow)
        self.bus.fences.pop(self.node_id, None)
        if self._keeps_host_heartbeat:
            self._keeps_host_heartbeat = False
            self.bus.release_heartbeat(self._options.host_node_id)

    @property
    def error_code(self) -> int:
        """The code of `error`, or 0 if there is none."""
        return 0 if self.error is None else self.error.code

    def check_heard(self) -> None:
        """Raise LinkError if the drive is silent, or the bus is off."""
        status = self.link.status
        status.check()
        if self.lost_since_ns is not None:
            trouble = status.trouble()
            raise LinkError(
                link=self.label,
                reason=f"no heartbeat for {self._heartbeat_timeout_ms} ms",
                since_ns=self.lost_since_ns,
                remedy=f"check the bus first: {trouble}" if trouble else _LOST_REMEDY,
            )

    def check_link(self) -> None:
        """Raise LinkError if the drive is silent, or has left its configured NMT state."""
        self.check_heard()
        if self.has_booted:
            raise LinkError(link=self.label, reason="it has booted and lost its configuration")
        if not self.is_up:
            state = self.nmt_state or 0
            name = _NMT_STATES.get(state, "not in CiA 301")
            reason = f"its NMT state is {state:02X}h ({name}), not OPERATIONAL any more"
            cause = self.error or last_error(self.emergencies, self._operational_ns)
            if cause is not None:
                reason += f", after {cause}"
            raise LinkError(link=self.label, reason=reason, remedy="start() brings it up again")

    # --- bring-up --------------------------------------------------------------------------

    def first_answer(self) -> int | None:
        """Return 1000h, once the device answers; a booting device answers after its boot-up.

        None: it refuses to send it, which is an answer as well.

        Raises:
            DeadlineExceeded: it does not answer in time.
        """
        runtime, timeout_s = self.link.runtime, self._options.connect_timeout_s
        deadline_ns = runtime.now_ns() + round(timeout_s * 1e9)
        while True:
            if self.nmt_state == STOPPED:  # a stopped node answers no SDO (CiA 301, NMT states)
                self.bus.nmt(_PRE_OPERATIONAL, self.node_id)
            try:
                return self.read_int(0x1000)
            except SdoAborted:
                return None
            except DeadlineExceeded as error:
                if runtime.now_ns() >= deadline_ns:
                    heard = "a boot-up" if self.boots else "nothing"
                    trouble = self.link.status.trouble()
                    raise DeadlineExceeded(
                        awaited=f"{self.label}: any answer",
                        timeout_s=timeout_s,
                        last_heard=f"{heard}; {trouble}" if trouble else heard,
                    ) from error

    def write_if_different(
        self,
        place: tuple[int, int],
        value: int,
        size: int,
        limitations: list[str],
        meaning: str,
    ) -> None:
        """Write `value` in `size` bytes unless the object holds it.

        A refusal is added to `limitations`: "it does not let us set `meaning`". An object that the
        drive lacks is of no use to write: another owner of the drive does not hinder that.
        """
        index, subindex = place
        found = self.read_optional(index, subindex)
        if found == value:
            return
        data = (value & (1 << 8 * size) - 1).to_bytes(size, "little")
        try:
            self.sdo.download(index, subindex, data)
        except SdoAborted as error:
            limitations.append(f"it does not let us set {meaning} ({error})")
        except MotorBusyError:
            if found is not None:
                raise
            limitations.append(f"it does not let us set {meaning} (it lacks the object)")

    # --- objects ---------------------------------------------------------------------------

    def read(self, index: int, subindex: int = 0) -> Value:
        """Return the value of an object, read by SDO; one unknown to the standard is unsigned.

        Raises:
            ProtocolViolation: the answer is shorter than the object's data type.
        """
        data = self.sdo.upload(index, subindex)
        kind = self.objects.type_of(index, subindex)
        if kind is None:
            return int.from_bytes(data[:4], "little")
        return decode_answer(self.node_id, (index, subindex), kind, data)

    def read_int(self, index: int, subindex: int = 0) -> int:
        """Return the integer in an object, read by SDO."""
        value = self.read(index, subindex)
        return value if isinstance(value, int) else 0

    def read_optional(self, index: int, subindex: int = 0) -> int | None:
        """Return the integer in an object, or None if the drive refuses to send it."""
        try:
            return self.read_int(index, subindex)
        except SdoAborted:
            return None


def node_locks(
    bus: "can.BusABC", runtime: "Runtime", node_id: int, label: str
) -> "tuple[ProcessLock, ProcessLock] | tuple[None, None]":
    """Return the locks of the node and of its SDO channel; None if the bus is not shared."""
    where = bus_name(bus) if can_share_time(runtime) else None
    if where is None:
        return None, None
    name = f"{where}-node{node_id}"
    return (
        ProcessLock(name, label, runtime=runtime),
        ProcessLock(f"{name}-sdo", f"the SDO channel of {label}", runtime=runtime),
    )
