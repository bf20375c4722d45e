"""Options of an I/O node with amplifiers, and its bring-up results."""

from dataclasses import dataclass
from typing import final

from motorapi.adaptations.drive_setup import HwOptions
from motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class IoOptions:
    """The settings of the host for an I/O node, shared by all motors on its channels.

    Attributes:
        cycle_ms: the period of the servo, and of SYNC.
        misses_max: the number of consecutive missed cycles that stops a motor.
        counter: the index of the object with the counters; 6820h: CiA 406 beside CiA 401.
        host_node_id: the node-ID of the host's heartbeat, sent since the first motor was enabled.
            It must differ from the one that drives watch: another process may send that heartbeat
            as well, and the death of a servo would not be detected.
        heartbeat_ms, heartbeat_timeout_ms, connect_timeout_s, sdo_timeout_s, sdo_quarantine_s: as
            in HwOptions.
        status_period_ms: the period with which the node sends its digital inputs; 0: on change
            only.
        amplifier_tick_ms: the period with which an amplifier samples its input, for predicting
            skew; None: not known.
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
        """Refuse invalid options.

        Raises:
            UsageError: an option has the wrong type or is out of range.
        """
        if not isinstance(self.cycle_ms, int | float) or not 0.1 <= self.cycle_ms <= 1000.0:
            raise UsageError(f"cycle_ms = {self.cycle_ms!r}: must be 0.1 to 1000 ms")
        if not isinstance(self.misses_max, int) or not 1 <= self.misses_max <= 1_000_000:
            raise UsageError(f"misses_max = {self.misses_max!r}: must be an integer >= 1")
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
    """The results of the bring-up of a node.

    Attributes:
        channels: the number of channels that have both an analogue output and a counter.
        enable_id: the identifier of the RPDO with the digital outputs.
        pairs: the identifiers of (RPDO, TPDO) of channels 1 and 2, and of 3 and 4.
        boot: the number of the boot-up.
        limitations: the functions that this node lacks or refuses, in words.
    """

    channels: int
    enable_id: int
    pairs: tuple[tuple[int, int], ...]
    boot: int
    limitations: tuple[str, ...]
