"""States, modes, bits and objects of CiA 402, for the host.

Source: IEC 61800-7-201 (CiA 402-2): PDS FSA, modes of operation, object dictionary; CiA 301 for the
communication objects.
"""

import struct
from enum import Enum, IntEnum
from typing import Final, final

from motorhil.motorapi.errors import UsageError

Value = int | float | str | bytes


@final
class PdsState(Enum):
    """The states of the PDS FSA, as the statusword shows them."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"


# (mask, value, state), statusword bits 0-3, 5 and 6
_STATES: Final = (
    (0x4F, 0x00, PdsState.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, PdsState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, PdsState.READY_TO_SWITCH_ON),
    (0x6F, 0x23, PdsState.SWITCHED_ON),
    (0x6F, 0x27, PdsState.OPERATION_ENABLED),
    (0x6F, 0x07, PdsState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, PdsState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, PdsState.FAULT),
)


def _shown_by(bits: int) -> PdsState | None:
    for mask, value, state in _STATES:
        if bits & mask == value:
            return state
    return None


STATE_BITS: Final = 0x6F
_STATE_OF_BITS: Final = tuple(_shown_by(bits) for bits in range(STATE_BITS + 1))


def decode_state(statusword: int) -> PdsState | None:
    """Return the state in a statusword (6041h), or None if it matches no state of the standard."""
    return _STATE_OF_BITS[statusword & STATE_BITS]


# statusword
ENABLED_MASK: Final = 0x6F
ENABLED_VALUE: Final = 0x27
FAULT_BIT: Final = 0x0008
TARGET_REACHED: Final = 0x0400
ACKNOWLEDGE: Final = 0x1000  # pp: set-point acknowledge; hm: homing attained
HOMING_ATTAINED: Final = 0x1000
HOMING_ERROR: Final = 0x2000

# controlword
DISABLE_VOLTAGE: Final = 0x0000
QUICK_STOP: Final = 0x0002
SHUTDOWN: Final = 0x0006
SWITCH_ON: Final = 0x0007
ENABLE_OPERATION: Final = 0x000F
NEW_SET_POINT: Final = 0x0010  # hm: homing operation start; ip: enable interpolation
CHANGE_IMMEDIATELY: Final = 0x0020
FAULT_RESET: Final = 0x0080
HALT: Final = 0x0100


@final
class Mode(IntEnum):
    """Modes of operation (6060h)."""

    NONE = 0
    PROFILE_POSITION = 1
    VELOCITY = 2
    PROFILE_VELOCITY = 3
    PROFILE_TORQUE = 4
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNC_POSITION = 8
    CYCLIC_SYNC_VELOCITY = 9
    CYCLIC_SYNC_TORQUE = 10

    @property
    def supported_bit(self) -> int:
        """The bit of this mode in 6502h, supported drive modes."""
        return 1 << (self.value - 1)


# CiA 301 data types: name -> struct format
_FORMATS: Final[dict[str, struct.Struct]] = {
    "u8": struct.Struct("<B"),
    "u16": struct.Struct("<H"),
    "u32": struct.Struct("<I"),
    "i8": struct.Struct("<b"),
    "i16": struct.Struct("<h"),
    "i32": struct.Struct("<i"),
    "u64": struct.Struct("<Q"),
    "i64": struct.Struct("<q"),
    "f32": struct.Struct("<f"),
    "f64": struct.Struct("<d"),
}
KINDS: Final = (*_FORMATS, "string", "bytes")

# name: (index, sub-index, type), with the standard's names
OBJECTS: Final[dict[str, tuple[int, int, str]]] = {
    "device_type": (0x1000, 0, "u32"),
    "error_register": (0x1001, 0, "u8"),
    "number_of_errors": (0x1003, 0, "u8"),
    "last_error": (0x1003, 1, "u32"),
    "cob_id_sync": (0x1005, 0, "u32"),
    "communication_cycle_period": (0x1006, 0, "u32"),
    "manufacturer_device_name": (0x1008, 0, "string"),
    "manufacturer_hardware_version": (0x1009, 0, "string"),
    "manufacturer_software_version": (0x100A, 0, "string"),
    "store_parameters": (0x1010, 1, "u32"),
    "restore_default_parameters": (0x1011, 1, "u32"),
    "cob_id_emcy": (0x1014, 0, "u32"),
    "consumer_heartbeat_time": (0x1016, 1, "u32"),
    "producer_heartbeat_time": (0x1017, 0, "u16"),
    "vendor_id": (0x1018, 1, "u32"),
    "product_code": (0x1018, 2, "u32"),
    "revision_number": (0x1018, 3, "u32"),
    "serial_number": (0x1018, 4, "u32"),
    "abort_connection_option_code": (0x6007, 0, "i16"),
    "error_code": (0x603F, 0, "u16"),
    "controlword": (0x6040, 0, "u16"),
    "statusword": (0x6041, 0, "u16"),
    "vl_target_velocity": (0x6042, 0, "i16"),
    "quick_stop_option_code": (0x605A, 0, "i16"),
    "shutdown_option_code": (0x605B, 0, "i16"),
    "disable_operation_option_code": (0x605C, 0, "i16"),
    "halt_option_code": (0x605D, 0, "i16"),
    "fault_reaction_option_code": (0x605E, 0, "i16"),
    "modes_of_operation": (0x6060, 0, "i8"),
    "modes_of_operation_display": (0x6061, 0, "i8"),
    "position_demand_value": (0x6062, 0, "i32"),
    "position_actual_internal_value": (0x6063, 0, "i32"),
    "position_actual_value": (0x6064, 0, "i32"),
    "following_error_window": (0x6065, 0, "u32"),
    "following_error_time_out": (0x6066, 0, "u16"),
    "position_window": (0x6067, 0, "u32"),
    "position_window_time": (0x6068, 0, "u16"),
    "velocity_demand_value": (0x606B, 0, "i32"),
    "velocity_actual_value": (0x606C, 0, "i32"),
    "velocity_window": (0x606D, 0, "u16"),
    "velocity_window_time": (0x606E, 0, "u16"),
    "velocity_threshold": (0x606F, 0, "u16"),
    "velocity_threshold_time": (0x6070, 0, "u16"),
    "target_torque": (0x6071, 0, "i16"),
    "max_torque": (0x6072, 0, "u16"),
    "max_current": (0x6073, 0, "u16"),
    "torque_demand": (0x6074, 0, "i16"),
    "motor_rated_current": (0x6075, 0, "u32"),
    "motor_rated_torque": (0x6076, 0, "u32"),
    "torque_actual_value": (0x6077, 0, "i16"),
    "current_actual_value": (0x6078, 0, "i16"),
    "target_position": (0x607A, 0, "i32"),
    "position_range_limit_min": (0x607B, 1, "i32"),
    "position_range_limit_max": (0x607B, 2, "i32"),
    "home_offset": (0x607C, 0, "i32"),
    "software_position_limit_min": (0x607D, 1, "i32"),
    "software_position_limit_max": (0x607D, 2, "i32"),
    "polarity": (0x607E, 0, "u8"),
    "max_profile_velocity": (0x607F, 0, "u32"),
    "max_motor_speed": (0x6080, 0, "u32"),
    "profile_velocity": (0x6081, 0, "u32"),
    "end_velocity": (0x6082, 0, "u32"),
    "profile_acceleration": (0x6083, 0, "u32"),
    "profile_deceleration": (0x6084, 0, "u32"),
    "quick_stop_deceleration": (0x6085, 0, "u32"),
    "motion_profile_type": (0x6086, 0, "i16"),
    "torque_slope": (0x6087, 0, "u32"),
    "torque_profile_type": (0x6088, 0, "i16"),
    "encoder_increments": (0x608F, 1, "u32"),
    "encoder_motor_revolutions": (0x608F, 2, "u32"),
    "gear_motor_revolutions": (0x6091, 1, "u32"),
    "gear_shaft_revolutions": (0x6091, 2, "u32"),
    "feed": (0x6092, 1, "u32"),
    "feed_shaft_revolutions": (0x6092, 2, "u32"),
    "velocity_factor_numerator": (0x6096, 1, "u32"),
    "velocity_factor_divisor": (0x6096, 2, "u32"),
    "acceleration_factor_numerator": (0x6097, 1, "u32"),
    "acceleration_factor_divisor": (0x6097, 2, "u32"),
    "homing_method": (0x6098, 0, "i8"),
    "homing_speed_switch": (0x6099, 1, "u32"),
    "homing_speed_zero": (0x6099, 2, "u32"),
    "homing_acceleration": (0x609A, 0, "u32"),
    "position_offset": (0x60B0, 0, "i32"),
    "velocity_offset": (0x60B1, 0, "i32"),
    "torque_offset": (0x60B2, 0, "i16"),
    "interpolation_sub_mode": (0x60C0, 0, "i16"),
    "interpolation_data": (0x60C1, 1, "i32"),
    "interpolation_period_value": (0x60C2, 1, "u8"),
    "interpolation_period_index": (0x60C2, 2, "i8"),
    "max_acceleration": (0x60C5, 0, "u32"),
    "max_deceleration": (0x60C6, 0, "u32"),
    "positive_torque_limit_value": (0x60E0, 0, "u16"),
    "negative_torque_limit_value": (0x60E1, 0, "u16"),
    "following_error_actual_value": (0x60F4, 0, "i32"),
    "position_demand_internal_value": (0x60FC, 0, "i32"),
    "digital_inputs": (0x60FD, 0, "u32"),
    "digital_outputs": (0x60FE, 1, "u32"),
    "target_velocity": (0x60FF, 0, "i32"),
    "motor_type": (0x6402, 0, "u16"),
    "supported_drive_modes": (0x6502, 0, "u32"),
}
_TYPE_AT: Final = {(index, subindex): kind for index, subindex, kind in OBJECTS.values()}


def type_of(index: int, subindex: int) -> str | None:
    """Return the data type of a standard object, or None if this table does not contain it."""
    known = _TYPE_AT.get((index, subindex))
    if known is None and subindex == 0 and (index, 1) in _TYPE_AT:
        return "u8"  # highest sub-index supported
    if known is None and 0x1400 <= index < 0x1A00 + 0x200:
        return _pdo_type(index, subindex)
    return known


def _pdo_type(index: int, subindex: int) -> str:
    if subindex == 0:
        return "u8"
    if index & 0x0200:  # 1600h.. and 1A00h..: mapping
        return "u32"
    return {1: "u32", 3: "u16", 5: "u16"}.get(subindex, "u8")


def decode(kind: str, data: bytes) -> Value:
    """Return the value of `data` read from the device; a wrong length is cut or extended.

    Some devices answer with four bytes for every type, or with fewer.
    """
    if kind == "string":
        return data.rstrip(b"\0").decode("utf-8", "replace")
    if kind == "bytes":
        return data
    form = _FORMATS[kind]
    if len(data) < form.size:
        fill = b"\xff" if kind[0] == "i" and data and data[-1] & 0x80 else b"\0"
        data = data + fill * (form.size - len(data))
    value: int | float = form.unpack_from(data)[0]
    return value


def encode(kind: str, value: Value) -> bytes:
    """Return the bytes to write for a value.

    Raises:
        UsageError: the value does not fit the type.
    """
    if isinstance(value, bytes):
        return value
    if kind in ("string", "bytes"):
        return str(value).encode("utf-8", "replace")
    form = _FORMATS[kind]
    try:
        return form.pack(value if kind[0] == "f" else _whole(value))
    except (struct.error, OverflowError, TypeError):
        raise UsageError(f"{value!r} does not fit the data type {kind}") from None


def _whole(value: Value) -> int:
    if isinstance(value, int):
        return value
    raise UsageError(f"{value!r} is not an integer; the object holds an integer")


# EMCY and 603Fh error codes (CiA 301; CiA 402-1, error codes)
_ERRORS: Final = (
    (0xFFFF, 0x2310, "continuous over-current"),
    (0xFFFF, 0x2320, "short circuit or earth leakage"),
    (0xFFFF, 0x3110, "mains over-voltage"),
    (0xFFFF, 0x3120, "mains under-voltage"),
    (0xFFFF, 0x3210, "DC link over-voltage"),
    (0xFFFF, 0x3220, "DC link under-voltage"),
    (0xFFFF, 0x4210, "device temperature"),
    (0xFFFF, 0x4310, "drive temperature"),
    (0xFFFF, 0x7121, "motor blocked"),
    (0xFFFF, 0x7122, "motor error or commutation"),
    (0xFFFF, 0x7300, "sensor"),
    (0xFFFF, 0x7305, "incremental sensor 1"),
    (0xFFFF, 0x8110, "CAN overrun"),
    (0xFFFF, 0x8120, "CAN in error passive mode"),
    (0xFFFF, 0x8130, "heartbeat or life guard error: the host was not heard"),
    (0xFFFF, 0x8140, "recovered from bus-off"),
    (0xFFFF, 0x8210, "PDO not processed due to length error"),
    (0xFFFF, 0x8611, "following error"),
    (0xFF00, 0x1000, "generic error"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "device hardware"),
    (0xF000, 0x6000, "device software"),
    (0xF000, 0x7000, "additional modules"),
    (0xF000, 0x8000, "monitoring"),
    (0xFF00, 0x9000, "external error"),
    (0xFF00, 0xFF00, "device specific"),
)


def error_text(code: int) -> str:
    """Return the text of an error code, from the most specific line of the standard's table."""
    if code == 0:
        return "error code not told"
    for mask, value, text in _ERRORS:
        if code & mask == value:
            return text
    return "unknown"


def is_off(word: int) -> bool:
    """Return whether a statusword shows that the power stage is off."""
    return word & 0x4F in (0x40, 0x08) or word & 0x6F == 0x21


def shows_no_reaction(word: int) -> bool:
    """Return whether a statusword shows no active fault reaction."""
    return word & 0x4F != 0x0F


def shows_no_fault(word: int) -> bool:
    """Return whether a statusword shows no fault."""
    return not word & FAULT_BIT


def shows_no_acknowledge(word: int) -> bool:
    """Return whether a statusword shows no set-point acknowledge (pp)."""
    return not word & ACKNOWLEDGE
