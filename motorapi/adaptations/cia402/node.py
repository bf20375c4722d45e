"""Received state of one drive: its status, beside that of a CANopen node.

The TPDO decoder is the hot path: one call per frame, straight from the link's dispatch.

*Counter wraps.* The drive counts its position in 32 bits, and a wheel rolls beyond them. The host
counts on: two positions in a row are always less than half of the 32 bits apart. So `position_inc`
never wraps, and targets are converted to the drive's counter at the edge to the wire.

*Missing TPDOs.* A drive may be alive by its heartbeat while its status TPDO does not arrive: one
identifier is filtered, or sent by a second node. A status that is too old is read by SDO instead.
"""

import struct
from collections.abc import Callable, Sequence
from typing import Final, final

from motorhil.motorapi.adaptations.canopen.bus import CanopenBus
from motorhil.motorapi.adaptations.canopen.emcy import error_text
from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.canopen.settings import NodeOptions
from motorhil.motorapi.adaptations.cia402.motion_status import SETTLE_NS, STILL_INC, MotionWatch
from motorhil.motorapi.adaptations.cia402.objects import (
    ENABLED_MASK,
    ENABLED_VALUE,
    FAULT_BIT,
    OBJECTS,
    PdsState,
    decode_state,
    is_off,
)
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, MotionInterrupted

_STATUS_POSITION: Final = struct.Struct("<8xHi").unpack_from
_STATUSWORD: Final = 0x6041
_POSITION: Final = 0x6064
_HALF: Final = 0x8000_0000
_SPAN: Final = 0x1_0000_0000  # positions of a counter of 32 bits
_NEAR_WRAP: Final = 0x10_0000  # where a following error may straddle the end of the counter
_POLL_S: Final = 0.002
_YOUNG_PERIODS: Final = 5
_YOUNG_MS: Final = 100  # at least, as a busy bus or host delays TPDOs


