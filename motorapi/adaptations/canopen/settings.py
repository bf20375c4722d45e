"""Settings of the host for any CANopen node."""

from typing import Any

from motorhil.frozen import frozen
from motorhil.motorapi.api.registration import Options
from motorhil.settings import SettingError, number, whole

_TIMEOUT_MAX_S = 3600


def period_ms(default_ms: int, doc: str, low: int = 0, high: int = 65535) -> Any:
    """Declare a period that an object of CiA 301 or CiA 402 holds in milliseconds."""
    return whole(default_ms, low, high, "ms", doc, plausible=(1, min(high, 60_000)))


def timeout_s(default_s: float, doc: str) -> Any:
    """Declare a timeout."""
    return number(default_s, 0, _TIMEOUT_MAX_S, "s", doc, above=True, plausible=(1e-3, 60.0))


@frozen(kw_only=True)
class NodeOptions(Options):
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
