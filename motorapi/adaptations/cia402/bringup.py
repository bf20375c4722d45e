"""Bring-up of a drive: identification, mutual supervision and PDOs.

Only values that the drive does not have yet are written, so that a second program may join at any
time.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.canopen.bus import HEARTBEAT_ID
from motorhil.motorapi.adaptations.canopen.errors import NO_SUCH_OBJECT, SdoAborted
from motorhil.motorapi.adaptations.canopen.pdo_setup import (
    EVENT_DRIVEN,
    SYNCHRONOUS,
    PdoFound,
    PdoSetUp,
    PdoWish,
    usable_as_it_is,
)
from motorhil.motorapi.adaptations.canopen.settings import NodeOptions, period_ms
from motorhil.motorapi.adaptations.canopen.sync import SYNC_ID
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.cia402.objects import Mode
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.synchronization.bus_load import NodeTraffic, PeriodicMessage, note_node
from motorhil.settings import REQUIRED, number, text, whole

_UNKNOWN_CLOCK_PPM: Final = 1000.0
_SYNCHRONOUS_MAX: Final = 240


def _known(high: float, unit: str, doc: str, usual: tuple[float, float] | None = None) -> Any:
    doc = f"{doc}, for predicting skew; absent: not known."
    return number(None, 0, high, unit, doc, plausible=usual)


@frozen(kw_only=True)
class HwOptions(NodeOptions):
    """Settings of a hardware object for its drive; the defaults suit most drives."""

    status_inhibit_ms: float = number(
        2.0,
        0,
        6553.5,
        "ms",
        "Shortest time between two of these messages (1800h:03h).",
        plausible=(0.1, 1000.0),
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
    servo_period_ms: float | None = _known(1000.0, "ms", "Profile tick of the drive", (0.01, 20.0))
    oscillator_ppm: float | None = _known(100_000.0, "ppm", "Clock tolerance, either way")
    sdo_reply_ms: float | None = _known(
        60_000.0, "ms", "Longest SDO response time of the drive", (0.01, 10_000.0)
    )
    set_point_period_ms: int = period_ms(
        5, "Period of streamed set-points (60C2h); the same for all drives of a bus.", 1, 255
    )


@final
@frozen(kw_only=True)
class Cia402Table(HwOptions):
    """A motor behind a CiA 402 drive."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Node-ID of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


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


# Objects in PDO mappings: index, sub-index, bits.
_CONTROLWORD: Final = 0x6040_0010
_TARGET_POSITION: Final = 0x607A_0020
_TARGET_VELOCITY: Final = 0x60FF_0020
_STATUSWORD: Final = 0x6041_0010
_POSITION: Final = 0x6064_0020
_VELOCITY: Final = 0x606C_0020
_TORQUE: Final = 0x6077_0010

_PROFILE_402: Final = 0x0192
_TPDOS: Final = 4
_UINT16_MAX: Final = 0xFFFF
_FIRST_STATUS_S: Final = 0.5
_LATCHED_TARGETS: Final = (_TARGET_POSITION, _TARGET_VELOCITY)


@final
@frozen
class Identity:
    """The identity of the drive (1000h, 1018h); None where it reports nothing."""

    device_type: int | None
    vendor_id: int | None
    product_code: int | None
    revision_number: int | None
    serial_number: int | None


@final
@frozen
class DriveFacts:
    """The results of the bring-up of a drive.

    Attributes:
        identity: the identity of the drive.
        modes: the modes in 6502h; None if the drive does not report them.
        control_id: the identifier of the RPDO that sends the controlword at once; None: by SDO.
        latched_ids: the identifiers of the RPDOs with controlword and a target, latched at SYNC, by
            the index of the target (607Ah, 60FFh). Targets without such an RPDO are missing.
        status: the TPDO that sends the statusword; None: it is polled by SDO.
        missing: the target objects that this drive does not have.
        limitations: the functions that this drive lacks or refuses, in words.
    """

    identity: Identity
    modes: frozenset[Mode] | None
    control_id: int | None
    latched_ids: Mapping[int, int]
    status: PdoFound | None
    missing: frozenset[int]
    limitations: tuple[str, ...]


def bring_up(node: DriveNode, options: HwOptions) -> DriveFacts:
    """Configure the drive, start it (OPERATIONAL) and await its first status.

    Raises:
        DeadlineExceeded: the drive does not answer.
        UsageError: the device is not a CiA 402 drive.
        PeerError: the drive refused an indispensable setting.
    """
    node.may_change_state()
    identity = _identity(node)
    limitations: list[str] = []
    _set_up_dead_man(node, options, limitations)
    sync_id = node.read_optional(0x1005)
    latched = sync_id is None or sync_id & 0x7FF == SYNC_ID
    if not latched:
        limitations.append(f"its SYNC is {sync_id or 0:03X}h, ours {SYNC_ID:03X}h")
    pdos = PdoSetUp(node)
    control = pdos.configure(PdoWish(False, 1, (_CONTROLWORD,), EVENT_DRIVEN))
    if control is not None:
        node.listen_to_control(control[0])
    latched_ids = _latched_pdos(pdos) if latched else {}
    status = _status_pdo(node, pdos, options)
    for place in range(3 if options.velocity_period_ms else 2, _TPDOS + 1):
        pdos.switch_off(place, keep=None if status is None else status[0])
    limitations += pdos.refusals
    if status is not None:
        node.listen_to_tpdo(status[0], status[1].mapping)
    velocity = _velocity_pdo(node, pdos, options)
    pdos.finish()
    facts = DriveFacts(
        identity=identity,
        modes=_modes(node),
        control_id=None if control is None else control[0],
        latched_ids=latched_ids,
        status=None if status is None else status[1],
        missing=_missing(node, latched_ids),
        limitations=tuple(limitations),
    )
    tpdos = [made for made in (status, velocity) if made is not None]
    note_node(node.link.bus, node.node_id, drive_traffic(node.node_id, facts, tpdos, options))
    _await_first_status(node, facts, options)
    return facts


