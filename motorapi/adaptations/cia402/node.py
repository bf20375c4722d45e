"""The received state of one drive: status, EMCY, heartbeat and SDO channel.

The TPDO decoder is the hot path: one call per frame, straight from the link's dispatch.
"""

import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID, OPERATIONAL, CanopenLink
from motorhil.motorapi.adaptations.canopen.emcy import Emergency, last_error, standing_error
from motorhil.motorapi.adaptations.canopen.sdo import SdoAborted
from motorhil.motorapi.adaptations.cia402.objects import (
    ENABLED_MASK,
    ENABLED_VALUE,
    FAULT_BIT,
    PdsState,
    Value,
    decode,
    decode_state,
    error_text,
    type_of,
)
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, LinkError, MotionInterrupted
from motorhil.motorapi.runtime.api import ChangeCounter

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.cia402.motion_status import MotionWatch
    from motorhil.motorapi.runtime.api import Registration

EMCY_ID: Final = 0x080
NMT_STATES: Final = {0x04: "STOPPED", 0x05: "OPERATIONAL", 0x7F: "PRE-OPERATIONAL"}
LOST_REMEDY: Final = "check its power and cable, and the load of the bus"
_EMCY: Final = struct.Struct("<8xHB5s")
_STATUS_POSITION: Final = struct.Struct("<8xHi").unpack_from
_STATUSWORD: Final = 0x6041
_POSITION: Final = 0x6064
_POLL_S: Final = 0.002
_EMERGENCIES_MAX: Final = 100


