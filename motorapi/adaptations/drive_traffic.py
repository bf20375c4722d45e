"""What a drive sends once it was brought up, and this program for it; and what its bus carries."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from motorapi.adaptations.pdo_setup import PdoFound
from motorapi.bus_timing import overload_of
from motorapi.process_lock import can_share_time
from motorapi.traffic import (
    CanTraffic,
    NodeTraffic,
    PeriodicMessage,
    declared_traffic,
    own_traffic,
)

if TYPE_CHECKING:
    from motorapi.adaptations.canopen_link import CanopenLink
    from motorapi.adaptations.drive_setup import DriveFacts, HwOptions

_HEARTBEAT_ID: Final = 0x700
_UNKNOWN_CLOCK_PPM: Final = 1000.0
_SYNCHRONOUS_MAX: Final = 240


def drive_traffic(
    node_id: int,
    facts: "DriveFacts",
    tpdos: "Sequence[tuple[int, PdoFound]]",
    options: "HwOptions",
) -> NodeTraffic:
    """Of a drive whose TPDOs (identifier, as it has them) are these, and no others."""
    ppm = _UNKNOWN_CLOCK_PPM if options.oscillator_ppm is None else options.oscillator_ppm
    shorter = 1.0 - ppm * 1e-6  # what the drive times, it may time so much too short
    sent: list[PeriodicMessage] = []
    at_sync: list[PeriodicMessage] = []
    unknown = "; ".join(one for one in facts.limitations if "stays on" in one)
    for can_id, tpdo in tpdos:
        length = sum(entry & 0xFF for entry in tpdo.mapping) // 8
        if tpdo.transmission <= _SYNCHRONOUS_MAX:
            at_sync.append(PeriodicMessage(can_id, length, 1.0))
        elif tpdo.inhibit_100us:
            sent.append(PeriodicMessage(can_id, length, tpdo.inhibit_100us * 1e-4 * shorter))
        else:
            unknown = f"TPDO {can_id:03X}h of node {node_id} has no inhibit time"
    ours: tuple[PeriodicMessage, ...] = ()
    if options.heartbeat_ms:
        period_s = options.heartbeat_ms / 1e3
        sent.append(PeriodicMessage(_HEARTBEAT_ID + node_id, 1, period_s * shorter))
        ours = (PeriodicMessage(_HEARTBEAT_ID + options.host_node_id, 1, period_s),)
    streamed = facts.latched_ids.get(0x607A)
    return NodeTraffic(
        sent=tuple(sent),
        ours=ours,
        sent_at_sync=tuple(at_sync),
        ours_at_sync=() if streamed is None else (PeriodicMessage(streamed, 6, 1.0),),
        unknown=unknown,
    )


def traffic_on(
    link: "CanopenLink", sync_period_s: float | None = None
) -> tuple[CanTraffic | None, str]:
    """All that may be sent on a bus; or None, and why nobody can tell.

    Args:
        link: of the bus.
        sync_period_s: of a SYNC that runs or is about to; None: there is none.
    """
    if can_share_time(link.runtime):
        return None, "on the wall clock nothing promises when this program goes on"
    declared = declared_traffic(link.bus)
    if declared is None:
        return None, f"what else is sent on {link.name} is not declared (declare_traffic)"
    own = own_traffic(link.bus)
    unknown = next((one.unknown for one in own if one.unknown), "")
    if unknown:
        return None, f"what is sent on {link.name} has no bound: {unknown}"
    traffic = declared.with_own(own, sync_period_s)
    overload = overload_of(traffic)
    if overload:
        return None, f"{link.name} is too full: {overload}"
    return traffic, ""
