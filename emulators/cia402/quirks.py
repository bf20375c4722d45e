"""Quirks: deviations of real drives from the standards, as wrappers.

Deviating profile position modes are wrappers around `ProfilePosition`. Each passes everything on
except its own deviation, so wrappers can be nested. A drive without quirks has none of them. The
catalogue in `settings` lists their sources.

Deviations on the wire are a wrapper around the drive. Outgoing frames are delayed or altered, and
incoming frames ignored, by their function codes, whatever the node-ID from LSS. The drive does not
know about it. A drive without such quirks needs no wrapper.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Final, final

from motorhil.emulators.can.frame import pack
from motorhil.emulators.canopen.codes import OK
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.modes.profile_position import CHANGE_IMMEDIATELY, NEW_SET_POINT
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.power_drive import PowerDrive
from motorhil.emulators.cia402.settings import EMULATED_MODES, Quirks, parameter, parameter_ns
from motorhil.emulators.cia402.state_machine import CW_HALT, SET_POINT_ACKNOWLEDGE, TARGET_REACHED
from motorhil.emulators.controller import Controller
from motorhil.emulators.firmware.digital_inputs import Edge

_EMCY: Final = 0x080
_SDO_RESPONSE: Final = 0x580
_SDO_REQUEST: Final = 0x600
_ERROR_CONTROL: Final = 0x700
_SYNC: Final = (0x080).to_bytes(4, "little")
_EXPEDITED: Final = 0x43  # upload response with its size, bits 2 and 3 apart
_SIZE_UNKNOWN: Final = 0x42
_DOWNLOADED: Final = 0x60
_OVERRUN: Final = bytes.fromhex("1081111400000000")  # CAN overrun, generic and communication error
_STRAY_EMCY: Final = (0x081).to_bytes(4, "little")


class Around(Mode):
    """Passes everything on to the inner mode."""

    def __init__(self, inner: Mode) -> None:
        super().__init__(inner.axis, inner.objects, inner.tick_ns)
        self.inner = inner

    def enter(self, word: int, now_ns: int) -> None:
        """Enter the inner mode."""
        self.inner.enter(word, now_ns)
        self._copy()

    def leave(self) -> None:
        """Leave the inner mode."""
        self.inner.leave()
        self._copy()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Pass the controlword on."""
        self.inner.obey(word, rising, now_ns)
        self._copy()

    def written(self, what: int, now_ns: int) -> None:
        """Pass written objects on."""
        self.inner.written(what, now_ns)
        self._copy()

    def sees(self, edges: list[Edge]) -> None:
        """Pass edges on."""
        self.inner.sees(edges)
        self._copy()

    def synced(self, now_ns: int) -> bool:
        """Pass SYNC on."""
        is_news = self.inner.synced(now_ns)
        self._copy()
        return is_news

    def settle(self, now_ns: int) -> None:
        """Let the inner mode settle."""
        self.inner.settle(now_ns)
        self._copy()

    def wake_ns(self) -> int:
        """Return the inner mode's deadline [ns]."""
        return self.inner.wake_ns()

    def status_bits(self) -> int:
        """Return the inner mode's bits."""
        return self.inner.status_bits()

    def idle_bits(self) -> int:
        """Return the inner mode's bits."""
        return self.inner.idle_bits()

    def _copy(self) -> None:
        self.halted: bool = self.inner.halted
        self.limited: bool = self.inner.limited
        self.lost: bool = self.inner.lost


@final
class InvertedAcknowledge(Around):
    """Inverts set-point acknowledge: 1 while there is nothing to acknowledge."""

    def status_bits(self) -> int:
        """Return the bits with bit 12 inverted."""
        return self.inner.status_bits() ^ SET_POINT_ACKNOWLEDGE


