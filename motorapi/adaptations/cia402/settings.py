"""Settings of the host for a CiA 402 drive."""

from dataclasses import dataclass
from typing import Any, final

from motorhil.motorapi.adaptations.canopen.settings import NodeOptions, period_ms
from motorhil.settings import REQUIRED, number, text, whole


def _known(high: float, unit: str, doc: str) -> Any:
    return number(None, 0, high, unit, f"{doc}, for predicting skew; absent: not known.")


@dataclass(frozen=True, slots=True, kw_only=True)
class HwOptions(NodeOptions):
    """Settings of a hardware object for its drive; the defaults suit most drives."""

    status_inhibit_ms: float = number(
        2.0, 0, 6553.5, "ms", "Shortest time between two of these messages (1800h:03h)."
    )
    velocity_period_ms: int = period_ms(
        0, "Period with which the drive sends velocity and torque; 0: they are polled."
    )
    connection_loss: int | None = number(
        3,
        -32768,
        3,
        "",
        "Reaction of the drive to the loss of the host (6007h): 1 fault, 2 disable voltage, 3"
        " quick stop; below 0 vendor-specific.",
        is_whole=True,
        or_none=True,
    )
    servo_period_ms: float | None = _known(1000.0, "ms", "Profile tick of the drive")
    oscillator_ppm: float | None = _known(100_000.0, "ppm", "Clock tolerance, either way")
    sdo_reply_ms: float | None = _known(60_000.0, "ms", "Longest SDO response time of the drive")
    set_point_period_ms: int = period_ms(
        5, "Period of streamed set-points (60C2h); the same for all drives of a bus.", 1, 255
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Cia402Table(HwOptions):
    """A motor behind a CiA 402 drive."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Node-ID of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
