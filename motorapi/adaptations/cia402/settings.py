"""Settings of the host for a CiA 402 drive."""

from dataclasses import dataclass
from typing import Any, final

from motorhil.motorapi.adaptations.registration import Options
from motorhil.settings import REQUIRED, SettingError, number, text, whole

_TIMEOUT_MAX_S = 3600


def period_ms(default_ms: int, doc: str, low: int = 0, high: int = 65535) -> Any:
    """Declare a period that an object of CiA 301 or CiA 402 holds in milliseconds."""
    return whole(default_ms, low, high, "ms", doc)


def timeout_s(default_s: float, doc: str) -> Any:
    """Declare a timeout."""
    return number(default_s, 0, _TIMEOUT_MAX_S, "s", doc, above=True)


def _known(high: float, unit: str, doc: str) -> Any:
    return number(None, 0, high, unit, f"{doc}, for predicting skew; absent: not known.")


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions(Options):
    """Settings of the host for any CANopen node."""

    host_node_id: int = whole(127, 1, 127, "", "Node-ID of the host's heartbeat.")
    heartbeat_ms: int = period_ms(100, "Period of both heartbeats (1017h); 0: no heartbeats.")
    heartbeat_timeout_ms: int = period_ms(
        300, "Silence after which either side regards the other as lost (1016h)."
    )
    status_period_ms: int = period_ms(
        20, "Period of statusword and position, or of digital inputs; 0: on change only."
    )
    connect_timeout_s: float = timeout_s(3.0, "Longest time for the node to boot.")
    sdo_timeout_s: float = timeout_s(0.3, "Longest time for an SDO response.")
    sdo_quarantine_s: float = timeout_s(
        1.0, "Time after an unanswered request in which a late response may still arrive."
    )

    def check_together(self) -> None:
        """Refuse a heartbeat timeout within the period."""
        if 0 < self.heartbeat_timeout_ms <= self.heartbeat_ms:
            message = f"{self.heartbeat_timeout_ms} ms is not longer than heartbeat_ms ="
            raise SettingError(
                ("heartbeat_timeout_ms",),
                f"{message} {self.heartbeat_ms} ms",
                "better three times as long",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class HwOptions(LinkOptions):
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