@final
class DriveNode:
    """The last state received from a drive, written by frame handlers.

    Attributes:
        statusword, position_inc, status_ns: the last status and its time (-1: none yet).
        values: other objects that TPDOs brought, by (index, sub-index).
        status_is_cyclic: whether a TPDO repeats the status.
        error: the last EMCY with an error, while the error register (1001h) is not 0. An error of a
            frame or of the bus yields to others.
        boots: the number of boot-ups received; the program that configured the drive compares it.
        lost_since_ns: the time since when the drive is silent, or None.
        malformed: the number of frames of a wrong length.
        news: a counter of changes that may end a motion.
    """

    def __init__(
        self,
        link: CanopenLink,
        node_id: int,
        *,
        sdo_timeout_s: float,
        quarantine_s: float,
        heartbeat_timeout_ms: int,
    ) -> None:
        from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel  # loads canopen

        self.link: Final = link
        self.node_id: Final = node_id
        self.label: Final = f"{link.name} node {node_id}"
        self.sdo: SdoChannel = SdoChannel(
            link, node_id, timeout_s=sdo_timeout_s, quarantine_s=quarantine_s
        )
        self.statusword = 0
        self.position_inc = 0
        self.status_ns = -1
        self._operational_ns = -1  # time of the last such report
        self.values: dict[tuple[int, int], int] = {}
        self.status_is_cyclic = False
        self.watch: MotionWatch | None = None
        self.news = ChangeCounter()
        self.fault_since_ns: int | None = None
        self.emergencies: deque[Emergency] = deque(maxlen=_EMERGENCIES_MAX)
        self.error: Emergency | None = None
        self.nmt_state: int | None = None
        self.boots = 0
        self.lost_since_ns: int | None = None
        self.malformed = 0
        self.uses_host_heartbeat = False
        self._watches_nmt = False
        self._was_operational = False
        self._boots_known = 0
        self._word = -1
        self._heartbeat_timeout_ms = heartbeat_timeout_ms
        self._heartbeat_ns = 0  # time of the last one
        self._silence: Registration | None = None
        self._heard_ids: list[int] = []
        self.on_control: Callable[[bytes, int], None] | None = None  # for controlwords of others
        link.on_bus_off.append(self.news.grow)
        link.handle(HEARTBEAT_ID + node_id, self._on_heartbeat)
        link.handle(EMCY_ID + node_id, self._on_emergency)

    # --- TPDOs ---------------------------------------------------------------------------

    def listen_to_tpdo(self, can_id: int, mapping: Sequence[int]) -> None:
        """Decode TPDO `can_id` by `mapping` (as in 1A00h: index, sub-index, bits)."""
        if tuple(mapping) == (_STATUSWORD << 16 | 16, _POSITION << 16 | 32):
            self.link.handle(can_id, self._on_status_position)
        else:
            self.link.handle(can_id, TpdoDecoder(self, mapping).decode)
        self._heard_ids.append(can_id)

    def listen_to_control(self, can_id: int) -> None:
        """Pass controlwords that others send in RPDO `can_id` to `on_control`."""
        if self.on_control is not None:
            self.link.handle(can_id, self.on_control)
            self._heard_ids.append(can_id)

    def _on_status_position(self, frame: bytes, time_ns: int) -> None:
        if frame[4] != 6:
            self.malformed += 1
            return
        word, position_inc = _STATUS_POSITION(frame)
        self.take_status(word, position_inc, time_ns)

    def take_status(self, word: int, position_inc: int, time_ns: int) -> None:
        """Store a received status, from TPDO or SDO."""
        self.position_inc = position_inc
        self.status_ns = time_ns
        if word != self._word:
            self._new_statusword(word, time_ns)
        if self.watch is not None:
            self.watch.see(word, position_inc, time_ns)  # the watch reports an end

    def _new_statusword(self, word: int, time_ns: int) -> None:
        self._word = self.statusword = word
        if word & FAULT_BIT:
            if self.fault_since_ns is None:
                self.fault_since_ns = time_ns
        else:
            self.fault_since_ns = None
        self.news.grow()

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
            self.boots += 1
            self.error = None
            self.sdo.rebooted()
        self.nmt_state = state
        if state == OPERATIONAL:
            self._operational_ns = time_ns
            self._was_operational = self._was_operational or self._watches_nmt
        self.lost_since_ns = None
        self._heartbeat_ns = self.link.runtime.now_ns()
        if is_news:
            self.news.grow()

    def expect_heartbeat(self) -> None:
        """Regard silence as the loss of the drive from now on."""
        if self._heartbeat_timeout_ms and self._silence is None:
            self._heartbeat_ns = self.link.runtime.now_ns()
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
        """Permit boot-ups and other NMT states during the bring-up."""
        self._watches_nmt = self._was_operational = False
        self._boots_known = self.boots
        self.news.grow()

    def stays_operational(self) -> None:
        """Regard any state but OPERATIONAL as a loss, from its first OPERATIONAL heartbeat on."""
        self._watches_nmt = True
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
        self.watch = None
        if self._silence is not None:
            self._silence.cancel()
            self._silence = None
        first = (HEARTBEAT_ID, EMCY_ID, 0x580, 0x600)
        for can_id in (*(base + self.node_id for base in first), *self._heard_ids):
            self.link.ignore(can_id)
        self.link.on_bus_off.remove(self.news.grow)
        self.link.fences.pop(self.node_id, None)

    # --- interpretation ------------------------------------------------------------------

    @property
    def state(self) -> PdsState | None:
        """The state in the last statusword, or None if it shows none."""
        return decode_state(self.statusword)

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
                remedy=f"check the bus first: {trouble}" if trouble else LOST_REMEDY,
            )

    def check_link(self) -> None:
        """Raise LinkError if the drive is silent, or has left its configured NMT state."""
        self.check_heard()
        if self.has_booted:
            raise LinkError(link=self.label, reason="it has booted and lost its configuration")
        if not self.is_up:
            state = self.nmt_state or 0
            name = NMT_STATES.get(state, "not in CiA 301")
            reason = f"its NMT state is {state:02X}h ({name}), not OPERATIONAL any more"
            cause = self.error or last_error(self.emergencies, self._operational_ns)
            if cause is not None:
                reason += f", after {cause}"
            raise LinkError(link=self.label, reason=reason, remedy="start() brings it up again")

    def check_motion(self, motor: str) -> None:
        """Raise the error that ends a motion from outside; see `Motor._is_done`."""
        self.check_link()
        word = self.statusword
        if word & FAULT_BIT:
            raise self.fault_error(motor)
        if word & ENABLED_MASK != ENABLED_VALUE:
            state = self.state
            by = "the drive" if state is None else f"the drive, now in state {state.value!r}"
            if self.error is not None:
                by += f", after {self.error}"
            raise MotionInterrupted(motor=motor, by=by, at_ns=self.status_ns)

    def fault_error(self, motor: str) -> DeviceFault:
        """Return the fault that the drive reports, as an error."""
        code = self.error_code
        since_ns = self.fault_since_ns if self.fault_since_ns is not None else self.status_ns
        return DeviceFault(motor=motor, code=code, text=error_text(code), since_ns=since_ns)

    # --- reading and waiting ---------------------------------------------------------------

    def read(self, index: int, subindex: int = 0) -> Value:
        """Return the value of an object of the standard, read by SDO."""
        return decode(type_of(index, subindex) or "u32", self.sdo.upload(index, subindex))

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

    def refresh(self) -> None:
        """Read statusword and position, unless a TPDO repeats them."""
        if not self.status_is_cyclic:
            self.poll_status()

    def poll_status(self) -> None:
        """Read statusword and position by SDO."""
        word = self.read_int(_STATUSWORD)
        position_inc = self.read_int(_POSITION)
        self.take_status(word, position_inc, self.link.runtime.now_ns())

    def wait_for_status(self, wanted: Callable[[int], bool], timeout_s: float, awaited: str) -> int:
        """Return the first statusword for which `wanted` is true, from TPDOs or by SDO polling.

        Raises:
            DeadlineExceeded: there was none within `timeout_s` [s].
            LinkError: the drive was lost meanwhile.
        """
        runtime = self.link.runtime
        deadline_ns = runtime.now_ns() + round(timeout_s * 1e9)

        def is_over() -> bool:
            return self.lost_since_ns is not None or wanted(self.statusword)

        while True:
            if not self.status_is_cyclic:
                self.poll_status()
            left_s = max(0, deadline_ns - runtime.now_ns()) / 1e9
            pause_s = left_s if self.status_is_cyclic else min(_POLL_S, left_s)
            over = self.link.wait_until(is_over, pause_s)
            self.check_link()
            if over:
                return self.statusword
            if runtime.now_ns() >= deadline_ns:
                raise DeadlineExceeded(
                    awaited=f"{self.label}: {awaited}",
                    timeout_s=timeout_s,
                    last_heard=self.describe_status(),
                )

    def describe_status(self) -> str:
        """Return the last status in words."""
        state = self.state
        name = "no state of CiA 402" if state is None else state.value
        text = f"statusword {self.statusword:04X}h ({name})"
        text += f", position {self.position_inc} increments"
        if self.error is not None:
            text += f", after {self.error}"
        trouble = self.link.status.trouble()
        return f"{text}; {trouble}" if trouble else text


@final
class TpdoDecoder:
    """A decoder of any TPDO mapping but statusword with position.

    The decoder passes status and position to the node, and other objects to `values`.
    """

    def __init__(self, node: DriveNode, mapping: Sequence[int]) -> None:
        self._node = node
        self._fields = tuple(
            ((entry >> 16, entry >> 8 & 0xFF), (entry & 0xFF) // 8) for entry in mapping
        )
        self._length = sum(size for _, size in self._fields)

    def decode(self, frame: bytes, time_ns: int) -> None:
        """Decode a frame of this TPDO."""
        node = self._node
        if frame[4] != self._length:
            node.malformed += 1
            return
        word, position_inc, at = node.statusword, node.position_inc, 8
        has_status = False
        for key, size in self._fields:
            kind = type_of(*key) or "u32"
            raw = int.from_bytes(frame[at : at + size], "little", signed=kind[0] == "i")
            at += size
            if key == (_STATUSWORD, 0):
                word, has_status = raw, True
            elif key == (_POSITION, 0):
                position_inc = raw
                node.position_inc = raw
            else:
                node.values[key] = raw
        if has_status:
            node.take_status(word, position_inc, time_ns)
