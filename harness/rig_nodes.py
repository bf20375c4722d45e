"""`[bus.NAME.node.NAME]` tables of a rig: settings of CAN controllers.

queue = "fifo"            or "priority": which of its pending frames competes
frames = "classical"      or "fd_tolerant", "fd": frames that it supports; hosts on a bus with a
                          data bit rate are "fd"
one_shot = false          true: no retransmission after an error or a lost arbitration
recovery_s = 0.0          delay after bus-off before it counts the 128 x 11 recessive bits;
                          or "command"
error_reporting = false   true: reports every error, not only changes of its state
oscillator_ppm = 0.0      clock error of its CAN controller, positive if fast; default: the
                          `oscillator` of the controller's own table
time_quanta = 16          per bit time; with sample_point = 14 and jump_width = 1 of them
silent = false            true: not a controller of the rig, but a node that only acknowledges
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from emulators.can_segment import HOST
from emulators.media.can_node import CanNode, FrameSupport, QueueOrder
from emulators.media.can_sampling import USUAL_TIMING, BitTiming
from harness.settings import Source, Table

_TIMING: Final = ("time_quanta", "sample_point", "jump_width")
NODE_KEYS: Final = (
    *("queue", "frames", "one_shot", "recovery_s", "error_reporting", "oscillator_ppm"),
    *_TIMING,
    "silent",
)
PPM_MAX: Final = 100_000.0
QUANTA_MAX: Final = 400
QUEUES: Final = tuple(order.value for order in QueueOrder)
SUPPORTS: Final = tuple(support.value for support in FrameSupport)
BY_COMMAND: Final = "command"
RECOVERY_MAX_S: Final = 1e6


def read_nodes(bus: Table) -> Mapping[str, CanNode]:
    """Read the CAN controllers that a bus's table configures, by node.

    Raises:
        RigError: the first error in them.
    """
    tables = bus.table("node")
    fd = bus.has("data_bitrate_bit_s")
    chips = {name: _chip(name, tables.table(name), fd) for name in tables.values}
    return MappingProxyType(chips)


def silent_nodes(bus: Table) -> tuple[str, ...]:
    """Return the nodes that are not controllers of the rig and only acknowledge.

    Raises:
        RigError: the host's interface is declared silent, or a name is reserved.
    """
    tables = bus.table("node")
    silent = [name for name in tables.values if tables.table(name).flag("silent", False)]
    if HOST in silent:
        raise tables.table(HOST).error("silent", "applications send through it", "take it out")
    for name in silent:
        tables.refuse_no_name(name)
        if name.startswith(f"{HOST}-"):
            raise tables.error(name, "is reserved for ports of applications", "rename it")
    return tuple(silent)


def refuse_strangers(
    source: Source,
    bus: str,
    nodes: Mapping[str, CanNode],
    silent: Sequence[str],
    known: Sequence[str],
) -> None:
    """Raise RigError for the first of a bus's `nodes` that is neither `known` nor `silent`."""
    for name in nodes:
        path = ("bus", bus, "node", name)
        if name in silent and name in known:
            raise source.error((*path, "silent"), f'"{name}" is a controller', "take it out")
        if name not in known and name not in silent:
            raise source.no_such(path, name, known, "controller")


def _chip(name: str, table: Table, has_data_rate: bool) -> CanNode:
    table.refuse_unknown(NODE_KEYS)
    usual = FrameSupport.FD if name == HOST and has_data_rate else FrameSupport.CLASSICAL
    recovery_ns: int | None = 0
    if table.values.get("recovery_s") == BY_COMMAND:
        recovery_ns = None
    elif table.has("recovery_s"):
        example = f'0.1, or "{BY_COMMAND}"'
        high = RECOVERY_MAX_S
        recovery_s = table.number("recovery_s", low=0.0, high=high, unit="s", example=example)
        recovery_ns = round(recovery_s * 1e9)
    ppm = table.number("oscillator_ppm", 0.0, low=-PPM_MAX, high=PPM_MAX, unit="ppm")
    return CanNode(
        queue=QueueOrder(table.one_of("queue", QUEUES, "queue", default=QueueOrder.FIFO.value)),
        frames=FrameSupport(
            table.one_of("frames", SUPPORTS, "kind of CAN controller", default=usual.value)
        ),
        one_shot=table.flag("one_shot", False),
        recovery_ns=recovery_ns,
        error_reporting=table.flag("error_reporting", False),
        shared=name == HOST,
        clock_error_1e12=round(ppm * 1e6),
        timing=_timing(table),
    )


def _timing(table: Table) -> BitTiming:
    quanta = table.integer("time_quanta", USUAL_TIMING.quanta, low=4, high=QUANTA_MAX)
    last = quanta - 1
    sample = USUAL_TIMING.sample
    if table.has("sample_point"):
        sample = table.integer("sample_point", low=2, high=last, unit="quanta")
    elif sample > last:
        raise table.error(
            "time_quanta",
            f"{quanta} quanta leave no room for the usual sample point, {sample}",
            f"write sample_point = {quanta * 7 // 8}",  # CiA 301 recommends 87.5 %
        )
    high = quanta - sample
    unit = "quanta behind the sample point"
    jump = table.integer("jump_width", USUAL_TIMING.jump, low=1, high=high, unit=unit)
    return BitTiming(quanta, sample, jump)
