"""Known traffic on a link's bus, and the delay of SYNC."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.locking.process_lock import can_share_time
from motorhil.motorapi.synchronization.bus_load import (
    SYNC_ID,
    CanTraffic,
    PeriodicMessage,
    declared_traffic,
    own_traffic,
    streams,
)
from motorhil.motorapi.synchronization.firing_time import longest_s, overload_of
from motorhil.motorapi.synchronization.offer import Firing, OneFrame

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.canopen.sync import BusSync
    from motorhil.motorapi.runtime.can_link import CanLink

SYNC: Final = OneFrame(SYNC_ID, 0)
FULL: Final = "more urgent or already queued frames may delay SYNC without limit"


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


def sync_period(sync: "BusSync") -> tuple[float | None, str]:
    """Return the period [s] of a SYNC that runs, or will once a servo here is enabled, or None.

    The second value names the producer of that SYNC.
    """
    cyclic = sync.cyclic()
    if cyclic is not None:
        return cyclic.period_ns / 1e9, str(cyclic)
    period_s = sync.planned_s
    if period_s is not None:
        return period_s, f"SYNC every {period_s * 1e3:g} ms belongs to servos of this program"
    return None, ""


def period_on_wire_s(
    link: "CanLink", traffic: CanTraffic, period_s: float
) -> tuple[float, float] | None:
    """Return the shortest and longest time [s] between two SYNCs, as each may wait for the bus."""
    waits_s = longest_s([Firing(link.name, traffic, (SYNC,))])
    return None if waits_s is None else (period_s - waits_s, period_s + waits_s)