@final
class SingleSetPoint(Around):
    """A set-point without *change immediately* (bit 5) is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Ignore an offer without bit 5."""
        if not word & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class EdgeOnlyBits(Around):
    """*Change immediately* is edge-triggered too: an offer with the bit left set is not taken."""

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Ignore an offer if bit 5 is set but has not risen with it."""
        if word & CHANGE_IMMEDIATELY and not rising & CHANGE_IMMEDIATELY:
            rising &= ~NEW_SET_POINT
        super().obey(word, rising, now_ns)


@final
class StaleTargetReached(Around):
    """*Target reached* of the previous motion stays set for a while after a set-point was taken."""

    def __init__(self, inner: Mode, for_ns: int) -> None:
        super().__init__(inner)
        self._for_ns = for_ns
        self._until_ns: int = NEVER  # end of the stale bit; NEVER: it is not stale

    def enter(self, word: int, now_ns: int) -> None:
        """Clear the stale bit."""
        self._until_ns = NEVER
        super().enter(word, now_ns)

    def leave(self) -> None:
        """Clear the stale bit."""
        self._until_ns = NEVER
        super().leave()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Keep the bit if the target was reached when the set-point was offered."""
        was_reached = self.inner.status_bits() & TARGET_REACHED != 0
        super().obey(word, rising, now_ns)
        if rising & NEW_SET_POINT and was_reached:
            self._until_ns = now_ns + self._for_ns

    def settle(self, now_ns: int) -> None:
        """Clear the stale bit after its time."""
        if now_ns >= self._until_ns:
            self._until_ns = NEVER
        super().settle(now_ns)

    def wake_ns(self) -> int:
        """Return the inner mode's deadline or the end of the stale bit [ns]."""
        wake_ns = self.inner.wake_ns()
        return wake_ns if wake_ns < self._until_ns else self._until_ns

    def status_bits(self) -> int:
        """Return the bits with bit 10, stale or not."""
        bits = self.inner.status_bits()
        return bits if self._until_ns == NEVER else bits | TARGET_REACHED


@final
class WireQuirks:
    """The deviations on the wire; 0 and False: none. Times [ns].

    Attributes:
        sdo_mean_ns, sdo_spread_ns: delay of SDO responses: mean -+ spread.
        heartbeat_ns: maximum delay of a heartbeat.
        deaf_ns: time after the boot-up message during which SDO requests are ignored.
        has_stray_emcy: EMCY is sent on 081h, whatever the node-ID.
        has_misplaced_register: 1001h is one byte too far right in EMCY.
        hides_size: expedited uploads do not indicate their size.
        has_stale_bytes: unused bytes of SDO responses are those of the response before.
        has_emcy_after_boot_up: EMCY 0000h follows the boot-up message.
        vendor_bytes: the manufacturer-specific bytes of EMCY; b"": as the drive sends them.
        buffer_frames, buffer_ns: frames that can be received in this time; 0 ns: any number.
    """

    def __init__(self) -> None:
        self.sdo_mean_ns: int = 0
        self.sdo_spread_ns: int = 0
        self.heartbeat_ns: int = 0
        self.deaf_ns: int = 0
        self.has_stray_emcy: bool = False
        self.has_misplaced_register: bool = False
        self.hides_size: bool = False
        self.has_stale_bytes: bool = False
        self.has_emcy_after_boot_up: bool = False
        self.vendor_bytes: bytes = b""
        self.buffer_frames: int = 0
        self.buffer_ns: int = 0

    def are_any(self) -> bool:
        """Return True if anything deviates."""
        times_ns = self.sdo_mean_ns + self.sdo_spread_ns + self.heartbeat_ns + self.deaf_ns
        alters_sdo = self.hides_size or self.has_stale_bytes
        alters_emcy = self.has_stray_emcy or self.has_misplaced_register or bool(self.vendor_bytes)
        adds_emcy = self.has_emcy_after_boot_up or self.buffer_ns > 0
        return times_ns > 0 or alters_sdo or alters_emcy or adds_emcy


@final
class Draws:
    """A named stream of pseudo-random numbers, reproducible by its seed."""

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._count = 0

    def draw_ns(self, low_ns: int, high_ns: int) -> int:
        """Return the next number, evenly distributed from `low_ns` to `high_ns` [ns]."""
        self._count += 1
        digest = hashlib.sha256(f"{self._stream}:{self._count}".encode()).digest()
        return low_ns + int.from_bytes(digest[:8], "big") % (high_ns - low_ns + 1)


