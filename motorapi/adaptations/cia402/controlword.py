"""Commands to a drive by its controlword: power, modes, stops, set-points.

All values are in the drive's own units. A stop is repeated until the drive obeys, against lost
frames.
"""

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.canopen.objects import encode
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.cia402.objects import (
    ACKNOWLEDGE,
    CHANGE_IMMEDIATELY,
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FAULT_BIT,
    FAULT_RESET,
    HALT,
    NEW_SET_POINT,
    OBJECTS,
    QUICK_STOP,
    RELATIVE,
    SHUTDOWN,
    SWITCH_ON,
    Mode,
    PdsState,
    is_off,
    shows_no_fault,
    shows_no_reaction,
)
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, MotorBusyError, UnsupportedError
from motorhil.motorapi.runtime.can_link import Transmission, can_frame

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts
    from motorhil.motorapi.adaptations.cia402.motion_status import MotionWatch
    from motorhil.motorapi.ownership.fencing import BoundFence, Fence, NodeFence
    from motorhil.motorapi.ownership.physical_motor import PhysicalMotor

_REPEAT_S: Final = 0.1
_REPEATS: Final = 10


def stop_sender(
    node: "DriveNode", physical: "PhysicalMotor", control_id: int | None, word: int
) -> "Callable[[Fence | None], None]":
    """Return a function that sends the controlword at once, without waiting.

    Args:
        node: the drive.
        physical: its motor; low-level access of another thread prevents sending (MotorBusyError).
        control_id: the identifier of the RPDO for it; None: there is none, and SDO is used.
        word: the controlword of the stop.
    """

    def send(fence: "Fence | None") -> None:
        with physical.passage(node.label, of_holder=True):
            if control_id is None:
                node.sdo.send_at_once(0x6040, 0, word.to_bytes(2, "little"), fence)
            else:
                node.link.send_tracked(_CONTROL.pack(control_id, 2, word), fence)

    return send


@final
class StopRepetition:
    """A repeated stop, sent until `watch` sees its end or it is cancelled.

    While the bus is off nothing can be sent, so the repetition goes on until it has recovered.

    Any program may stop a drive without owning it. But a former owner that stopped the drive and
    has lost it since must not stop its new owner unknowingly.

    A late status may say that a drive is off that has been enabled since. Nothing is sent to such a
    drive, which could enable it, until a later status shows it enabled.

    Args:
        node: the received state of the drive.
        watch: observes the deceleration.
        fence: the fence of the drive; None: no other process can take it over.
        send: sends the stop once, through a fence if there is one.
    """

    def __init__(
        self,
        node: "DriveNode",
        watch: "MotionWatch",
        fence: "NodeFence | None",
        send: "Callable[[Fence | None], object]",
    ) -> None:
        self._node = node
        self._watch = watch
        self._send = send
        self._left = _REPEATS
        self._was_enabled = node.state is PdsState.OPERATION_ENABLED
        self._fence: BoundFence | None = None
        if fence is not None and fence.is_owned:
            with suppress(MotorBusyError):  # the drive is already lost
                self._fence = fence.bound("a stop")
        self._registration = node.link.runtime.every(_REPEAT_S, self._again)

    def _again(self) -> None:
        node, watch = self._node, self._watch
        enabled = node.state is PdsState.OPERATION_ENABLED
        is_over = self._was_enabled and (watch.ended_ns is not None or not enabled)
        if node.watch is not watch or is_over or not self._left:
            self.cancel()
            return
        self._left -= 1
        if not enabled:
            return
        self._was_enabled = True
        try:
            self._send(self._fence)
        except LinkError:
            if not node.link.status.is_off:
                self.cancel()
            self._left += 1  # not sent
        except MotorBusyError:
            self.cancel()

    def cancel(self) -> None:
        """End the repetition."""
        self._registration.cancel()


