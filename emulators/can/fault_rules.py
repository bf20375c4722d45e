"""Fault rules of a CAN bus: frames hit, effects and conditions.

Faults are modelled by their effect on a receiver, in CAN's own terms where these exist:
- DROP: the sender believes the frame sent, but the ports hit do not hear it (with some ports: CAN's
  inconsistent omission).
- DELAY: the ports hit hear it later, as behind a gateway or a slow driver. Others may overtake it.
- DUPLICATE: a substitute for the error `last` that takes the same time but changes no counters. The
  ports hit hear the frame, and its sender sends it again once, after an error frame (15 bits) and a
  new arbitration. Ports not hit hear it once. The rule may strike every frame that ends in a window
  of time; 32 such failures in a row by ERROR would take the sender off the bus.
- CORRUPT: the ports hit hear other data than were sent, which no CRC detects: the change happened
  in a gateway's or a node's memory. (CAN itself repeats what the CRC detects: ERROR, NOISE.)
- CUT: ports are off the bus for a time, each alone on its stub. Without an acknowledgement each
  sends its frame again and again until it is back.
- SPLIT: the ports named stay together, the others too: two buses, until the rule ends.
- ERROR: a bit of a frame is inverted, for all or for some ports, at `bit`, or where it causes the
  wanted `error`. CAN's own reaction follows: error flags, counters, repetition of the frame. `last`
  makes all others hear it twice. With ports, these refuse it first, and hear it once (CAN's
  inconsistent duplicate).
- NOISE: bits of frames are inverted at random, each with the probability `bit_error_rate`, on the
  wire or for each of some ports independently.
- BABBLE: the sender named sends one frame again and again, whenever it may.
- SHORT: the wire is stuck at one level. On a split bus this is the part with any of the ports, by
  default the part that all others have left.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final, final

from motorhil.emulators.can.frame import EFF_FLAG, EFF_MASK
from motorhil.emulators.media.serial_faults import wrong_condition

DATA_MAX: Final = 8
RATE_MAX: Final = 0.1  # above this, error frames seldom end

_DOUBLINGS: Final = 48  # distances up to 2**48 bits, beyond the life of a bus


class FaultKind(Enum):
    """The effect of a rule on a frame, or on a port."""

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
    """The error that a node detects in a frame (ISO 11898-1, error detection)."""

    BIT = "bit"  # the sender reads another level than it sends
    STUFF = "stuff"  # the receivers read six equal bits
    FORM = "form"  # a delimiter is dominant
    CRC = "crc"  # the receivers compute another checksum
    ACK = "ack"  # the sender reads no acknowledgement
    LAST = "last"  # the sender reads another last bit; all others have accepted the frame before


class WireLevel(Enum):
    """The level of a stuck wire."""

    DOMINANT = "dominant"
    RECESSIVE = "recessive"


PARTING: Final = (FaultKind.CUT, FaultKind.SPLIT)
LASTING: Final = (*PARTING, FaultKind.NOISE, FaultKind.BABBLE, FaultKind.SHORT)


@final
@dataclass(frozen=True, slots=True)
class FaultRule:
    """A fault rule: the frames hit and the effect. A rule without conditions hits every frame.

    Attributes:
        name: the name in records and counts; unique in a plan.
        kind: the effect.
        identifier: hit frames whose can_id agrees with this one under `mask`; None: all.
        mask: the bits of can_id that must agree; by default the identifier and its format.
        sender: hit only frames of the port with this name; None: of all.
        ports: names of the receivers hit; empty: all. CUT: the ports that lose the bus.
        from_ns: hit frames that end at this time or later [ns].
        until_ns: hit frames that end before this time [ns]; None: no end.
        probability: of firing, for each frame that meets all conditions; 1.0 draws nothing.
        skip: number of frames to spare before the first hit.
        limit: maximum number of firings; None: no limit.
        delay_ns: DELAY: how much later the frame is heard [ns].
        flip: CORRUPT: the data bits that change, from the first byte on; empty: one bit, drawn.
        bit: ERROR: the number of the bit, from the start of frame (0) on, stuff bits counted.
            Frames without this bit, intermission included, are not hit. None: see error.
        error: ERROR: the error to cause; None: see bit.
        bit_error_rate: NOISE: the probability that a bit of a frame is inverted.
        data: BABBLE: of the frame with the `identifier` that its `sender` repeats.
        level: SHORT: the level that all nodes read.

    `from_ns` and `until_ns` of ERROR: hit frames that begin then; of CUT, SPLIT, NOISE, BABBLE and
    SHORT: the beginning and end of the rule. `ports` of SPLIT: the ports that stay together; of
    SHORT: ports on the part that is shorted; of ERROR and NOISE: the ports that see it, empty: it
    is on the wire.

    Raises:
        ValueError: invalid values; the message names them.
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
            self._refuse(
                f"delay_ns {self.delay_ns}: invalid; expected above 0 for delay, 0 for other kinds"
            )
        if self.flip and (self.kind is not FaultKind.CORRUPT or not any(self.flip)):
            self._refuse("flip: invalid; only corrupt has it, with at least one bit set")
        if self.kind in PARTING and not self.ports:
            self._refuse(f"{self.kind.value}: no ports; expected the ports that lose the bus")
        self._check_lasting()
        self._check_errors()

    def _check_lasting(self) -> None:
        babble = self.kind is FaultKind.BABBLE
        if self.kind in LASTING:
            conditional = (self.identifier is not None or self.sender is not None) and not babble
            if conditional or self.skip or self.limit is not None or self.probability < 1.0:
                self._refuse(
                    f"{self.kind.value}: invalid condition; only from_ns and until_ns apply to it"
                )
        if babble and (self.identifier is None or self.sender is None):
            self._refuse("babble: sender or identifier missing; expected both")
        if self.data and (not babble or len(self.data) > DATA_MAX):
            self._refuse(f"data: invalid; only babble has it, {DATA_MAX} bytes at most")
        if self.ports and babble:
            self._refuse("babble: ports not allowed; it is for all ports")

    def _check_errors(self) -> None:
        error = self.kind is FaultKind.ERROR
        if ((self.bit is None) is (self.error is None)) if error else (self.bit or self.error):
            self._refuse("error has either bit or error, not both; other kinds have neither")
        if self.bit is not None and self.bit < 0:
            self._refuse(f"bit {self.bit}: invalid; expected 0 or more")
        rate = self.bit_error_rate
        if (rate > 0.0) is not (self.kind is FaultKind.NOISE) or not 0.0 <= rate <= RATE_MAX:
            self._refuse(
                f"bit_error_rate {rate}: invalid; expected above 0 and up to {RATE_MAX} for "
                "noise, 0 for other kinds"
            )
        if (self.level is None) is (self.kind is FaultKind.SHORT):
            self._refuse("level: invalid; short requires it, other kinds do not have it")

    def _refuse(self, reason: str) -> None:
        raise ValueError(f"fault {self.name}: {reason}")

    def shorts(self, names: Sequence[str], is_main: bool) -> bool:
        """Return whether a SHORT is on the part of the bus with these ports.

        Args:
            names: the ports on the part.
            is_main: all other parts have left this one.
        """
        return any(name in self.ports for name in names) if self.ports else is_main

    def is_met_by(self, can_id: int, sender: str, now_ns: int) -> bool:
        """Return whether all conditions but probability, skip and limit hold."""
        return (
            now_ns >= self.from_ns
            and (self.until_ns is None or now_ns < self.until_ns)
            and (self.identifier is None or not (can_id ^ self.identifier) & self.mask)
            and (self.sender is None or self.sender == sender)
        )