@final
class QuirkyWire:
    """Wraps a drive and implements `Controller` itself.

    Attributes:
        inner: the drive.
    """

    def __init__(self, inner: Controller, quirks: WireQuirks, stream: str) -> None:
        self.inner: Controller = inner
        self._quirks = quirks
        self._responses = Draws(f"{stream}:quirk:slow_sdo")
        self._heartbeats = Draws(f"{stream}:quirk:heartbeat_jitter")
        self._now_ns: int = 0
        self._deaf_until_ns: int = -1
        self._held: list[tuple[int, bytes]] = []  # each with the time when it is sent
        self._response_due_ns: int = 0  # of the last response: responses keep their order
        self._ready: list[bytes] = []
        self._left_over: bytes = bytes(4)  # the data bytes of the last SDO response
        self._arrivals: list[int] = []  # of the frames in the receive buffer [ns]
        self._has_overrun: bool = False
        self._emcy_id: int = 0  # 80h plus the node-ID; 0: no boot-up message yet

    def start(self, now_ns: int) -> None:
        """Power the drive on."""
        self._now_ns = now_ns
        self.inner.start(now_ns)

    def receive(self, data: bytes, now_ns: int) -> None:
        """Pass a received frame on, unless it is ignored."""
        self._now_ns = now_ns
        if now_ns < self._deaf_until_ns and _function(data) == _SDO_REQUEST:
            return
        if self._quirks.buffer_ns and self._is_lost(now_ns):
            return
        self.inner.receive(data, now_ns)

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Report that an own frame has left the bus."""
        self._now_ns = now_ns
        return self.inner.sent(data, now_ns)

    def wants_sent(self) -> bool:
        """Return the drive's answer."""
        return self.inner.wants_sent()

    def next_deadline_ns(self) -> int | None:
        """Return the drive's deadline, or when the first delayed frame is sent."""
        first_ns = NEVER
        for due_ns, _ in self._held:
            if due_ns < first_ns:
                first_ns = due_ns
        inner_ns = self.inner.next_deadline_ns()
        if inner_ns is not None and inner_ns < first_ns:
            return inner_ns
        return None if first_ns == NEVER else first_ns

    def expire(self, now_ns: int) -> None:
        """Release the frames that are due, and let the drive handle its deadlines."""
        self._now_ns = now_ns
        self._ready.extend(frame for due_ns, frame in self._held if due_ns <= now_ns)
        self._held = [one for one in self._held if one[0] > now_ns]
        inner_ns = self.inner.next_deadline_ns()
        if inner_ns is not None and inner_ns <= now_ns:
            self.inner.expire(now_ns)

    def take_output(self) -> Sequence[bytes]:
        """Return the drive's frames, delayed and altered."""
        frames = self._ready
        self._ready = []
        for frame in self.inner.take_output():
            function = _function(frame)
            if function == _SDO_RESPONSE:
                self._hold_response(self._altered_response(frame), frames)
            elif function == _ERROR_CONTROL:
                self._hold_heartbeat(frame, frames)
            elif function == _EMCY and frame[:4] != _SYNC:
                frames.append(self._altered(frame))
            else:
                frames.append(frame)
        return frames

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return the drive's events."""
        return self.inner.take_events()

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set a physical input of the drive; ValueError as from the drive."""
        self._now_ns = now_ns
        self.inner.stimulate(name, value, now_ns)

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true internal state."""
        return self.inner.snapshot(now_ns)

    def identifiers(self) -> Sequence[int] | None:
        """Return the drive's identifiers."""
        return self.inner.identifiers()

    def identifiers_revision(self) -> int:
        """Return the drive's revision of its identifiers."""
        return self.inner.identifiers_revision()

    # --- internals

    def _hold_response(self, frame: bytes, frames: list[bytes]) -> None:
        quirks = self._quirks
        if quirks.sdo_mean_ns + quirks.sdo_spread_ns == 0:
            frames.append(frame)
            return
        low_ns = max(0, quirks.sdo_mean_ns - quirks.sdo_spread_ns)
        delay_ns = self._responses.draw_ns(low_ns, quirks.sdo_mean_ns + quirks.sdo_spread_ns)
        self._response_due_ns = max(self._response_due_ns, self._now_ns + delay_ns)
        self._held.append((self._response_due_ns, frame))

    def _hold_heartbeat(self, frame: bytes, frames: list[bytes]) -> None:
        """Delay a heartbeat; a boot-up message is sent at once and starts the deaf time."""
        if frame[8] == 0:
            self._deaf_until_ns = self._now_ns + self._quirks.deaf_ns
            self._emcy_id = _EMCY | frame[0] & 0x7F
            self._has_overrun = False
            if self._quirks.has_emcy_after_boot_up:
                frames += (frame, pack(self._emcy_id, bytes(8)))
                return
        elif self._quirks.heartbeat_ns:
            delay_ns = self._heartbeats.draw_ns(0, self._quirks.heartbeat_ns)
            self._held.append((self._now_ns + delay_ns, frame))
            return
        frames.append(frame)

    def _is_lost(self, now_ns: int) -> bool:
        """Return whether the receive buffer has no room; the first loss is reported."""
        quirks = self._quirks
        self._arrivals = [at_ns for at_ns in self._arrivals if at_ns > now_ns - quirks.buffer_ns]
        if len(self._arrivals) < quirks.buffer_frames:
            self._arrivals.append(now_ns)
            return False
        if not self._has_overrun and self._emcy_id:
            self._has_overrun = True
            self._ready.append(pack(self._emcy_id, _OVERRUN))
        return True

    def _altered_response(self, frame: bytes) -> bytes:
        """Return an SDO response with the quirks of its first byte and of its unused bytes."""
        command, data = frame[8], frame[12:16]
        if self._quirks.has_stale_bytes:
            used = 4
            if command & 0xE3 == _EXPEDITED:
                used = 4 - (command >> 2 & 3)
            elif command == _DOWNLOADED:
                used = 0
            data = data[:used] + self._left_over[used:]
            self._left_over = data
        if self._quirks.hides_size and command & 0xE3 == _EXPEDITED:
            command = _SIZE_UNKNOWN
        return frame[:8] + bytes((command,)) + frame[9:12] + data

    def _altered(self, frame: bytes) -> bytes:
        vendor = self._quirks.vendor_bytes
        if vendor and frame[8:10] != bytes(2):
            frame = frame[:11] + vendor
        if self._quirks.has_stray_emcy:
            frame = _STRAY_EMCY + frame[4:]
        if self._quirks.has_misplaced_register:
            frame = frame[:10] + b"\0" + frame[10:15]
        return frame


