"""Traffic on the buses of a rig: declared messages, and those of its controllers."""

from collections.abc import Mapping
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.bus_load import MESSAGES
from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    PeriodicMessage,
    worst_of,
)

_SFF_MAX: Final = 0x7FF
_BOOT_UP_S: Final = 1.0  # between two boots of a node without heartbeat
_HEARTBEAT_ID: Final = 0x700
_HEARTBEAT_TIME: Final = 0x1017
_SYNC_COB_ID: Final = 0x1005
_SYNC_PERIOD: Final = 0x1006
_SYNC_COUNTER: Final = 0x1019
_SENDS_SYNC: Final = 1 << 30


@final
@frozen
class Declared:
    """A declared message, with data that only the response-time analysis needs.

    Attributes:
        message: the message as motorapi uses it.
        deadline_s: largest permitted response time [s]; default: its period.
        sender: node in whose queue it waits; "" for a queue of its own.
    """

    message: PeriodicMessage
    deadline_s: float
    sender: str


def declared(description: RigDescription, bus: str) -> tuple[Declared, ...] | None:
    """Return the declared messages of others on a bus, or None if there is no declaration.

    Raises:
        RigError: the first error in them.
    """
    table = description.source.root().table("bus").table(bus)
    if not table.has("message"):
        return None
    with table.source.with_lines():
        tables = MESSAGES.read(table.values["message"], (*table.path, "message"))
    return tuple(
        Declared(
            one.message(),
            one.period_s if one.deadline_s is None else one.deadline_s,
            one.sender or "",
        )
        for one in tables
    )


def traffic_of(description: RigDescription, bus: str) -> CanTraffic | None:
    """Return a bus's traffic apart from what motors configure, or None if undeclared.

    A controller that no motor has configured contributes its boot-up message, and heartbeat and
    SYNC if its table enables them.
    """
    described = description.buses[bus]
    if described.messages is None:
        return None
    own = heartbeats(description, bus) + [sync for _, sync in syncs(description, bus)]
    return CanTraffic(
        described.bitrate_bit_s,
        worst_of([*described.messages, *own]),
        data_bitrate_bit_s=described.data_bitrate_bit_s,
    )


def heartbeats(description: RigDescription, bus: str) -> list[PeriodicMessage]:
    """Return the heartbeat and boot-up messages of a bus's unconfigured controllers."""
    return [
        PeriodicMessage(_HEARTBEAT_ID + node.node_id, 1, _heartbeat_s(node))
        for node in description.controllers.values()
        if node.bus == bus and node.node_id
    ]


def _heartbeat_s(controller: ControllerDescription) -> float:
    period_ms = _object(controller, _HEARTBEAT_TIME)
    return min(_BOOT_UP_S, period_ms / 1e3) if period_ms > 0 else _BOOT_UP_S


def syncs(description: RigDescription, bus: str) -> list[tuple[str, PeriodicMessage]]:
    """Return SYNC with its sender's name for controllers whose table enables it (CiA 301)."""
    found: list[tuple[str, PeriodicMessage]] = []
    for node in description.controllers.values():
        cob_id, period_us = _object(node, _SYNC_COB_ID), _object(node, _SYNC_PERIOD)
        if node.bus == bus and cob_id & _SENDS_SYNC and period_us > 0:
            length = 1 if _object(node, _SYNC_COUNTER) else 0
            message = PeriodicMessage(cob_id & _SFF_MAX, length, period_us / 1e6)
            found.append((node.name, message))
    return found


def _object(controller: ControllerDescription, index: int) -> int:
    """Return a power-on value that the controller's table sets, or 0."""
    objects = controller.settings.get("objects")
    if isinstance(objects, Mapping):
        for key in (f"{index:04X}h", f"{index:04X}"):
            value = objects.get(key)
            if isinstance(value, int):
                return value
    return 0
