"""States, modes, bits and objects of CiA 402, for the host.

Source: IEC 61800-7-201 (CiA 402-2): PDS FSA, modes of operation, object dictionary; CiA 301 for the
communication objects.
"""

from enum import Enum, IntEnum
from typing import Final, final

from motorhil.motorapi.adaptations.canopen.objects import COMMUNICATION_OBJECTS, ObjectTable


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
RELATIVE: Final = 0x0040  # pp: the target is a distance
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


# name: (index, sub-index, type), with the standard's names
OBJECTS: Final = ObjectTable(
    {
        **COMMUNICATION_OBJECTS,
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
        "positioning_option_code": (0x60F2, 0, "u16"),
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
)


def is_off(word: int) -> bool:
    """Return whether a statusword shows that the power stage is off."""
    return word & 0x4F in (0x40, 0x08) or word & 0x6F == 0x21


def shows_no_reaction(word: int) -> bool:
    """Return whether a statusword shows no active fault reaction."""
    return word & 0x4F != 0x0F


def shows_no_fault(word: int) -> bool:
    """Return whether a statusword shows no fault."""
    return not word & FAULT_BIT