def _function(frame: bytes) -> int:
    return int.from_bytes(frame[:4], "little") & ~0x7F


@final
class HaltHoldsMode:
    """A writer of 6060h that ignores writes under halt."""

    def __init__(self, od: ObjectDictionary, objects: DriveObjects) -> None:
        variable = od.ensure(0x6060, 0, DataType.INTEGER8, 0)
        self._objects = objects
        self._inner = variable.writer
        variable.writer = self.write

    def write(self, value: int) -> int:
        """Check a value before it is stored; return 0 or an abort code."""
        if self._objects.controlword & CW_HALT or self._inner is None:
            return OK
        return self._inner(value)


def deviate(
    power_drive: PowerDrive, objects: DriveObjects, od: ObjectDictionary, quirks: Quirks
) -> None:
    """Add the enabled quirks other than those of the wire, before power comes on."""
    modes, pp = power_drive.modes, EMULATED_MODES["pp"]
    if "single_set_point_only" in quirks:
        modes[pp] = SingleSetPoint(modes[pp])
    if "edge_only_bits" in quirks:
        modes[pp] = EdgeOnlyBits(modes[pp])
    if "stale_target_reached" in quirks:
        stale_ns = parameter_ns(quirks, "stale_target_reached", "for_s")
        modes[pp] = StaleTargetReached(modes[pp], stale_ns)
    if "inverted_set_point_acknowledge" in quirks:
        modes[pp] = InvertedAcknowledge(modes[pp])
    power_drive.quirk_bits = parameter(quirks, "statusword_bits", "bits")
    if "target_reached_in_fault" in quirks:
        power_drive.fault_bits = TARGET_REACHED
    if "halt_holds_mode" in quirks:
        HaltHoldsMode(od, objects)


def wire_quirks(quirks: Quirks) -> WireQuirks:
    """Return the enabled quirks of the wire."""
    wire = WireQuirks()
    wire.sdo_mean_ns = parameter_ns(quirks, "slow_sdo", "mean_s")
    wire.sdo_spread_ns = parameter_ns(quirks, "slow_sdo", "spread_s")
    wire.heartbeat_ns = parameter_ns(quirks, "heartbeat_jitter", "max_s")
    wire.deaf_ns = parameter_ns(quirks, "deaf_after_boot_up", "for_s")
    wire.has_stray_emcy = "stray_emcy" in quirks
    wire.has_misplaced_register = "misplaced_error_register" in quirks
    wire.hides_size = "size_not_indicated" in quirks
    wire.has_stale_bytes = "stale_sdo_bytes" in quirks
    wire.has_emcy_after_boot_up = "emcy_after_boot_up" in quirks
    vendor = parameter(quirks, "emcy_vendor_bytes", "value")
    wire.vendor_bytes = vendor.to_bytes(5, "little") if vendor else b""
    wire.buffer_frames = parameter(quirks, "emcy_on_overrun", "frames")
    wire.buffer_ns = parameter_ns(quirks, "emcy_on_overrun", "within_s")
    return wire
