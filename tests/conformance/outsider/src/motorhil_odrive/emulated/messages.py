"""CANSimple, as the drive implements it: identifiers, layouts, enumerations.

An identifier is node_id << 5 | command. Everything is little endian; floats are IEEE 754 singles.

Source: the message set of firmware 0.6.10, as ODrive describes it in a DBC.
"""

from enum import IntEnum
from struct import Struct
from typing import Final

COMMAND_BITS: Final = 5
COMMAND_MASK: Final = 0x1F
UNADDRESSED: Final = 0x3F  # all nodes receive 06h with this node-ID

GET_VERSION: Final = 0x00
HEARTBEAT: Final = 0x01
ESTOP: Final = 0x02
GET_ERROR: Final = 0x03
RX_SDO: Final = 0x04
TX_SDO: Final = 0x05
ADDRESS: Final = 0x06
SET_AXIS_STATE: Final = 0x07
GET_ENCODER_ESTIMATES: Final = 0x09
SET_CONTROLLER_MODE: Final = 0x0B
SET_INPUT_POS: Final = 0x0C
SET_INPUT_VEL: Final = 0x0D
SET_INPUT_TORQUE: Final = 0x0E
SET_LIMITS: Final = 0x0F
SET_TRAJ_VEL_LIMIT: Final = 0x11
SET_TRAJ_ACCEL_LIMITS: Final = 0x12
SET_TRAJ_INERTIA: Final = 0x13
GET_IQ: Final = 0x14
GET_TEMPERATURE: Final = 0x15
REBOOT: Final = 0x16
GET_BUS_VOLTAGE_CURRENT: Final = 0x17
CLEAR_ERRORS: Final = 0x18
SET_ABSOLUTE_POSITION: Final = 0x19
SET_POS_GAIN: Final = 0x1A
SET_VEL_GAINS: Final = 0x1B
GET_TORQUES: Final = 0x1C
GET_POWERS: Final = 0x1D
ENTER_DFU_MODE: Final = 0x1F

# Messages from the drive: cyclic, or in answer to a remote frame.
TOLD: Final[dict[int, tuple[Struct, tuple[str, ...]]]] = {
    GET_VERSION: (
        Struct("<8B"),
        (
            *("Protocol_Version", "Hw_Version_Major", "Hw_Version_Minor", "Hw_Version_Variant"),
            *("Fw_Version_Major", "Fw_Version_Minor", "Fw_Version_Revision"),
            "Fw_Version_Unreleased",
        ),
    ),
    HEARTBEAT: (
        Struct("<IBBBx"),
        ("Axis_Error", "Axis_State", "Procedure_Result", "Trajectory_Done_Flag"),
    ),
    GET_ERROR: (Struct("<II"), ("Active_Errors", "Disarm_Reason")),
    GET_ENCODER_ESTIMATES: (Struct("<ff"), ("Pos_Estimate", "Vel_Estimate")),
    GET_IQ: (Struct("<ff"), ("Iq_Setpoint", "Iq_Measured")),
    GET_TEMPERATURE: (Struct("<ff"), ("FET_Temperature", "Motor_Temperature")),
    GET_BUS_VOLTAGE_CURRENT: (Struct("<ff"), ("Bus_Voltage", "Bus_Current")),
    GET_TORQUES: (Struct("<ff"), ("Torque_Target", "Torque_Estimate")),
    GET_POWERS: (Struct("<ff"), ("Electrical_Power", "Mechanical_Power")),
}
# Messages to the drive. 06h exists in both directions, with 8 bytes to the drive.
HEARD: Final[dict[int, tuple[Struct, tuple[str, ...]]]] = {
    ESTOP: (Struct(""), ()),
    SET_AXIS_STATE: (Struct("<I"), ("Axis_Requested_State",)),
    SET_CONTROLLER_MODE: (Struct("<II"), ("Control_Mode", "Input_Mode")),
    SET_INPUT_POS: (Struct("<fhh"), ("Input_Pos", "Vel_FF", "Torque_FF")),
    SET_INPUT_VEL: (Struct("<ff"), ("Input_Vel", "Input_Torque_FF")),
    SET_INPUT_TORQUE: (Struct("<f"), ("Input_Torque",)),
    SET_LIMITS: (Struct("<ff"), ("Velocity_Limit", "Current_Limit")),
    SET_TRAJ_VEL_LIMIT: (Struct("<f"), ("Traj_Vel_Limit",)),
    SET_TRAJ_ACCEL_LIMITS: (Struct("<ff"), ("Traj_Accel_Limit", "Traj_Decel_Limit")),
    SET_TRAJ_INERTIA: (Struct("<f"), ("Traj_Inertia",)),
    REBOOT: (Struct("<B"), ("Action",)),
    CLEAR_ERRORS: (Struct("<B"), ("Identify",)),
    SET_ABSOLUTE_POSITION: (Struct("<f"), ("Position",)),
    SET_POS_GAIN: (Struct("<f"), ("Pos_Gain",)),
    SET_VEL_GAINS: (Struct("<ff"), ("Vel_Gain", "Vel_Integrator_Gain")),
    ENTER_DFU_MODE: (Struct(""), ()),
}
FEED_FORWARD_SCALE: Final = 0.001  # of Vel_FF [rev/s] and Torque_FF [N m]
ADDRESSING: Final = Struct("<B6s")


