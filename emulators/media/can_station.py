"""A CAN controller at the bit level: levels driven and levels sampled.

Once per bit time the wire reads `drives` and calls `hear` with the sampled level. The station
implements framing, arbitration and acknowledgement. `Reception` decodes other nodes' frames,
`CanSignalling` handles errors and the time between frames, `Confinement` has the error counters.

Source: ISO 11898-1, medium access control; Bosch CAN 2.0, chapters 3 and 7.
"""

from typing import Final, final

from emulators.media import error_message as told
from emulators.media.can_frame import ESI, FD_FRAME_BYTES
from emulators.media.can_node import FrameSupport
from emulators.media.can_reception import (
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
from emulators.media.can_signalling import BUSY, FREE, GONE, CanSignalling
from emulators.media.can_wire import DOMINANT, RECESSIVE, WireFrame, wire_frame
from emulators.media.confinement import Confinement
from emulators.media.error_journal import (
    NOTE_ACCEPTED,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    ErrorJournal,
)

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
        self.journal = ErrorJournal(confinement)
        self.drives = RECESSIVE
        self.phase = IDLE
        self.suspended = 0
        self.waits_for = 0
        self.off_at = -1
        self.recessive_runs = 0
        self.recessive_bits = 0
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

    def is_signalling(self) -> bool:
        """Return whether it sends an error or overload frame, or is in intermission."""
        return self.phase == SIGNALLING

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