@final
class NoiseSource:
    """A stream of inverted bits, with one draw per inverted bit.

    The computation uses products alone, so that all machines get equal results.

    Attributes (read only):
        rule: its NOISE rule.
        ports: mask of the ports that see its bits; ALL_PORTS: the wire.
        left: bits of frames before the next inverted one.
    """

    def __init__(self, rule: FaultRule, ports: int, draw: Callable[[], float]) -> None:
        self.rule = rule
        self.ports = ports
        self._draw = draw
        self._spared = [1.0 - rule.bit_error_rate]  # probability that 1, 2, 4, ... bits are spared
        for _ in range(_DOUBLINGS - 1):
            self._spared.append(self._spared[-1] * self._spared[-1])
        self._gaps: list[int] = []  # between inverted bits that were looked at already
        self.left: int = self._distance()

    def pass_by(self, bits: int) -> None:
        """Advance by this many bits."""
        while self.left < bits:
            self.left += 1 + (self._gaps.pop(0) if self._gaps else self._distance())
        self.left -= bits

    def within(self, bits: int) -> list[int]:
        """Return the numbers of the inverted bits among the next bits."""
        places: list[int] = []
        place = self.left
        while place < bits:
            if len(places) == len(self._gaps):
                self._gaps.append(self._distance())
            places.append(place)
            place += 1 + self._gaps[len(places) - 1]
        return places

    def _distance(self) -> int:
        """Draw the number of spared bits: at least n with probability (1 - rate) ** n."""
        chance = self._draw()
        bits = 0
        spared = 1.0
        for doubling in range(_DOUBLINGS - 1, -1, -1):
            if spared * self._spared[doubling] > chance:
                spared *= self._spared[doubling]
                bits += 1 << doubling
        return bits
