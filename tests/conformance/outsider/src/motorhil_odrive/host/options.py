"""Options of the host for one ODrive."""

from dataclasses import dataclass
from typing import final

from motorhil.motorapi.api import REQUIRED, Options, positive, text, whole


@dataclass(frozen=True, slots=True, kw_only=True)
class OdriveOptions(Options):
    """The settings of a hardware object; in a rig, keys of the motor's table.

    Raises:
        UsageError: a value is not > 0.
    """

    heartbeat_timeout_ms: float = positive(
        300.0, "ms", "Time without a heartbeat after which the drive is lost."
    )
    watchdog_feed_ms: float = positive(
        50.0, "ms", "Period of feeding the drive's watchdog, by the last commander."
    )
    estimate_period_ms: float = positive(
        10.0, "ms", "Configured period of the drive's encoder estimates."
    )
    stream_period_ms: float = positive(
        5.0, "ms", "Period of streamed set-points of velocity or torque."
    )
    connect_timeout_s: float = positive(3.0, "s", "Time for a drive that is still booting.")
    velocity_window: float = positive(
        0.02, "", "Share of velocity_max within which a velocity set-point is reached."
    )
    position_window_rev: float = positive(
        0.01, "rev", "Distance from the target, in motor turns, within which a motion ends."
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class OdriveMotorTable(OdriveOptions):
    """A motor behind an ODrive."""

    node_id: int = whole(REQUIRED, 0, 62, "", "Node-ID of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