_STATE_TIMEOUT_S: Final = 2.0
_MODE_TIMEOUT_S: Final = 0.5
_ACKNOWLEDGE_TIMEOUT_S: Final = 0.5
_RESET_TIMEOUT_S: Final = 0.5
_POLL_S: Final = 0.002
_STEPS_MAX: Final = 8
_CONTROL: Final = struct.Struct("<IB3xH6x")
_TARGETS: Final = {
    Mode.PROFILE_POSITION: 0x607A,
    Mode.PROFILE_VELOCITY: 0x60FF,
    Mode.CYCLIC_SYNC_POSITION: 0x607A,
}
_NEXT_COMMAND: Final = {
    PdsState.SWITCH_ON_DISABLED: SHUTDOWN,
    PdsState.READY_TO_SWITCH_ON: SWITCH_ON,
    PdsState.SWITCHED_ON: ENABLE_OPERATION,
    PdsState.QUICK_STOP_ACTIVE: ENABLE_OPERATION,
}


@final
class DriveControl:
    """Commands through the controlword (6040h) and the modes of operation (6060h).

    They go by SDO where there is time to wait for the confirmation, else by RPDO. The bring-up sets
    `facts`. Every command except stops passes through `fence`.

    Attributes:
        node: the received state of the drive.
        objects: the objects of the drive.
        fence: the fence for frames that command the drive; None: no other process can take it over.
    """

    def __init__(self, node: DriveNode, objects: ObjectAccess, fence: "NodeFence | None") -> None:
        self.facts: DriveFacts | None = None
        self.node: Final = node
        self.objects: Final = objects
        self.fence: Final = fence
        self._physical = objects.physical
        self._link = node.link
        self._sync = node.bus.sync
        self._mode: Mode | None = None
        self.is_halted: bool = False  # stopped since `take_set_points`, by any program
        self._word: int | None = None  # the controlword commanded last
        self._relative = 0  # bit 6 of the next set-point
        self.acknowledge_at_rest: int = 0  # set-point acknowledge while nothing waits for it
        self._repetition: StopRepetition | None = None
        self._armed: int | None = None  # index of the target that the next SYNC latches
        self._latched: int | None = None  # the same, until the drive has shown that it has started
        self.may_be_armed: bool = False  # by a former owner that still has its turn at SYNC
        self.holds_halt: bool = False  # a halt of ours waits for a SYNC in its place

    def forget(self) -> None:
        """Forget everything about the drive, as it has booted or is new."""
        self._end_repetition()
        self._word = None
        self._mode = None
        self.is_halted = False
        self._relative = 0
        self._armed = None
        self.has_started()

    def supports(self, mode: Mode) -> bool:
        """Return whether the drive has the mode (6502h) and its target; True while not known."""
        facts = self.facts
        if facts is None:
            return True
        has_target = _TARGETS.get(mode) not in facts.missing
        return has_target and (facts.modes is None or mode in facts.modes)

    def require(self, mode: Mode) -> None:
        """Raise UnsupportedError unless the drive supports the mode."""
        if not self.supports(mode):
            modes = self.facts.modes if self.facts is not None and self.facts.modes else ()
            names = ", ".join(one.name for one in sorted(modes) if self.supports(one))
            raise UnsupportedError(
                motor=self.node.label, feature=f"mode {mode.name}", supported=names
            )

    # --- power ---------------------------------------------------------------------------

    def write_controlword(self, word: int, *, stops: bool = False) -> None:
        """Write the controlword (6040h) by SDO, which confirms it."""
        self._end_repetition()
        self._word = word
        self.objects.download(0x6040, 0, word.to_bytes(2, "little"), stops=stops)

    def send_controlword(self, word: int) -> Transmission | None:
        """Send the controlword by RPDO without waiting; return None if it was written by SDO."""
        facts = self.facts
        if facts is None or facts.control_id is None:
            self.write_controlword(word)
            return None
        self._end_repetition()
        self._word = word
        return self._send(_CONTROL.pack(facts.control_id, 2, word), self.fence)

    def _send(self, frame: bytes, fence: "Fence | None") -> Transmission:
        """Queue a frame for the bus; raises MotorBusyError as `PhysicalMotor.passage`."""
        with self._physical.passage(self.node.label, of_holder=True):
            return self._link.send_tracked(frame, fence)

    def enable(self) -> None:
        """Enable operation, step by step from the state that the statusword shows.

        Raises:
            DeadlineExceeded: the drive did not follow a step.
            DeviceFault: the drive is in fault.
        """
        node = self.node
        node.refresh()
        for _ in range(_STEPS_MAX):
            state = node.state
            if state is PdsState.OPERATION_ENABLED:
                self.is_halted = False
                return
            if state in (PdsState.FAULT, PdsState.FAULT_REACTION_ACTIVE):
                raise node.fault_error(self.node.label)
            word = DISABLE_VOLTAGE if state is None else _NEXT_COMMAND.get(state)
            self.is_halted = False
            if word is not None:
                self.write_controlword(word)
            before = "unknown" if state is None else state.value
            node.wait_for_status(
                self._left_or_stopped(state),  # a quick stop leads back to where this step began
                _STATE_TIMEOUT_S,
                f"leaving state {before!r} on the way to operation enabled",
            )
        raise DeadlineExceeded(
            awaited=f"{self.node.label}: operation enabled, in {_STEPS_MAX} steps",
            timeout_s=_STEPS_MAX * _STATE_TIMEOUT_S,
            last_heard=node.describe_status(),
        )

    def _left_or_stopped(self, state: PdsState | None) -> Callable[[int], bool]:
        return lambda word: self.node.state is not state or self.is_halted

    def disable(self, *, stops: bool = False) -> None:
        """Switch the power stage off by disable voltage; with `stops`, without owning the drive."""
        self.write_controlword(DISABLE_VOLTAGE, stops=stops)
        self.node.wait_for_status(is_off, _STATE_TIMEOUT_S, "power stage off")
        self.is_halted = False

    def reset_fault(self) -> None:
        """Reset the fault; the state is switch on disabled afterwards.

        Raises:
            DeviceFault: its cause persists.
        """
        node = self.node
        node.refresh()
        if not node.statusword & FAULT_BIT:
            return
        node.wait_for_status(shows_no_reaction, _STATE_TIMEOUT_S, "end of the fault reaction")
        self.write_controlword(0)  # the reset is a rising edge
        self.write_controlword(FAULT_RESET)
        try:
            node.wait_for_status(shows_no_fault, _RESET_TIMEOUT_S, "fault reset")
        except DeadlineExceeded:
            raise node.fault_error(self.node.label) from None
        finally:
            self.write_controlword(0)

    def send_halt(self, watch: "MotionWatch | None" = None) -> None:
        """Halt the drive as 605Dh defines, until the next command.

        With `watch`, which observes the deceleration, the command is repeated in case it is lost.
        """
        self.is_halted = True
        self._send_stop(ENABLE_OPERATION | HALT, watch)

    def send_quick_stop(self, watch: "MotionWatch | None" = None) -> None:
        """Stop the drive as 605Ah defines; `watch` as for a halt."""
        self.is_halted = True
        self._send_stop(QUICK_STOP, watch)

    def stop_once_enabled(self, word: int, watch: "MotionWatch") -> None:
        """Stop the drive if a later status shows it enabled, by a command of this program."""
        if self._word is None or self._word & ENABLE_OPERATION != ENABLE_OPERATION:
            return
        self._end_repetition()
        send = stop_sender(self.node, self._physical, self._control_id(), word)
        self._repetition = StopRepetition(self.node, watch, self.fence, send)

    def _control_id(self) -> int | None:
        """Return the identifier of the RPDO for the controlword, or None."""
        return None if self.facts is None else self.facts.control_id

    def _send_stop(self, word: int, watch: "MotionWatch | None") -> None:
        self._armed = None
        self._end_repetition()
        self._word = word
        send = stop_sender(self.node, self._physical, self._control_id(), word)
        try:
            send(None)
            self._overwrite_latch(None)
        finally:  # on a bus that is off, the first repetition after its recovery stops the drive
            if watch is not None:
                self._repetition = StopRepetition(self.node, watch, self.fence, send)

    def _end_repetition(self) -> None:
        if self._repetition is not None:
            self._repetition.cancel()
            self._repetition = None

    # --- modes and set-points ------------------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """Set the mode of operation, confirmed by 6061h.

        Some drives hold their mode under halt. The halt is then released, so that nothing moves.

        Raises:
            UnsupportedError: the drive does not support the mode.
            DeadlineExceeded: 6061h did not follow.
        """
        self.require(mode)
        if not self.objects.push(0x6060, mode) and self._mode is mode:
            return
        self._mode = None
        display = self._await_mode(mode)
        if display != mode and self._release_halt(display, mode):
            self.objects.write(0x6060, mode)
            display = self._await_mode(mode)
        if display != mode:
            self.objects.doubt(0x6060)
            raise DeadlineExceeded(
                awaited=f"{self.node.label}: mode {mode.name} in 6061h",
                timeout_s=_MODE_TIMEOUT_S,
                last_heard=f"mode {display}",
            )
        self.objects.push(0x6060, mode)
        self._mode = mode

    def _await_mode(self, mode: Mode) -> int:
        """Return 6061h, once it shows the mode or the time is over."""
        deadline_ns = self._link.runtime.now_ns() + round(_MODE_TIMEOUT_S * 1e9)
        while True:
            display = self.objects.read_int(0x6061)
            if display == mode or self._link.runtime.now_ns() >= deadline_ns:
                return display
            self._link.runtime.wait_until(_never, _POLL_S)

    def _release_halt(self, display: int, mode: Mode) -> bool:
        """Release a halt in the mode that 6061h shows; return whether nothing moved by that.

        The target of that mode becomes the present demand, or standstill. In tq it becomes the
        present torque, as without it a load would drop.
        """
        node, objects = self.node, self.objects
        is_halted = self._word is None or self._word & HALT
        held = objects.read_optional(0x6062)
        if not is_halted or held is None:
            return False
        if Mode.PROFILE_TORQUE in (mode, display):
            torque = objects.read_optional(0x6077)
            if torque is None:
                return False
            objects.write(0x6071, torque)
        if display in (Mode.PROFILE_POSITION, Mode.CYCLIC_SYNC_POSITION):
            if not node.is_within_counter(node.on_from(held)):
                return False
            objects.write(0x607A, held)
        elif display == Mode.PROFILE_VELOCITY:
            objects.write(0x60FF, 0)
        elif display not in (Mode.HOMING, Mode.PROFILE_TORQUE):
            return False
        if display == Mode.PROFILE_POSITION:
            word = ENABLE_OPERATION | HALT
            self.write_controlword(word)
            self.write_controlword(word | NEW_SET_POINT | CHANGE_IMMEDIATELY)
        self.release()
        return True

    def is_in(self, mode: Mode) -> bool:
        """Return whether 6061h confirmed this mode, and it cannot have changed since."""
        return self._mode is mode and self.objects.is_believed(0x6060, mode)

    def take_set_points(self, *, relative: bool = False) -> None:
        """Clear bit 4 (pp) and await a low acknowledge; a halt lasts until the next set-point.

        Some drives show an inverted acknowledge: a bit that stays is then the level of rest.
        From then on `is_halted` reports stops that came after this call. With `relative`, the next
        target is a distance from where 60F2h says.
        """
        self._relative = RELATIVE if relative else 0
        self.write_controlword(self._holding_word())
        node, rest = self.node, self.acknowledge_at_rest
        if node.statusword & ACKNOWLEDGE != rest or not node.status_is_cyclic:
            try:
                node.wait_for_status(
                    lambda word: word & ACKNOWLEDGE == rest,
                    _ACKNOWLEDGE_TIMEOUT_S,
                    "set-point acknowledge to fall",
                )
            except DeadlineExceeded:
                if node.statusword & ACKNOWLEDGE == rest:
                    raise
                self.acknowledge_at_rest ^= ACKNOWLEDGE
        self.is_halted = False

    def keep_halt(self) -> None:
        """Keep a halt until the next set-point; `is_halted` reports stops from now on."""
        self.is_halted = False

    def hold(self) -> None:
        """Halt the drive until its next set-point, so that no change of mode moves it."""
        self.write_controlword(ENABLE_OPERATION | HALT)
        self.is_halted = False

    def release(self) -> None:
        """Write the controlword for operation enabled, with no halt and no bit of a mode."""
        self.is_halted = False
        self.write_controlword(ENABLE_OPERATION)

    def send_set_point(self) -> Transmission | None:
        """Start a motion to target position 607Ah at once (pp, bits 4 and 5), and lift a halt.

        No motion is started if the drive was stopped after `take_set_points`.
        """
        word = self._holding_word()
        if not self.is_halted:
            word |= NEW_SET_POINT | CHANGE_IMMEDIATELY | self._relative
        return self.send_controlword(word)

    def send_holding_word(self) -> Transmission | None:
        """Send operation enabled with the halt bit as commanded last, and every other bit low."""
        return self.send_controlword(self._holding_word())

    def _holding_word(self) -> int:
        return ENABLE_OPERATION | (HALT if self.is_halted else 0)

    def arm(self, index: int, target: int, *, fired: Callable[[int], None] | None = None) -> None:
        """Arm `target` for the next SYNC, and wait for its frame; arguments as in `send_armed`."""
        self._link.confirmed([self.send_armed(index, target, fired=fired)])

    def send_armed(
        self, index: int, target: int, *, fired: Callable[[int], None] | None = None
    ) -> Transmission:
        """Send a target that the next SYNC latches; a position is sent with bits 4 and 5.

        Args:
            index: the object that holds the target: 607Ah, 60FFh.
            target: the target in the drive's units.
            fired: called with the time [ns] when the SYNC after it was on the wire.
        """
        facts = self.facts
        if facts is None or index not in facts.latched_ids:
            raise UnsupportedError(motor=self.node.label, feature="starting by SYNC")
        word = ENABLE_OPERATION
        if index == 0x607A:
            word |= NEW_SET_POINT | CHANGE_IMMEDIATELY | self._relative
        self._armed = self._latched = index
        self._sync.latching.add(self.node.node_id)
        self.objects.doubt(index)
        frame = _control_target(facts.latched_ids[index], word, index, target)
        transmission = self._send(frame, self.fence)

        def on_sync(time_ns: int) -> None:
            if self._armed is None:
                return
            if transmission.time_ns is None:  # SYNC was before the frame: wait for the next one
                self._sync.at_next(on_sync)
                return
            self._armed = None
            if fired is not None:
                fired(time_ns)

        self._sync.at_next(on_sync)
        return transmission

    def send_armed_halt(self) -> Transmission | None:
        """Send a halt that the next SYNC latches; return None if there is no RPDO for it.

        Any process may send it, as any stop.
        """
        if self.facts is None or 0x607A not in self.facts.latched_ids:
            return None
        self._armed, self._latched, self.is_halted = None, 0x607A, True
        self._word = self._holding_word()
        self._sync.latching.add(self.node.node_id)
        return self._overwrite_latch(None)[0]

    @property
    def is_armed(self) -> bool:
        """True if an armed target still waits for a SYNC."""
        return self._armed is not None

    def has_started(self) -> None:
        """Record that the drive has started the armed target."""
        self._latched = None
        self._sync.latching.discard(self.node.node_id)

    def disarm(self) -> None:
        """Prevent the armed target from starting at any later SYNC.

        The target is overwritten twice, as a frame may be lost. The overwriting frame then waits
        for a SYNC, and would bring its controlword back later. So a SYNC clears it, once no drive
        on the bus holds another armed set-point.
        """
        self._armed = None
        try:
            transmissions = self._overwrite_latch(self.fence) + self._overwrite_latch(self.fence)
        except MotorBusyError:  # its new owner clears it; no SYNC for the others
            self.has_started()
            self._sync.lost = True
            return
        if not transmissions:
            return
        self._link.confirmed(transmissions)
        self.has_started()
        if not self._sync.latching and not self._sync.lost and self._sync.known() is None:
            self._link.confirmed([self._sync.send()])

    def _overwrite_latch(self, fence: "Fence | None") -> list[Transmission]:
        """Overwrite the waiting target by the present controlword without a motion."""
        facts, indices = self.facts, [] if self._latched is None else [self._latched]
        if facts is None:
            return []
        if not indices and self.may_be_armed:
            self.may_be_armed, self.holds_halt = False, True
            indices = [*facts.latched_ids] * 2
        word = self._holding_word() if self._word is None else self._word
        word &= ~(NEW_SET_POINT | CHANGE_IMMEDIATELY | RELATIVE)
        sent = []
        for index in indices:
            target = self.node.counter if index == 0x607A else 0
            self.objects.doubt(index)
            frame = _control_target(facts.latched_ids[index], word, index, target)
            sent.append(self._send(frame, fence))
        return sent


def _control_target(can_id: int, word: int, index: int, target: int) -> bytes:
    """Return the frame of an RPDO with controlword and target."""
    data = encode(OBJECTS.type_of(index, 0) or "i32", target)
    return can_frame(can_id, word.to_bytes(2, "little") + data)


def _never() -> bool:
    return False
