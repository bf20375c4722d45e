"""A CAN controller at the bit level: levels driven and levels sampled.

Once per bit time the wire reads `drives` and calls `hear` with the sampled level. The station
implements framing, arbitration and acknowledgement. `Reception` decodes other nodes' frames,
`CanSignalling` handles errors and the time between frames, `Confinement` has the error counters.

An error flag begins with the bit after the error was detected. The flag of a CRC error begins with
the bit after the ACK delimiter.

Left open by the standard, decided here:
- A bit error in an active error flag or overload flag begins a new error flag, and counts by rules
  d and e alone.
- An error flag is active if the node was error active before the error that it signals. (An error
  that makes a node error passive is signalled by an active flag.)
- A node that becomes bus-off leaves the wire with the bit that made it so.
- Six equal dominant bits end a passive error flag as six recessive ones do. The bit after them is
  the first after the flag for rules b and f.
- A passive transmitter without an acknowledgement counts by rule c when it sees a dominant bit in
  its flag.

Error messages are those of a driver that reports each error: its type, its place, whether the node
was sending, and the counters after it. A change of the node's error state is reported as Linux's
`can_change_state` does. A bus-off node reports no counters: they would not fit.

Source: ISO 11898-1, medium access control; Bosch CAN 2.0, chapters 3 and 7. Linux
drivers/net/can/dev/dev.c; "can: do not report txerr and rxerr during bus-off" (2022)
in its drivers.
"""

from typing import Final, final

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bitlevel.encoder import DOMINANT, RECESSIVE, WireFrame, wire_frame
from motorhil.emulators.can.bitlevel.receiver import (
    ACCEPTED,
    ACK_NEXT,
    ACKNOWLEDGED,
    COMPLETE,
    EXCEPTION,
    FORM,
    OVERLOAD,
    STUFF,
    Reception,
)
from motorhil.emulators.can.controller_config import FrameSupport
from motorhil.emulators.can.error_confinement import REC_MAX, Confinement, ErrorState, state_of
from motorhil.emulators.can.frame import ESI, FD_FRAME_BYTES

# kinds of notes
NOTE_ACCEPTED: Final = 0
NOTE_SENT: Final = 1
NOTE_FAILED: Final = 2
NOTE_LOST: Final = 3
NOTE_ERROR: Final = 4
NOTE_STATE: Final = 5

_TX: Final = (told.ERROR_ACTIVE, told.TX_WARNING, told.TX_PASSIVE)
_RX: Final = (told.ERROR_ACTIVE, told.RX_WARNING, told.RX_PASSIVE)

FLAG_BITS: Final = 6
DELIMITER_BITS: Final = 8
INTERMISSION_BITS: Final = 3
_TOLERATED_BITS: Final = 8  # dominant bits after a flag: rule f

# results of a bit
BUSY: Final = 0
FREE: Final = 1  # the intermission is over
STARTED: Final = 2  # the intermission ended with a start of frame
GONE: Final = 3  # the node is bus-off

_ACTIVE_FLAG: Final = 0
_PASSIVE_FLAG: Final = 1
_OVERLOAD_FLAG: Final = 2
_AFTER_FLAG: Final = 3  # its own flag is sent; it waits for a recessive bit
_DELIMITER: Final = 4
_INTERMISSION: Final = 5

SUSPEND_BITS: Final = 8
INTEGRATION_BITS: Final = 11  # recessive bits after which a node that comes back takes part

# phases
IDLE: Final = 0
SENDING: Final = 1
RECEIVING: Final = 2
SIGNALLING: Final = 3
INTEGRATING: Final = 4
OFF: Final = 5


