"""What can go wrong on a CAN bus, on purpose: which frames are hit, how, and how often.

What a receiver can notice is modelled, in CAN's own terms where it has them:

- DROP: the sender believes the frame sent; the ports hit do not hear it (with some ports: CAN's
  inconsistent omission).
- DELAY: the ports hit hear it later, as behind a gateway or a slow driver; others may overtake it.
- DUPLICATE: a stand-in for the error `last`, which takes its time and wears no counters out: the
  ports hit hear the frame, its sender sends it again once, after an error frame (15 bits) and a new
  arbitration. Who was not hit hears it once. It may strike each frame for ever, from all that ends
  in a window of time; by ERROR, 32 such failures in a row would take the sender off the bus.
- CORRUPT: the ports hit hear other data than were sent. No CRC catches it: it happened in a
  gateway's or a node's memory. (What the CRC catches is repeated by CAN itself: ERROR, NOISE.)
- CUT: ports are off the bus for a time, each alone on its stub: nobody acknowledges what it sends,
  and it sends again and again, until it is back.
- SPLIT: the ports named stay together, the others too: two buses, until the rule is over.
- ERROR: a bit of a frame is inverted, for all or for some ports: at `bit`, or where it makes the
  `error` wanted. What follows is CAN's own: error flags, counters, the frame sent again. `last`
  makes all others hear it twice; with ports, these refuse it first, and hear it once (CAN's
  inconsistent duplicate).
- NOISE: bits of frames are inverted at random, each with the probability `bit_error_rate`, on the
  wire or for each of some ports on its own.
- BABBLE: the sender named sends one frame again and again, whenever it may.
- SHORT: the wire is stuck at one level; of one in several parts, that with any of the ports, by
  default the one that all others have left.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from emulators.media.can_frame import EFF_FLAG, EFF_MASK
from emulators.media.rule_conditions import wrong_condition

DATA_MAX: Final = 8
RATE_MAX: Final = 0.1  # with more of them, error frames seldom end


class FaultKind(Enum):
    """What happens to a frame, or to a port."""

    DROP = "drop"
    DELAY = "delay"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    CUT = "cut"
    SPLIT = "split"
    ERROR = "error"
    NOISE = "noise"
    BABBLE = "babble"
    SHORT = "short"


class FrameError(Enum):
    """What a node finds wrong with a frame (ISO 11898-1, error detection)."""

    BIT = "bit"  # the sender reads another level than it sends
    STUFF = "stuff"  # the receivers read six equal bits
    FORM = "form"  # a delimiter is dominant
    CRC = "crc"  # the receivers compute another check sum
    ACK = "ack"  # the sender reads no acknowledgement
    LAST = "last"  # the sender reads another last bit; all others have accepted the frame by then


class WireLevel(Enum):
    """What a wire that is stuck reads as."""

    DOMINANT = "dominant"
    RECESSIVE = "recessive"


PARTING: Final = (FaultKind.CUT, FaultKind.SPLIT)
LASTING: Final = (*PARTING, FaultKind.NOISE, FaultKind.BABBLE, FaultKind.SHORT)


@final
@dataclass(frozen=True, slots=True)
class FaultRule:
    """Which frames are hit, and how. A rule without conditions hits every frame.

    Attributes:
        name: how records and counts call it; one of a kind in a plan.
        kind: what happens.
        identifier: hit frames whose can_id agrees with this one under `mask`; None: all.
        mask: the bits of can_id that must agree; by default the identifier and its format.
        sender: hit only frames of the port with this name; None: of all.
        ports: names of the receivers hit; empty: all. CUT: the ports that lose the bus.
        from_ns: hit frames that end at this time or later [ns].
        until_ns: hit frames that end before this time [ns]; None: no end.
        probability: of firing, for each frame that meets all conditions; 1.0 draws nothing.
        skip: so many frames that would be hit are spared first.
        limit: it fires no more often than this; None: no limit.
        delay_ns: DELAY: how much later the frame is heard [ns].
        flip: CORRUPT: the data bits that change, from the first byte on; empty: one bit, drawn.
        bit: ERROR: which bit, from the start of frame (0) on, stuff bits counted; frames that have
            it not, nor in the intermission behind them, are not hit. None: see error.
        error: ERROR: what is found wrong; None: see bit.
        bit_error_rate: NOISE: how likely a bit of a frame is to be inverted.
        data: BABBLE: of the frame with the `identifier` that its `sender` repeats.
        level: SHORT: what everybody reads.

    `from_ns` and `until_ns` of ERROR: hit frames that begin then; of CUT, SPLIT, NOISE, BABBLE and
    SHORT: when it begins and is over. `ports` of SPLIT: who stays together; of SHORT: who is
    on the part that is shorted; of ERROR and NOISE: who sees it, empty: it is on the wire.

    Raises:
        ValueError: values that make no sense, by name.
    """

    name: str
    kind: FaultKind
    identifier: int | None = None
    mask: int = EFF_FLAG | EFF_MASK
    sender: str | None = None
    ports: tuple[str, ...] = ()
    from_ns: int = 0
    until_ns: int | None = None
    probability: float = 1.0
    skip: int = 0
    limit: int | None = None
    delay_ns: int = 0
    flip: bytes = b""
    bit: int | None = None
    error: FrameError | None = None
    bit_error_rate: float = 0.0
    data: bytes = b""
    level: WireLevel | None = None

    def __post_init__(self) -> None:
        wrong = wrong_condition(
            self.probability, self.from_ns, self.until_ns, self.skip, self.limit
        )
        if wrong:
            self._refuse(wrong)
        if (self.delay_ns > 0) is not (self.kind is FaultKind.DELAY) or self.delay_ns < 0:
            self._refuse(f"delay_ns is {self.delay_ns}; a delay has one above 0, others have none")
        if self.flip and (self.kind is not FaultKind.CORRUPT or not any(self.flip)):
            self._refuse("flip is for corrupt, and has a bit set")
        if self.kind in PARTING and not self.ports:
            self._refuse(f"a {self.kind.value} names the ports that lose the bus")
        self._check_lasting()
        self._check_errors()

    def _check_lasting(self) -> None:
        babble = self.kind is FaultKind.BABBLE
        if self.kind in LASTING:
            conditional = (self.identifier is not None or self.sender is not None) and not babble
            if conditional or self.skip or self.limit is not None or self.probability < 1.0:
                self._refuse(f"a {self.kind.value} has no condition but its time")
        if babble and (self.identifier is None or self.sender is None):
            self._refuse("a babble names its sender and the identifier")
        if self.data and (not babble or len(self.data) > DATA_MAX):
            self._refuse(f"data is for babble, {DATA_MAX} bytes at most")
        if self.ports and babble:
            self._refuse("a babble is for all ports")

    def _check_errors(self) -> None:
        error = self.kind is FaultKind.ERROR
        if ((self.bit is None) is (self.error is None)) if error else (self.bit or self.error):
            self._refuse("an error has a bit or an error, not both; others have neither")
        if self.bit is not None and self.bit < 0:
            self._refuse(f"bit {self.bit} is below 0")
        rate = self.bit_error_rate
        if (rate > 0.0) is not (self.kind is FaultKind.NOISE) or not 0.0 <= rate <= RATE_MAX:
            self._refuse(
                f"bit_error_rate is {rate}; a noise has one above 0 and up to {RATE_MAX}, "
                "others have none"
            )
        if (self.level is None) is (self.kind is FaultKind.SHORT):
            self._refuse("level is for short, which has one")

    def _refuse(self, reason: str) -> None:
        raise ValueError(f"fault {self.name}: {reason}")

    def shorts(self, names: Sequence[str], is_main: bool) -> bool:
        """Whether a SHORT is on the part of the bus where these are, which all others have left."""
        return any(name in self.ports for name in names) if self.ports else is_main

    def is_met_by(self, can_id: int, sender: str, now_ns: int) -> bool:
        """Whether all conditions but chance and number hold."""
        return (
            now_ns >= self.from_ns
            and (self.until_ns is None or now_ns < self.until_ns)
            and (self.identifier is None or not (can_id ^ self.identifier) & self.mask)
            and (self.sender is None or self.sender == sender)
        )
