"""Commanding a drive by its controlword: power, modes, stopping, set-points. In its own units."""

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.canopen_link import CanopenLink, Transmission, can_frame
from motorapi.adaptations.cia402_objects import (
    ACKNOWLEDGE,
    CHANGE_IMMEDIATELY,
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FAULT_BIT,
    FAULT_RESET,
    HALT,
    NEW_SET_POINT,
    QUICK_STOP,
    SHUTDOWN,
    SWITCH_ON,
    Mode,
    PdsState,
    encode,
    is_off,
    shows_no_acknowledge,
    shows_no_fault,
    shows_no_reaction,
    type_of,
)
from motorapi.adaptations.drive_node import DriveNode
from motorapi.adaptations.drive_objects import DriveObjects
from motorapi.adaptations.stop_repetition import StopRepetition, stop_sender
from motorapi.errors import DeadlineExceeded, MotorBusyError, UnsupportedError

if TYPE_CHECKING:
    from motorapi.adaptations.drive_setup import DriveFacts
    from motorapi.adaptations.motion_watch import MotionWatch
    from motorapi.fencing import Fence, NodeFence

_STATE_TIMEOUT_S: Final = 2.0
_MODE_TIMEOUT_S: Final = 0.5
_ACKNOWLEDGE_TIMEOUT_S: Final = 0.5
_RESET_TIMEOUT_S: Final = 0.5
_POLL_S: Final = 0.002
_STEPS_MAX: Final = 8
_CONTROL: Final = struct.Struct("<IB3xH6x")
_NEXT_COMMAND: Final = {
    PdsState.SWITCH_ON_DISABLED: SHUTDOWN,
    PdsState.READY_TO_SWITCH_ON: SWITCH_ON,
    PdsState.SWITCHED_ON: ENABLE_OPERATION,
    PdsState.QUICK_STOP_ACTIVE: ENABLE_OPERATION,
}


