"""The traffic on a link's bus: declared, and of this program and its drives."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from motorhil.motorapi.locking.process_lock import can_share_time
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    PeriodicMessage,
    declared_traffic,
    own_traffic,
    streams,
)
from motorhil.motorapi.synchronization.firing_time import overload_of

if TYPE_CHECKING:
    from motorhil.motorapi.runtime.can_link import CanLink


def traffic_on(
    link: "CanLink",
    sync_period_s: float | None = None,
    streamed: Sequence[PeriodicMessage] = (),
) -> tuple[CanTraffic | None, str]:
    """Return all frames that may be sent on a bus, or None and the reason why they are unknown.

    Args:
        link: the link of the bus.
        sync_period_s: the period of a SYNC that runs or is about to [s], or None.
        streamed: set-points that are about to be sent.
    """
    if can_share_time(link.runtime):
        return None, "on the wall clock the delays of this program have no bound"
    declared = declared_traffic(link.bus)
    if declared is None:
        return None, f"the other traffic on {link.name} is not declared (declare_traffic)"
    own = own_traffic(link.bus)
    unknown = next((one.unknown for one in own if one.unknown), "")
    if unknown:
        return None, f"the traffic on {link.name} has no bound: {unknown}"
    traffic = declared.with_own(own, sync_period_s, (*streams(link.bus), *streamed))
    overload = overload_of(traffic)
    if overload:
        return None, f"{link.name} is too full: {overload}"
    return traffic, ""
