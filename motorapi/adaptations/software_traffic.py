"""Traffic of a configured I/O node, and of this program for it."""

from typing import TYPE_CHECKING, Final

from motorapi.adaptations.canopen_link import HEARTBEAT_ID
from motorapi.traffic import NodeTraffic, PeriodicMessage

if TYPE_CHECKING:
    from motorapi.adaptations.pdo_setup import PdoFound
    from motorapi.adaptations.software_options import IoFacts, IoOptions

_SHORTER: Final = 0.999  # a fast oscillator shortens the node's times
_OUTPUT_BYTES: Final = 4
_COUNT_BYTES: Final = 8


def node_traffic(
    node_id: int, facts: "IoFacts", inputs: "tuple[int, PdoFound]", options: "IoOptions"
) -> NodeTraffic:
    """Return the traffic of a node; `inputs`: (identifier, TPDO) of its digital inputs."""
    sent: list[PeriodicMessage] = []
    ours: tuple[PeriodicMessage, ...] = ()
    unknown = ""
    can_id, tpdo = inputs
    if tpdo.inhibit_100us:
        sent.append(PeriodicMessage(can_id, 1, tpdo.inhibit_100us * 1e-4 * _SHORTER))
    else:
        unknown = f"TPDO {can_id:03X}h of node {node_id} has no inhibit time"
    if options.heartbeat_ms:
        period_s = options.heartbeat_ms / 1e3
        sent.append(PeriodicMessage(HEARTBEAT_ID + node_id, 1, period_s * _SHORTER))
        ours = (PeriodicMessage(HEARTBEAT_ID + options.host_node_id, 1, period_s),)
    return NodeTraffic(
        sent=tuple(sent),
        ours=ours,
        sent_at_sync=tuple(
            PeriodicMessage(back, _COUNT_BYTES, 1.0, 1.0) for _, back in facts.pairs
        ),
        ours_at_sync=tuple(PeriodicMessage(out, _OUTPUT_BYTES, 1.0, 1.0) for out, _ in facts.pairs),
        unknown=unknown,
    )
