"""What may be set of an I/O node with amplifiers, and what is found when it is brought up."""

from dataclasses import dataclass
from typing import final

from motorapi.adaptations.drive_setup import HwOptions
from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class IoOptions:
    """How the host treats an I/O node; all motors on its channels share them.

    Attributes:
        cycle_ms: period of the servo, and of SYNC.
        misses_max: so many missed cycles in a row stop a motor.
        counter: index of the object with the counters; 6820h: CiA 406 beside CiA 401.
        host_node_id: under which the host sends its heartbeat, from the first motor's being enabled
            on. Not the one that drives are watched by: another process may send that one as well,
            and then nobody would miss a servo that died.
        heartbeat_ms, heartbeat_timeout_ms, connect_timeout_s, sdo_timeout_s, sdo_quarantine_s: as
            in HwOptions.
        status_period_ms: the node repeats its digital inputs so often; 0: on change only.
        amplifier_tick_ms: an amplifier looks at its input so often, for predicting skew; None: not
            known.
    """

    cycle_ms: float = 1.0
    misses_max: int = 10
    counter: int = 0x6820
    host_node_id: int = 126
    heartbeat_ms: int = 100
    heartbeat_timeout_ms: int = 300
    status_period_ms: int = 20
    connect_timeout_s: float = 3.0
    sdo_timeout_s: float = 0.3
    sdo_quarantine_s: float = 1.0
    amplifier_tick_ms: float | None = None

    def __post_init__(self) -> None:
        """Refuse what no node can be told.

        Raises:
            UsageError: an option has the wrong type or is out of range.
        """
        if not isinstance(self.cycle_ms, int | float) or not 0.1 <= self.cycle_ms <= 1000.0:
            raise UsageError(f"cycle_ms = {self.cycle_ms!r}: must be 0.1 to 1000 ms")
        if not isinstance(self.misses_max, int) or not 1 <= self.misses_max <= 1_000_000:
            raise UsageError(f"misses_max = {self.misses_max!r}: must be a whole number >= 1")
        if not isinstance(self.counter, int) or not 0x2000 <= self.counter <= 0x9FFF:
            raise UsageError(f"counter = {self.counter!r}: must be an index, 2000h to 9FFFh")
        tick_ms = self.amplifier_tick_ms
        if tick_ms is not None and not (isinstance(tick_ms, int | float) and 0 <= tick_ms <= 1000):
            raise UsageError(f"amplifier_tick_ms = {tick_ms!r}: must be 0 to 1000 ms")
        HwOptions(
            host_node_id=self.host_node_id,
            heartbeat_ms=self.heartbeat_ms,
            heartbeat_timeout_ms=self.heartbeat_timeout_ms,
            status_period_ms=self.status_period_ms,
            connect_timeout_s=self.connect_timeout_s,
            sdo_timeout_s=self.sdo_timeout_s,
            sdo_quarantine_s=self.sdo_quarantine_s,
        )


@final
@dataclass(frozen=True, slots=True)
class IoFacts:
    """What was found and agreed when the node was brought up.

    Attributes:
        channels: how many have both an analogue output and a counter.
        enable_id: identifier of the RPDO with the digital outputs.
        pairs: identifiers of (RPDO, TPDO) of channels 1 and 2, and of 3 and 4.
        boot: which boot of the node it was.
        limitations: what this node cannot do for us, in words.
    """

    channels: int
    enable_id: int
    pairs: tuple[tuple[int, int], ...]
    boot: int
    limitations: tuple[str, ...]