def _identity(node: DriveNode) -> Identity:
    answer = node.first_answer()
    device_type = _PROFILE_402 if answer is None else answer
    if device_type & 0xFFFF not in (_PROFILE_402, 0):
        raise UsageError(
            f"{node.label} is not a CiA 402 drive: its device type 1000h is {device_type:08X}h"
        )
    numbers = [node.read_optional(0x1018, place) for place in range(1, 5)]
    return Identity(device_type, *numbers)


def _modes(node: DriveNode) -> frozenset[Mode] | None:
    word = node.read_optional(0x6502)
    if word is None:
        return None
    return frozenset(mode for mode in Mode if mode is not Mode.NONE and word & mode.supported_bit)


def _set_up_dead_man(node: DriveNode, options: HwOptions, limitations: list[str]) -> None:
    """Set up mutual supervision: 1017h there and here, 1016h and 6007h there."""
    if options.connection_loss is not None:
        node.write_if_different(
            (0x6007, 0), options.connection_loss, 2, limitations, "its reaction to our loss"
        )
    node.write_if_different(
        (0x1017, 0),
        options.heartbeat_ms,
        2,
        limitations,
        "its heartbeat, so its loss is not detected",
    )
    watched = node.read_optional(0x1016, 1)
    if not options.heartbeat_ms and watched and watched >> 16 == options.host_node_id:
        node.write_if_different((0x1016, 1), 0, 4, limitations, "the end of its supervision of us")
    if options.heartbeat_ms and options.heartbeat_timeout_ms:
        consumer = options.host_node_id << 16 | options.heartbeat_timeout_ms
        node.write_if_different(
            (0x1016, 1),
            consumer,
            4,
            limitations,
            "its supervision of us, so it does not detect our loss",
        )
        if node.read_optional(0x1017) == options.heartbeat_ms:
            node.expect_heartbeat()


def _latched_pdos(pdos: PdoSetUp) -> dict[int, int]:
    """Configure RPDO 2 and following, one per target; return `DriveFacts.latched_ids`."""
    identifiers: dict[int, int] = {}
    for place, target in enumerate(_LATCHED_TARGETS, 2):
        made = pdos.configure(PdoWish(False, place, (_CONTROLWORD, target), SYNCHRONOUS))
        if made is not None:
            identifiers[target >> 16] = made[0]
    return identifiers


def _missing(node: DriveNode, latched_ids: Mapping[int, int]) -> frozenset[int]:
    """Return the targets that the drive lacks; one in an RPDO exists."""
    missing = set()
    for index in (target >> 16 for target in _LATCHED_TARGETS):
        if index not in latched_ids:
            try:
                node.read_int(index)
            except SdoAborted as error:
                if error.abort_code == NO_SUCH_OBJECT:  # another may be write only
                    missing.add(index)
    return frozenset(missing)


def _status_pdo(node: DriveNode, pdos: PdoSetUp, options: HwOptions) -> tuple[int, PdoFound] | None:
    wish = PdoWish(
        True,
        1,
        (_STATUSWORD, _POSITION),
        EVENT_DRIVEN,
        inhibit_100us=round(options.status_inhibit_ms * 10),
        event_ms=options.status_period_ms,
    )
    return (
        pdos.configure(wish)
        or usable_as_it_is(node, (_STATUSWORD, _POSITION))
        or usable_as_it_is(node, (_STATUSWORD,))
    )


def _velocity_pdo(
    node: DriveNode, pdos: PdoSetUp, options: HwOptions
) -> tuple[int, PdoFound] | None:
    period_ms = options.velocity_period_ms
    if not period_ms:
        return None
    for mapping in ((_VELOCITY, _TORQUE), (_VELOCITY,)):
        wish = PdoWish(
            True,
            2,
            mapping,
            EVENT_DRIVEN,
            inhibit_100us=min(10 * period_ms, _UINT16_MAX),
            event_ms=period_ms,
        )
        made = pdos.configure(wish)
        if made is not None:
            node.listen_to_tpdo(made[0], mapping)
            return made
    return None


def _await_first_status(node: DriveNode, facts: DriveFacts, options: HwOptions) -> None:
    """Await the first status: by TPDO if the drive sends it cyclically, else by SDO."""
    status = facts.status
    period_ms = 0
    if status is not None and _POSITION in status.mapping:
        period_ms = status.event_ms or 0
    node.expect_status(period_ms)
    if node.status_is_cyclic:
        seen_ns = node.status_ns
        heard = node.link.wait_until(
            lambda: node.status_ns != seen_ns,
            max(_FIRST_STATUS_S, 3 * options.status_period_ms / 1e3),
        )
        node.expect_status(period_ms if heard else 0)
    if not node.status_is_cyclic:
        node.poll_status()
    node.stays_operational()