@final
class DriveControl:
    """Everything that is done through the controlword (6040h) and the mode of operation (6060h).

    It goes by SDO where there is time to wait for the confirmation, else by RPDO. `facts` is set
    by whoever brings the drive up. What does not stop the drive goes through `fence`.
    """

    def __init__(
        self, link: CanopenLink, node: DriveNode, objects: DriveObjects, fence: "NodeFence | None"
    ) -> None:
        self.facts: DriveFacts | None = None
        self._physical = objects.physical
        self._fence = fence
        self._link = link
        self._node = node
        self._objects = objects
        self._mode: Mode | None = None
        self.is_halted = False  # it was told to stop since `take_set_points`, by whomever
        self._word: int | None = None  # the controlword commanded last
        self._repetition: StopRepetition | None = None
        self._armed: int | None = None  # the index of the target that the next SYNC makes count
        self._latched: int | None = None  # the same, until the drive has shown that it counted
        self.may_be_armed = False  # by who has lost the drive, and is in his turn at SYNC still
        self.holds_halt = False  # a halt of ours waits in it for a SYNC, in place of that

    def forget(self) -> None:
        """The drive has booted, or is new: nothing is known of it."""
        self._end_repetition()
        self._word = None
        self._mode = None
        self.is_halted = False
        self._armed = None
        self.has_started()

    def supports(self, mode: Mode) -> bool:
        """Whether the drive names the mode in 6502h; what is not known is not denied."""
        facts = self.facts
        return facts is None or facts.modes is None or mode in facts.modes

    # --- power ---------------------------------------------------------------------------

    def write_controlword(self, word: int, *, stops: bool = False) -> None:
        """The drive has this controlword (6040h), by SDO: confirmed."""
        self._end_repetition()
        self._word = word
        self._objects.download(0x6040, 0, word.to_bytes(2, "little"), stops=stops)

    def send_controlword(self, word: int) -> Transmission | None:
        """The controlword is on its way, by RPDO; does not wait (None: it was written by SDO)."""
        facts = self.facts
        if facts is None or facts.control_id is None:
            self.write_controlword(word)
            return None
        self._end_repetition()
        self._word = word
        return self._send(_CONTROL.pack(facts.control_id, 2, word), self._fence)

    def _send(self, frame: bytes, fence: "Fence | None") -> Transmission:
        """The frame waits for the bus. Raises MotorBusyError: see `PhysicalMotor.passage`."""
        with self._physical.passage(self._node.label, of_holder=True):
            return self._link.send_tracked(frame, fence)

    def enable(self) -> None:
        """Operation is enabled, step by step from whatever state the statusword shows.

        Raises:
            DeadlineExceeded: the drive did not follow a step.
            DeviceFault: it is in fault.
        """
        node = self._node
        node.refresh()
        for _ in range(_STEPS_MAX):
            state = node.state
            if state is PdsState.OPERATION_ENABLED:
                self.is_halted = False
                return
            if state in (PdsState.FAULT, PdsState.FAULT_REACTION_ACTIVE):
                raise node.fault_error(self._node.label)
            word = DISABLE_VOLTAGE if state is None else _NEXT_COMMAND.get(state)
            if word is not None:
                self.write_controlword(word)
            before = "unknown" if state is None else state.value
            node.wait_for_status(
                _differs(node, state),
                _STATE_TIMEOUT_S,
                f"leaving state {before!r} on the way to operation enabled",
            )
        raise DeadlineExceeded(
            awaited=f"{self._node.label}: operation enabled, in {_STEPS_MAX} steps",
            timeout_s=_STEPS_MAX * _STATE_TIMEOUT_S,
            last_heard=node.describe_status(),
        )

    def disable(self, *, stops: bool = False) -> None:
        """The power stage is off, by disable voltage; to stop the drive, whoever owns it."""
        self.write_controlword(DISABLE_VOLTAGE, stops=stops)
        self._node.wait_for_status(is_off, _STATE_TIMEOUT_S, "power stage off")
        self.is_halted = False

    def reset_fault(self) -> None:
        """The fault is acknowledged; the state is switch on disabled.

        Raises:
            DeviceFault: its cause is still there.
        """
        node = self._node
        node.refresh()
        if not node.statusword & FAULT_BIT:
            return
        node.wait_for_status(shows_no_reaction, _STATE_TIMEOUT_S, "end of the fault reaction")
        self.write_controlword(0)  # the reset is a rising edge
        self.write_controlword(FAULT_RESET)
        try:
            node.wait_for_status(shows_no_fault, _RESET_TIMEOUT_S, "fault reset")
        except DeadlineExceeded:
            raise node.fault_error(self._node.label) from None
        finally:
            self.write_controlword(0)

    def send_halt(self, watch: "MotionWatch | None" = None) -> None:
        """The drive stops as 605Dh says and holds, until something new is commanded.

        With `watch`, which follows how it comes to rest, the command is repeated: it may be lost.
        """
        self.is_halted = True
        self._send_stop(ENABLE_OPERATION | HALT, watch)

    def send_quick_stop(self, watch: "MotionWatch | None" = None) -> None:
        """The drive stops as 605Ah says. `watch`: as for a halt."""
        self.is_halted = True
        self._send_stop(QUICK_STOP, watch)

    def _send_stop(self, word: int, watch: "MotionWatch | None") -> None:
        self._armed = None
        self._end_repetition()
        self._word = word
        control_id = None if self.facts is None else self.facts.control_id
        send = stop_sender(self._node, self._physical, control_id, word)
        send(None)
        self._overwrite_latch(None)
        if watch is not None:
            self._repetition = StopRepetition(self._node, watch, self._fence, send)

    def _end_repetition(self) -> None:
        if self._repetition is not None:
            self._repetition.cancel()
            self._repetition = None

    # --- modes and set-points ------------------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """The drive is in this mode of operation, as 6061h confirms.

        Raises:
            UnsupportedError: 6502h does not name it.
            DeadlineExceeded: 6061h did not follow.
        """
        if not self.supports(mode):
            modes = self.facts.modes if self.facts is not None and self.facts.modes else ()
            names = ", ".join(one.name for one in sorted(modes))
            raise UnsupportedError(
                motor=self._node.label, feature=f"mode {mode.name}", supported=names
            )
        if not self._objects.push(0x6060, mode) and self._mode is mode:
            return
        self._mode = None
        deadline_ns = self._link.runtime.now_ns() + round(_MODE_TIMEOUT_S * 1e9)
        while True:
            display = self._objects.read_int(0x6061)
            if display == mode:
                self._mode = mode
                return
            if self._link.runtime.now_ns() >= deadline_ns:
                self._objects.doubt(0x6060)
                raise DeadlineExceeded(
                    awaited=f"{self._node.label}: mode {mode.name} in 6061h",
                    timeout_s=_MODE_TIMEOUT_S,
                    last_heard=f"mode {display}",
                )
            self._link.runtime.wait_until(_never, _POLL_S)

    def is_in(self, mode: Mode) -> bool:
        """Whether 6061h confirmed this mode, and nobody can have changed it since."""
        return self._mode is mode and self._objects.is_believed(0x6060, mode)

    def take_set_points(self) -> None:
        """Pp: bit 4 is low, and the acknowledge with it. A halt goes on until the next set-point.

        From now on `is_halted` tells of stops that came after this.
        """
        self.write_controlword(self._holding_word())
        if self._node.statusword & ACKNOWLEDGE or not self._node.status_is_cyclic:
            self._node.wait_for_status(
                shows_no_acknowledge, _ACKNOWLEDGE_TIMEOUT_S, "set-point acknowledge to fall"
            )
        self.is_halted = False

    def keep_halt(self) -> None:
        """A halt goes on until the next set-point; `is_halted` tells of stops from now on."""
        self.is_halted = False

    def hold(self) -> None:
        """The drive is halted, so that no mode it changes to moves it, until its next set-point."""
        self.write_controlword(ENABLE_OPERATION | HALT)
        self.is_halted = False

    def release(self) -> None:
        """The controlword is plain operation enabled: no halt, no bit of a mode."""
        self.is_halted = False
        self.write_controlword(ENABLE_OPERATION)

    def send_set_point(self) -> Transmission | None:
        """Pp: target position 607Ah is what counts, at once (bits 4 and 5); a halt is lifted.

        Nothing of it if the drive was told to stop after `take_set_points`.
        """
        word = self._holding_word()
        if not self.is_halted:
            word |= NEW_SET_POINT | CHANGE_IMMEDIATELY
        return self.send_controlword(word)

    def send_holding_word(self) -> Transmission | None:
        """Operation enabled, halted or not as it was told last, every other bit low."""
        return self.send_controlword(self._holding_word())

    def _holding_word(self) -> int:
        return ENABLE_OPERATION | (HALT if self.is_halted else 0)

    def arm(self, index: int, target: int, *, fired: Callable[[int], None] | None = None) -> None:
        """The next SYNC makes `target` count; the drive has it. Arguments as in `send_armed`."""
        self._link.confirmed([self.send_armed(index, target, fired=fired)])

    def send_armed(
        self, index: int, target: int, *, fired: Callable[[int], None] | None = None
    ) -> Transmission:
        """What the next SYNC makes count (a position with bits 4 and 5) is on its way.

        Args:
            index: of the object that holds the target: 607Ah, 60FFh.
            target: in the drive's units.
            fired: is told when the SYNC after it was on the wire [ns].
        """
        facts = self.facts
        if facts is None or index not in facts.latched_ids:
            raise UnsupportedError(motor=self._node.label, feature="starting by SYNC")
        word = ENABLE_OPERATION
        if index == 0x607A:
            word |= NEW_SET_POINT | CHANGE_IMMEDIATELY
        self._armed = self._latched = index
        self._link.latching.add(self._node.node_id)
        self._objects.doubt(index)
        frame = _control_target(facts.latched_ids[index], word, index, target)
        transmission = self._send(frame, self._fence)

        def on_sync(time_ns: int) -> None:
            if self._armed is None:
                return
            if transmission.time_ns is None:  # SYNC was before it: the next one
                self._link.at_next_sync(on_sync)
                return
            self._armed = None
            if fired is not None:
                fired(time_ns)

        self._link.at_next_sync(on_sync)
        return transmission

    def send_armed_halt(self) -> Transmission | None:
        """A halt that the next SYNC makes count is on its way; None: no RPDO brings it so.

        Nobody's permission is asked, as for any stop.
        """
        if self.facts is None or 0x607A not in self.facts.latched_ids:
            return None
        self._armed, self._latched, self.is_halted = None, 0x607A, True
        self._word = self._holding_word()
        self._link.latching.add(self._node.node_id)
        return self._overwrite_latch(None)[0]

    @property
    def is_armed(self) -> bool:
        """Whether what was armed still waits for a SYNC."""
        return self._armed is not None

    def has_started(self) -> None:
        """What was armed has begun, as the drive shows: it is latched no more."""
        self._latched = None
        self._link.latching.discard(self._node.node_id)

    def disarm(self) -> None:
        """What was armed will not start, at no later SYNC either.

        It is overwritten, twice, as a frame may be lost. The frame that overwrites is latched then,
        and would bring its controlword back some day: a SYNC takes it out, once there is no drive
        on the bus that has something else latched.
        """
        self._armed = None
        try:
            transmissions = self._overwrite_latch(self._fence) + self._overwrite_latch(self._fence)
        except MotorBusyError:  # whoever has taken it over has seen to that; no SYNC for the others
            self.has_started()
            self._link.lost = True
            return
        if not transmissions:
            return
        self._link.confirmed(transmissions)
        self.has_started()
        if not self._link.latching and not self._link.lost and self._link.bus_sync.known() is None:
            self._link.confirmed([self._link.sync()])

    def _overwrite_latch(self, fence: "Fence | None") -> list[Transmission]:
        """The controlword as it is, and no motion, wait for the next SYNC in place of a target."""
        facts, indices = self.facts, [] if self._latched is None else [self._latched]
        if facts is None:
            return []
        if not indices and self.may_be_armed:
            self.may_be_armed, self.holds_halt = False, True
            indices = [*facts.latched_ids] * 2
        word = self._holding_word() if self._word is None else self._word
        word &= ~(NEW_SET_POINT | CHANGE_IMMEDIATELY)
        sent = []
        for index in indices:
            target = self._node.position_inc if index == 0x607A else 0
            self._objects.doubt(index)
            frame = _control_target(facts.latched_ids[index], word, index, target)
            sent.append(self._send(frame, fence))
        return sent


def _control_target(can_id: int, word: int, index: int, target: int) -> bytes:
    """The frame of an RPDO with controlword and a target."""
    data = encode(type_of(index, 0) or "i32", target)
    return can_frame(can_id, word.to_bytes(2, "little") + data)


def _differs(node: DriveNode, state: PdsState | None) -> Callable[[int], bool]:
    return lambda word: node.state is not state


def _never() -> bool:
    return False