@final
class ErrorJournal:
    """The log of events at the node with these counters.

    Attributes:
        bit: the bit of the next entry.
        notes: (bit, kind, frame or error message).
    """

    def __init__(self, confinement: Confinement) -> None:
        self.bit = 0
        self.notes: list[tuple[int, int, bytes]] = []
        self._confinement = confinement
        self._state = confinement.state()

    def note(self, kind: int, frame: bytes) -> None:
        """Log an event of this kind for this frame."""
        self.notes.append((self.bit, kind, frame))

    def note_error(self, kind: int, place: int, transmitter: bool) -> None:
        """Log an error of this kind, at this place (data[2] and data[3] of the message)."""
        classes = told.PROTOCOL | told.BUS_ERROR
        if place == told.ACK_SLOT and not kind:
            classes |= told.NO_ACKNOWLEDGE
        confinement = self._confinement
        message = told.pack_error(
            classes,
            protocol=kind | told.TRANSMITTING if transmitter else kind,
            location=place,
            counters=None if confinement.is_off() else (confinement.tec, confinement.rec),
        )
        self.note(NOTE_ERROR, message)

    def note_state(self) -> bool:
        """Log a change of the error state and return whether the node became bus-off."""
        state = self._confinement.state()
        if state == self._state:
            return False
        self._state = state
        self.note(NOTE_STATE, state_message(self._confinement))
        return state == ErrorState.BUS_OFF


def state_message(confinement: Confinement) -> bytes:
    """Return the error message that reports the current error state."""
    if confinement.is_off():
        return told.pack_error(told.MESSAGE_BUS_OFF)
    tx, rx = state_of(confinement.tec), state_of(confinement.rec)
    controller = _TX[tx] if tx >= rx else 0
    if rx >= tx:
        controller |= _RX[rx]
    counters = (confinement.tec, confinement.rec)
    return told.pack_error(told.CONTROLLER, controller=controller, counters=counters)


