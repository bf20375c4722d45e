"""Known traffic on a link's bus, and the delay of SYNC."""

from typing import TYPE_CHECKING, Final

from motorhil.motorapi.synchronization.bus_load import (
    SYNC_ID,
    CanTraffic,
)
from motorhil.motorapi.synchronization.firing_time import longest_s
from motorhil.motorapi.synchronization.offer import Firing, OneFrame

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.canopen.sync import BusSync
    from motorhil.motorapi.runtime.can_link import CanLink

SYNC: Final = OneFrame(SYNC_ID, 0)
FULL: Final = "more urgent or already queued frames may delay SYNC without limit"


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
