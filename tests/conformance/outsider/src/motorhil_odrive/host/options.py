"""Options of the host for one ODrive."""

from dataclasses import dataclass
from math import isfinite
from typing import final

from motorhil.motorapi.errors import UsageError


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class OdriveOptions:
    """The settings of a hardware object; in a rig, keys of the motor's table.

    Attributes:
        heartbeat_timeout_ms: without a heartbeat for this time the drive is lost.
        watchdog_feed_ms: the period of feeding the drive's watchdog, by the last commander.
        estimate_period_ms: the configured period of the drive's encoder estimates.
        stream_period_ms: between two streamed set-points of velocity or torque.
        connect_timeout_s: allows for a drive that is still booting.
        velocity_window: share of velocity_max within which a velocity set-point is reached.
        position_window_rev: distance from the target, in motor turns, within which a motion ends.

    Raises:
        UsageError: a value is not > 0.
    """

    heartbeat_timeout_ms: float = 300.0
    watchdog_feed_ms: float = 50.0
    estimate_period_ms: float = 10.0
    stream_period_ms: float = 5.0
    connect_timeout_s: float = 3.0
    velocity_window: float = 0.02
    position_window_rev: float = 0.01

    def __post_init__(self) -> None:
        """Raise UsageError for invalid values."""
        for name in self.__slots__:
            value = getattr(self, name)
            if not isfinite(value) or value <= 0.0:
                raise UsageError(f"{name} = {value!r}: must be > 0")