@final
class CanSignalling:
    """A node between two frames; `error`, `overload` or `intermission` begins it.

    Attributes (read only):
        drives: the level it puts on the wire in the next bit.
        transmitter: it sent the frame before (set by the caller that begins a phase).
    """

    def __init__(self, confinement: Confinement, journal: ErrorJournal) -> None:
        self.drives: int = RECESSIVE
        self.transmitter = False
        self._confinement = confinement
        self._journal = journal
        self._phase = _INTERMISSION
        self._count = 0  # bits of the phase so far
        self._last = RECESSIVE  # in a passive flag
        self._after_error = False  # the flag was an error flag
        self._unacknowledged = False  # rule c, first exception: no dominant bit so far

    def error(
        self, kind: int, place: int, *, counts: bool = True, unacknowledged: bool = False
    ) -> int:
        """Signal an error in a frame, or in a phase without a flag: rules a and c.

        Args:
            kind: as in `ErrorJournal.note_error`.
            place: as there.
            counts: False for the second exception of rule c.
            unacknowledged: True for the first exception of rule c.
        """
        confinement = self._confinement
        passive = confinement.is_passive()
        unacknowledged = unacknowledged and passive
        if not self.transmitter:
            confinement.receiver_error()
        elif counts and not unacknowledged:
            confinement.transmitter_error()
        return self._flag(kind, place, passive, unacknowledged)

    def overload(self, place: int) -> None:
        """Begin an overload flag with the next bit."""
        self._journal.note_error(told.OVERLOAD, place, self.transmitter)
        self._enter(_OVERLOAD_FLAG, DOMINANT)
        self._after_error = False

    def intermission(self) -> None:
        """Begin the intermission with the next bit."""
        self._enter(_INTERMISSION, RECESSIVE)

    def stall(self) -> None:
        """Enter the phase after its own flag, having heard only dominant bits for long."""
        self._enter(_AFTER_FLAG, RECESSIVE)
        self._count = 1

    def is_after_flag(self) -> bool:
        """Return whether it waits for a recessive bit after its flag."""
        return self._phase == _AFTER_FLAG

    def is_stalled(self) -> bool:
        """Return whether dominant bits cannot change its state any more."""
        return (
            self._phase == _AFTER_FLAG and not self.transmitter and self._confinement.rec == REC_MAX
        )

    def hear(self, level: int) -> int:
        """Process the next bit and return its result."""
        phase = self._phase
        if phase == _PASSIVE_FLAG:
            return self._hear_passive_flag(level)
        if phase == _AFTER_FLAG:
            return self._hear_after_flag(level)
        if phase == _DELIMITER:
            return self._hear_delimiter(level)
        if phase == _INTERMISSION:
            return self._hear_intermission(level)
        return self._hear_own_flag(level)

    def _enter(self, phase: int, drives: int) -> None:
        self._phase = phase
        self._count = 0
        self.drives = drives

    def _flag(self, kind: int, place: int, passive: bool, unacknowledged: bool = False) -> int:
        """Begin an error flag with the next bit."""
        self._unacknowledged = unacknowledged
        self._journal.note_error(kind, place, self.transmitter)
        self._after_error = True
        if passive:
            self._enter(_PASSIVE_FLAG, RECESSIVE)
        else:
            self._enter(_ACTIVE_FLAG, DOMINANT)
        return self._settled()

    def _settled(self) -> int:
        """Record a change of the error state and return GONE or BUSY."""
        return GONE if self._journal.note_state() else BUSY

    def _hear_own_flag(self, level: int) -> int:
        """Process a bit of its active error flag or overload flag."""
        if level == RECESSIVE:
            place = told.OVERLOAD_FLAG if self._phase == _OVERLOAD_FLAG else told.ACTIVE_FLAG
            passive = self._confinement.is_passive()
            self._confinement.flag_destroyed(self.transmitter)
            return self._flag(told.BIT0_ERROR, place, passive)
        self._count += 1
        if self._count == FLAG_BITS:
            self._enter(_AFTER_FLAG, RECESSIVE)
        return BUSY

    def _hear_passive_flag(self, level: int) -> int:
        """Process a bit of its passive error flag, which six equal bits end."""
        if level == DOMINANT and self._unacknowledged:
            self._unacknowledged = False
            self._confinement.transmitter_error()
            if self._settled() == GONE:
                return GONE
        if self._count and level == self._last:
            self._count += 1
        else:
            self._count = 1
            self._last = level
        if self._count == FLAG_BITS:
            self._enter(_AFTER_FLAG, RECESSIVE)
        return BUSY

    def _hear_after_flag(self, level: int) -> int:
        """Process a bit after its flag: dominant bits are other nodes' flags, unless too many."""
        if level == RECESSIVE:
            self._enter(_DELIMITER, RECESSIVE)
            self._count = 1
            return BUSY
        if self.is_stalled():
            return BUSY
        self._count += 1
        if self._count == 1 and self._after_error and not self.transmitter:
            self._confinement.dominant_after_flag()
        elif not self._count % _TOLERATED_BITS:
            self._confinement.dominant_eight(self.transmitter)
            self._journal.note_error(told.FORM_ERROR, told.TOLERATED, self.transmitter)
        else:
            return BUSY
        return self._settled()

    def _hear_delimiter(self, level: int) -> int:
        """Process a bit of the delimiter: dominant is an error, in the last bit an overload."""
        if level == RECESSIVE:
            self._count += 1
            if self._count == DELIMITER_BITS:
                self.intermission()
        elif self._count < DELIMITER_BITS - 1:
            return self.error(told.FORM_ERROR, told.DELIMITER)
        else:
            self.overload(told.DELIMITER)
        return BUSY

    def _hear_intermission(self, level: int) -> int:
        """Process a bit of intermission: dominant is an overload, in the third a start of frame."""
        self._count += 1
        if self._count == INTERMISSION_BITS:
            return FREE if level == RECESSIVE else STARTED
        if level == DOMINANT:
            self.overload(told.INTERMISSION)
        return BUSY


