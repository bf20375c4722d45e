"""CAN signalling outside of frames: error and overload frames, intermission.

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

Source: ISO 11898-1, medium access control; Bosch CAN 2.0, chapters 3 and 7.
"""

from typing import Final, final

from emulators.media import error_message as told
from emulators.media.can_wire import DOMINANT, RECESSIVE
from emulators.media.confinement import REC_MAX, Confinement
from emulators.media.error_journal import ErrorJournal

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


@final
class CanSignalling:
    """A node between two frames; `error`, `overload` or `intermission` begins it.

    Attributes (read only):
        drives: the level it puts on the wire in the next bit.
        transmitter: it sent the frame before (set by the caller that begins a phase).
    """

    def __init__(self, confinement: Confinement, journal: ErrorJournal) -> None:
        self.drives = RECESSIVE
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
