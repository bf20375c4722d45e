"""Traffic of a configured drive, and of this program for it."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from motorapi.adaptations.canopen_link import HEARTBEAT_ID
from motorapi.adaptations.pdo_setup import PdoFound
from motorapi.traffic import NodeTraffic, PeriodicMessage

if TYPE_CHECKING:
    from motorapi.adaptations.drive_setup import DriveFacts, HwOptions

_UNKNOWN_CLOCK_PPM: Final = 1000.0
_SYNCHRONOUS_MAX: Final = 240


def drive_traffic(
    node_id: int,
    facts: "DriveFacts",
    tpdos: "Sequence[tuple[int, PdoFound]]",
    options: "HwOptions",
) -> NodeTraffic:
    """Return the traffic of a drive that has these TPDOs (identifier, settings) and no others."""
    ppm = _UNKNOWN_CLOCK_PPM if options.oscillator_ppm is None else options.oscillator_ppm
    shorter = 1.0 - ppm * 1e-6  # a fast oscillator shortens the drive's times
    sent: list[PeriodicMessage] = []
    at_sync: list[PeriodicMessage] = []
    unknown = "; ".join(one for one in facts.limitations if "stays on" in one)
    for can_id, tpdo in tpdos:
        length = sum(entry & 0xFF for entry in tpdo.mapping) // 8
        if tpdo.transmission <= _SYNCHRONOUS_MAX:
            at_sync.append(PeriodicMessage(can_id, length, 1.0, 1.0))
        elif tpdo.inhibit_100us:
            sent.append(PeriodicMessage(can_id, length, tpdo.inhibit_100us * 1e-4 * shorter))
        else:
            unknown = f"TPDO {can_id:03X}h of node {node_id} has no inhibit time"
    ours: tuple[PeriodicMessage, ...] = ()
    if options.heartbeat_ms:
        period_s = options.heartbeat_ms / 1e3
        sent.append(PeriodicMessage(HEARTBEAT_ID + node_id, 1, period_s * shorter))
        ours = (PeriodicMessage(HEARTBEAT_ID + options.host_node_id, 1, period_s),)
    return NodeTraffic(
        sent=tuple(sent),
        ours=ours,
        sent_at_sync=tuple(at_sync),
        unknown=unknown,
    )