@final
class DriveNode(CanopenNode):
    """The last state received from a drive, written by frame handlers.

    Attributes:
        statusword, position_inc, status_ns: the last status and its time (-1: none yet).
            The position does not wrap with the drive's counter.
        counter: the last 6064h.
        told_ns: the time of the last TPDO with status and position.
        values: other objects that TPDOs brought, by (index, sub-index).
        status_is_cyclic: whether a TPDO repeats the status, with the position.
        watch: the observer of the last command, or None.
        on_control: called with (controlword, time_ns) of other programs, or None.
    """

    def __init__(self, bus: CanopenBus, node_id: int, options: NodeOptions) -> None:
        super().__init__(bus, node_id, options, OBJECTS)
        self.statusword: int = 0
        self.position_inc: int = 0
        self.counter: int = 0
        self._wrapped_inc = 0  # a multiple of the counter's span: what its wraps have lost
        self.status_ns: int = -1
        self.values: Final[dict[tuple[int, int], int]] = {}
        self.status_is_cyclic: bool = False
        self._stood_inc = 0  # the position at its last change,
        self._stood_ns = 0  # and the time
        self.told_ns: int = -1
        self._young_ns = 0
        self._present_ns = 0
        self.watch: MotionWatch | None = None
        self.fault_since_ns: int | None = None
        self.on_control: Callable[[int, int], None] | None = None
        self._word = -1

    def close(self) -> None:
        """Stop listening to the drive."""
        self.watch = None
        super().close()

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
        self.link.handle(can_id, self._on_control)
        self._heard_ids.append(can_id)

    def _on_control(self, frame: bytes, time_ns: int) -> None:
        if frame[4] >= 2 and self.on_control is not None:
            self.on_control(int.from_bytes(frame[8:10], "little"), time_ns)

    def _on_status_position(self, frame: bytes, time_ns: int) -> None:
        if frame[4] != 6:
            self.malformed: int = self.malformed + 1
            return
        word, counter = _STATUS_POSITION(frame)
        self.told_ns = time_ns
        self.take_status(word, counter, time_ns)

    def take_status(self, word: int, counter: int, time_ns: int) -> None:
        """Store a received status, from TPDO or SDO; `counter` is 6064h."""
        step = counter - self.counter
        if not -_HALF <= step < _HALF:
            self._wrap(step)
        self.counter = counter
        self.position_inc = position_inc = counter + self._wrapped_inc
        self.status_ns = time_ns
        if not -STILL_INC <= position_inc - self._stood_inc <= STILL_INC:
            self._stood_inc = position_inc
            self._stood_ns = time_ns
        if word != self._word:
            self._new_statusword(word, time_ns)
        if self.watch is not None:
            self.watch.see(word, position_inc, time_ns)  # the watch reports an end

    def take_statusword(self, word: int, time_ns: int) -> None:
        """Store a statusword that came without a position; a motion is judged by both."""
        if word != self._word:
            self._new_statusword(word, time_ns)

    def _new_statusword(self, word: int, time_ns: int) -> None:
        self._word = self.statusword = word
        if word & FAULT_BIT:
            if self.fault_since_ns is None:
                self.fault_since_ns = time_ns
        else:
            self.fault_since_ns = None
        self.news.grow()

    # --- position counter ---------------------------------------------------------------------

    def count_anew(self) -> None:
        """Take the drive's counter as the position: it was homed, or has booted."""
        self._wrapped_inc = 0
        self.position_inc = self.counter

    def _wrap(self, step: int) -> None:
        """Count a wrap of the drive's counter, which has changed by `step`."""
        if self.status_ns >= 0:
            self._wrapped_inc += _SPAN if step < 0 else -_SPAN

    def on_from(self, counter: int) -> int:
        """Return a value of the drive's counter (6062h, 6064h) as a position, which never wraps."""
        return self.position_inc + (counter - self.counter + _HALF) % _SPAN - _HALF

    def is_within_counter(self, target_inc: int) -> bool:
        """Return whether the drive understands the position as an absolute target.

        After a wrap, drives differ: some take 607Ah for a position of the present turn of their
        counter, others for one of the first.
        """
        near = -_HALF + _NEAR_WRAP <= self.position_inc < _HALF - _NEAR_WRAP
        return near and not self._wrapped_inc and -_HALF < target_inc < _HALF

    # --- interpretation ------------------------------------------------------------------

    @property
    def state(self) -> PdsState | None:
        """The state in the last statusword, or None if it shows none."""
        return decode_state(self.statusword)

    @property
    def stands_without_power(self) -> bool:
        """True if the power stage is off, and the motor has not moved lately."""
        stood_ns = self.status_ns - self._stood_ns
        return is_off(self.statusword) and self.is_told and stood_ns >= SETTLE_NS

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

    # --- waiting ---------------------------------------------------------------------------

    def expect_status(self, period_ms: int) -> None:
        """Take the status from a TPDO of this period; 0: it is read by SDO."""
        self.status_is_cyclic = period_ms > 0
        young_ms = max(_YOUNG_MS, _YOUNG_PERIODS * period_ms)
        # a silent drive is reported as lost by its heartbeat, before its status is missed
        present_ms = max(young_ms, self._heartbeat_timeout_ms + 2 * period_ms)
        self._young_ns, self._present_ns = young_ms * 1_000_000, present_ms * 1_000_000

    @property
    def is_told(self) -> bool:
        """True if a TPDO repeats the status, and the last one is young."""
        return self.status_is_cyclic and self._silent_ns <= self._young_ns

    @property
    def is_missed(self) -> bool:
        """True if the TPDO that repeats the status has stayed away."""
        return self.status_is_cyclic and self._silent_ns > self._present_ns

    @property
    def is_old(self) -> bool:
        """True if the TPDO has stayed away, and the status was not read by SDO either."""
        age_ns = self.link.runtime.now_ns() - self.status_ns
        return self.status_is_cyclic and age_ns > self._present_ns

    @property
    def _silent_ns(self) -> int:
        return self.link.runtime.now_ns() - self.told_ns

    @property
    def patience_s(self) -> float:
        """The time for which a wait relies on TPDOs, from the last one on [s]."""
        return max(0, self._present_ns - self._silent_ns + 1) / 1e9

    def refresh(self) -> None:
        """Read statusword and position, unless a TPDO has brought them lately."""
        if not self.is_told:
            self.poll_status()

    def poll_status(self) -> None:
        """Read statusword and position by SDO."""
        word = self.read_int(_STATUSWORD)
        counter = self.read_int(_POSITION)
        self.take_status(word, counter, self.link.runtime.now_ns())

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
            is_told = self.is_told
            if not is_told:
                self.poll_status()
            left_s = max(0, deadline_ns - runtime.now_ns()) / 1e9
            pause_s = min(self._young_ns / 1e9 if is_told else _POLL_S, left_s)
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
        self._has_position = any(key == (_POSITION, 0) for key, _ in self._fields)

    def decode(self, frame: bytes, time_ns: int) -> None:
        """Decode a frame of this TPDO."""
        node = self._node
        if frame[4] != self._length:
            node.malformed += 1
            return
        word, counter, at = node.statusword, node.counter, 8
        has_status = False
        for key, size in self._fields:
            kind = node.objects.type_of(*key) or "u32"
            raw = int.from_bytes(frame[at : at + size], "little", signed=kind[0] == "i")
            at += size
            if key == (_STATUSWORD, 0):
                word, has_status = raw, True
            elif key == (_POSITION, 0):
                counter = raw
            else:
                node.values[key] = raw
        if has_status and self._has_position:
            node.told_ns = time_ns
            node.take_status(word, counter, time_ns)
        elif has_status:
            node.take_statusword(word, time_ns)