class AxisState(IntEnum):
    """State of the axis, or requested state."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION_SEQUENCE = 3
    MOTOR_CALIBRATION = 4
    SENSORLESS_CONTROL = 5
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP_CONTROL = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11
    ENCODER_HALL_POLARITY_CALIBRATION = 12
    ENCODER_HALL_PHASE_CALIBRATION = 13
    ANTICOGGING_CALIBRATION = 14


class ProcedureResult(IntEnum):
    """Result of the last requested state."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    POLE_PAIR_CPR_MISMATCH = 5
    PHASE_RESISTANCE_OUT_OF_RANGE = 6
    PHASE_INDUCTANCE_OUT_OF_RANGE = 7
    UNBALANCED_PHASES = 8
    INVALID_MOTOR_TYPE = 9
    ILLEGAL_HALL_STATE = 10
    TIMEOUT = 11
    HOMING_WITHOUT_ENDSTOP = 12
    INVALID_STATE = 13
    NOT_CALIBRATED = 14
    NOT_CONVERGING = 15


class ControlMode(IntEnum):
    """Controlled quantity."""

    VOLTAGE_CONTROL = 0
    TORQUE_CONTROL = 1
    VELOCITY_CONTROL = 2
    POSITION_CONTROL = 3


class InputMode(IntEnum):
    """Processing of an input on its way to the set-point."""

    INACTIVE = 0
    PASSTHROUGH = 1
    VEL_RAMP = 2
    POS_FILTER = 3
    MIX_CHANNELS = 4
    TRAP_TRAJ = 5
    TORQUE_RAMP = 6
    MIRROR = 7
    TUNING = 8


class Action(IntEnum):
    """Action of Reboot (16h)."""

    REBOOT = 0
    SAVE_CONFIGURATION = 1
    ERASE_CONFIGURATION = 2
    ENTER_DFU_MODE = 3


class Error(IntEnum):
    """Reason why the axis does not run, or was disarmed; bits."""

    NONE = 0
    INITIALIZING = 1
    SYSTEM_LEVEL = 1 << 1
    TIMING_ERROR = 1 << 2
    MISSING_ESTIMATE = 1 << 3
    BAD_CONFIG = 1 << 4
    DRV_FAULT = 1 << 5
    MISSING_INPUT = 1 << 6
    DC_BUS_OVER_VOLTAGE = 1 << 8
    DC_BUS_UNDER_VOLTAGE = 1 << 9
    DC_BUS_OVER_CURRENT = 1 << 10
    DC_BUS_OVER_REGEN_CURRENT = 1 << 11
    CURRENT_LIMIT_VIOLATION = 1 << 12
    MOTOR_OVER_TEMP = 1 << 13
    INVERTER_OVER_TEMP = 1 << 14
    VELOCITY_LIMIT_VIOLATION = 1 << 15
    POSITION_LIMIT_VIOLATION = 1 << 16
    WATCHDOG_TIMER_EXPIRED = 1 << 24
    ESTOP_REQUESTED = 1 << 25
    SPINOUT_DETECTED = 1 << 26
    BRAKE_RESISTOR_DISARMED = 1 << 27
    THERMISTOR_DISCONNECTED = 1 << 28
    CALIBRATION_ERROR = 1 << 30