@final
class CanStation:
    """A node's CAN controller, while it is on the bus. Call one `begin_...` method, then `hear`.

    Args:
        frames: its pending frames, in their order.
        confinement: its counters.
        one_shot: a frame that fails or loses arbitration is dropped.
        support: the frame formats that it tolerates and sends.

    Raises:
        ValueError: it has a frame that it cannot send.

    Attributes (read only):
        drives: the level it puts on the wire in the next bit.
        phase: its phase of the protocol.
        suspended: bits for which it may not start; counted down while the bus is idle.
        waits_for: consecutive recessive bits it still has to hear, while INTEGRATING.
        frames: the frames it still has to send.
        off_at: the bit that made it bus-off; -1: it is not.
        recessive_runs: runs of 11 recessive bits since then.
        recessive_bits: recessive bits since the last of these runs, or the last dominant bit.
        journal: its events.
    """

    def __init__(
        self,
        frames: list[bytes],
        confinement: Confinement,
        one_shot: bool = False,
        support: FrameSupport = FrameSupport.CLASSICAL,
    ) -> None:
        for frame in frames:
            if len(frame) == FD_FRAME_BYTES and support is not FrameSupport.FD:
                raise ValueError(f"a {support.value} CAN controller cannot send CAN FD frames")
            wire_frame(frame)
        self.frames = frames
        self.confinement = confinement
        self.journal: ErrorJournal = ErrorJournal(confinement)
        self.drives: int = RECESSIVE
        self.phase: int = IDLE
        self.suspended: int = 0
        self.waits_for: int = 0
        self.off_at: int = -1
        self.recessive_runs: int = 0
        self.recessive_bits: int = 0
        self._one_shot = one_shot
        self._signalling = CanSignalling(confinement, self.journal)
        self._support = support
        self._reception = Reception(support)
        self._wire: WireFrame | None = None
        self._expected = b""
        self._levels = b""
        self._position = 0  # of the next bit to send
        self._long_ack = False  # the second bit of the ACK slot of a CAN FD frame has passed

    def begin_idle(self, suspended: int = 0) -> None:
        """Begin idle, ready to hear a start of frame; sending is forbidden for `suspended` bits."""
        self.suspended = suspended
        self._become_idle()

    def begin_integrating(self, waits_for: int = INTEGRATION_BITS) -> None:
        """Begin listening only, until so many consecutive recessive bits are heard."""
        self.phase = INTEGRATING
        self.waits_for = waits_for

    def begin_stalled(self) -> None:
        """Begin after its own flag, having heard only dominant bits for long."""
        self.phase = SIGNALLING
        self._signalling.stall()

    def is_ready(self) -> bool:
        """Return whether other nodes need not wait for it: idle, integrating or off the bus."""
        if self.phase == SENDING:
            return not self._position
        return self.phase in (IDLE, INTEGRATING, OFF)

    def is_fast(self) -> bool:
        """Return whether the next bit of the frame it sends or hears is at the data rate."""
        if self.phase == SENDING:
            wire = self._wire
            return wire is not None and wire.fast_from <= self._position < wire.fast_to
        return self.phase == RECEIVING and self._reception.fast

    def is_after_flag(self) -> bool:
        """Return whether it waits for a recessive bit after its flag."""
        return self.phase == SIGNALLING and self._signalling.is_after_flag()

    def is_stalled(self) -> bool:
        """Return whether dominant bits cannot change its state any more."""
        return self.phase == SIGNALLING and self._signalling.is_stalled()

    def hear(self, level: int, bit: int) -> None:
        """Process the level sampled in bit number `bit` and set `drives` for the next bit."""
        phase = self.phase
        if phase == RECEIVING:
            meaning = self._reception.hear(level)
            if meaning:
                self.journal.bit = bit
                self._receive(meaning, level)
        elif phase == SENDING:
            position = self._position
            if level != self._expected[position]:
                self.journal.bit = bit
                self._differ(level)
                return
            position += 1
            self._position = position
            if position < len(self._levels):
                self.drives = self._levels[position]
            else:
                self.journal.bit = bit
                self._succeed()
        elif phase == SIGNALLING:
            self.journal.bit = bit
            self._signal(self._signalling.hear(level))
        elif phase == IDLE:
            self._hear_idle(level)
        elif phase == INTEGRATING:
            self.waits_for = self.waits_for - 1 if level else INTEGRATION_BITS
            if not self.waits_for:
                self._become_idle()
        else:
            self._hear_off(level)

    # --- its own frame

    def _start(self, position: int) -> None:
        """Send its first frame from this bit on."""
        frame = self.frames[0]
        if len(frame) == FD_FRAME_BYTES and self.confinement.is_passive():
            frame = frame[:5] + bytes([frame[5] | ESI]) + frame[6:]
        wire = wire_frame(frame)
        self.phase = SENDING
        self._signalling.transmitter = True
        self._wire = wire
        self._expected = wire.expected
        self._levels = wire.levels
        self._position = position
        self._long_ack = False
        self.drives = self._levels[position]

    def _differ(self, level: int) -> None:
        """Handle a level read back that differs from the one sent."""
        wire = self._wire
        assert wire is not None
        position = self._position
        place = wire.places[position]
        if wire.is_fd and not self._long_ack and place in (told.ACK_SLOT, told.ACK_DELIMITER):
            self._long_ack = True
            return
        if level == DOMINANT and position <= wire.arbitration_end:
            if not wire.stuffed[position]:
                self._lose(position)
                return
            now = self._signalling.error(told.STUFF_ERROR, place, counts=False)
        elif place == told.ACK_SLOT:
            now = self._signalling.error(0, place, unacknowledged=True)
        else:
            kind = told.BIT1_ERROR if level == DOMINANT else told.BIT0_ERROR
            now = self._signalling.error(kind, place)
        self._give_up(NOTE_FAILED)
        self._signal(now)

    def _give_up(self, note: int) -> None:
        """Record that its frame was not sent; drop the frame if it is one-shot."""
        self.journal.note(note, self.frames[0])
        if self._one_shot:
            self.frames.pop(0)

    def _lose(self, position: int) -> None:
        """Lose arbitration in this bit and receive the winner's frame."""
        levels = self._levels
        self._give_up(NOTE_LOST)
        self._hear_start()
        for number in range(1, position):
            self._reception.hear(levels[number])
        self._reception.hear(DOMINANT)

    def _succeed(self) -> None:
        """Finish its frame after the last bit."""
        self.journal.note(NOTE_SENT, self.frames.pop(0))
        self.confinement.sent()
        self.journal.note_state()
        self._signalling.intermission()
        self._signal(BUSY)

    # --- frames of other nodes

    def _hear_start(self) -> None:
        """Begin to receive another node's frame, with this bit as start of frame."""
        self.phase = RECEIVING
        self.drives = RECESSIVE
        self.suspended = 0
        self._signalling.transmitter = False
        self._reception = Reception(self._support)
        self._reception.hear(DOMINANT)

    def _receive(self, meaning: int, level: int) -> None:
        """Act on the meaning of a bit of a received frame."""
        signalling = self._signalling
        if meaning == ACK_NEXT:
            self.drives = DOMINANT
        elif meaning == ACKNOWLEDGED:
            self._acknowledge(level)
        elif meaning == ACCEPTED:
            self.journal.note(NOTE_ACCEPTED, self._reception.frame())
        elif meaning == COMPLETE:
            signalling.intermission()
            self._signal(BUSY)
        elif meaning == OVERLOAD:
            signalling.overload(told.END_OF_FRAME)
            self._signal(BUSY)
        elif meaning == EXCEPTION:
            self.begin_integrating()
        elif meaning == STUFF:
            self._signal(signalling.error(told.STUFF_ERROR, self._reception.place()))
        elif meaning == FORM:
            self._signal(signalling.error(told.FORM_ERROR, self._reception.place()))
        else:
            self._signal(signalling.error(0, told.CRC_SEQUENCE))

    def _acknowledge(self, level: int) -> None:
        """End the ACK slot of a received frame."""
        if self.drives == RECESSIVE:
            return
        self.drives = RECESSIVE
        if level == RECESSIVE:
            self._signal(self._signalling.error(told.BIT0_ERROR, told.ACK_SLOT))
            return
        self.confinement.received()
        self.journal.note_state()

    # --- between frames

    def _signal(self, now: int) -> None:
        """Act on the result of a bit between two frames."""
        if now == BUSY:
            self.phase = SIGNALLING
            self.drives = self._signalling.drives
            return
        if now == GONE:
            self.phase = OFF
            self.drives = RECESSIVE
            self.off_at = self.journal.bit
            return
        if self._signalling.transmitter and self.confinement.is_passive():
            self.suspended = SUSPEND_BITS
        if now == FREE:
            self._become_idle()
        elif self.frames and not self.suspended:
            self._start(1)  # another node sent the start of frame, one bit early
        else:
            self._hear_start()

    def _become_idle(self) -> None:
        self.phase = IDLE
        if self.frames and not self.suspended:
            self._start(0)

    def _hear_idle(self, level: int) -> None:
        if level == DOMINANT:
            self._hear_start()
        elif self.suspended:
            self.suspended -= 1
            if not self.suspended:
                self._become_idle()

    def _hear_off(self, level: int) -> None:
        """Count a bit while bus-off."""
        self.recessive_bits = self.recessive_bits + 1 if level else 0
        if self.recessive_bits == INTEGRATION_BITS:
            self.recessive_bits = 0
            self.recessive_runs += 1
