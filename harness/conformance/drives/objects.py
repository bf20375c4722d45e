"""Objects, modes and states of CiA 301 and CiA 402-2, as a client sees them.

This table is the kit's own reading of the standards. It shares nothing with the emulated drives.
"""

from enum import Enum, IntEnum
from struct import calcsize
from typing import Final, final

from motorhil.frozen import frozen


@final
@frozen
class Entry:
    """One object with its sub-index, its type as a `struct` code, and its name."""

    index: int
    subindex: int
    code: str
    name: str

    @property
    def mapped(self) -> int:
        """The value that maps it to a PDO."""
        return self.index << 16 | self.subindex << 8 | 8 * calcsize(self.code)

    def __str__(self) -> str:
        sub = f":{self.subindex:02X}" if self.subindex else ""
        return f"{self.index:04X}h{sub} ({self.name})"


DEVICE_TYPE: Final = Entry(0x1000, 0, "I", "device type")
ERROR_REGISTER: Final = Entry(0x1001, 0, "B", "error register")
ERRORS_KEPT: Final = Entry(0x1003, 0, "B", "number of errors")
LAST_ERROR: Final = Entry(0x1003, 1, "I", "last error")
STORE_ALL: Final = Entry(0x1010, 1, "I", "store parameters")
RESTORE_ALL: Final = Entry(0x1011, 1, "I", "restore default parameters")
HEARTBEAT_CONSUMER: Final = Entry(0x1016, 1, "I", "consumer heartbeat time")
HEARTBEAT_PRODUCER: Final = Entry(0x1017, 0, "H", "producer heartbeat time")
COMMUNICATION_ERROR: Final = Entry(0x1029, 1, "B", "error behaviour: communication error")
VENDOR: Final = Entry(0x1018, 1, "I", "vendor-ID")
ABORT_CONNECTION: Final = Entry(0x6007, 0, "h", "abort connection option code")
ERROR_CODE: Final = Entry(0x603F, 0, "H", "error code")
CONTROLWORD: Final = Entry(0x6040, 0, "H", "controlword")
STATUSWORD: Final = Entry(0x6041, 0, "H", "statusword")
QUICK_STOP_OPTION: Final = Entry(0x605A, 0, "h", "quick stop option code")
SHUTDOWN_OPTION: Final = Entry(0x605B, 0, "h", "shutdown option code")
DISABLE_OPTION: Final = Entry(0x605C, 0, "h", "disable operation option code")
HALT_OPTION: Final = Entry(0x605D, 0, "h", "halt option code")
FAULT_OPTION: Final = Entry(0x605E, 0, "h", "fault reaction option code")
MODE: Final = Entry(0x6060, 0, "b", "modes of operation")
MODE_DISPLAY: Final = Entry(0x6061, 0, "b", "modes of operation display")
POSITION_DEMAND: Final = Entry(0x6062, 0, "i", "position demand value")
POSITION_INTERNAL: Final = Entry(0x6063, 0, "i", "position actual internal value")
POSITION: Final = Entry(0x6064, 0, "i", "position actual value")
FOLLOWING_WINDOW: Final = Entry(0x6065, 0, "I", "following error window")
FOLLOWING_TIMEOUT: Final = Entry(0x6066, 0, "H", "following error time out")
POSITION_WINDOW: Final = Entry(0x6067, 0, "I", "position window")
POSITION_TIME: Final = Entry(0x6068, 0, "H", "position window time")
VELOCITY_SENSOR: Final = Entry(0x6069, 0, "i", "velocity sensor actual value")
VELOCITY_DEMAND: Final = Entry(0x606B, 0, "i", "velocity demand value")
VELOCITY: Final = Entry(0x606C, 0, "i", "velocity actual value")
VELOCITY_WINDOW: Final = Entry(0x606D, 0, "H", "velocity window")
VELOCITY_TIME: Final = Entry(0x606E, 0, "H", "velocity window time")
THRESHOLD: Final = Entry(0x606F, 0, "H", "velocity threshold")
THRESHOLD_TIME: Final = Entry(0x6070, 0, "H", "velocity threshold time")
TARGET_TORQUE: Final = Entry(0x6071, 0, "h", "target torque")
TORQUE_MAX: Final = Entry(0x6072, 0, "H", "max torque")
CURRENT_MAX: Final = Entry(0x6073, 0, "H", "max current")
TORQUE_DEMAND: Final = Entry(0x6074, 0, "h", "torque demand value")
RATED_TORQUE: Final = Entry(0x6076, 0, "I", "motor rated torque")
TORQUE: Final = Entry(0x6077, 0, "h", "torque actual value")
CURRENT: Final = Entry(0x6078, 0, "h", "current actual value")
DC_LINK: Final = Entry(0x6079, 0, "I", "DC link circuit voltage")
TARGET_POSITION: Final = Entry(0x607A, 0, "i", "target position")
RANGE_MIN: Final = Entry(0x607B, 1, "i", "minimum position range limit")
RANGE_MAX: Final = Entry(0x607B, 2, "i", "maximum position range limit")
HOME_OFFSET: Final = Entry(0x607C, 0, "i", "home offset")
LIMIT_MIN: Final = Entry(0x607D, 1, "i", "minimum position limit")
LIMIT_MAX: Final = Entry(0x607D, 2, "i", "maximum position limit")
POLARITY: Final = Entry(0x607E, 0, "B", "polarity")
VELOCITY_MAX: Final = Entry(0x607F, 0, "I", "maximum profile velocity")
MOTOR_SPEED_MAX: Final = Entry(0x6080, 0, "I", "max motor speed")
PROFILE_VELOCITY: Final = Entry(0x6081, 0, "I", "profile velocity")
END_VELOCITY: Final = Entry(0x6082, 0, "I", "end velocity")
ACCELERATION: Final = Entry(0x6083, 0, "I", "profile acceleration")
DECELERATION: Final = Entry(0x6084, 0, "I", "profile deceleration")
QUICK_DECELERATION: Final = Entry(0x6085, 0, "I", "quick stop deceleration")
TORQUE_SLOPE: Final = Entry(0x6087, 0, "I", "torque slope")
ENCODER_INCREMENTS: Final = Entry(0x608F, 1, "I", "encoder increments")
FEED: Final = Entry(0x6092, 1, "I", "feed")
VELOCITY_FACTOR: Final = Entry(0x6096, 1, "I", "velocity factor, numerator")
ACCELERATION_FACTOR: Final = Entry(0x6097, 1, "I", "acceleration factor, numerator")
HOMING_METHOD: Final = Entry(0x6098, 0, "b", "homing method")
SEARCH_SPEED: Final = Entry(0x6099, 1, "I", "speed during search for switch")
ZERO_SPEED: Final = Entry(0x6099, 2, "I", "speed during search for zero")
HOMING_ACCELERATION: Final = Entry(0x609A, 0, "I", "homing acceleration")
POSITION_OFFSET: Final = Entry(0x60B0, 0, "i", "position offset")
VELOCITY_OFFSET: Final = Entry(0x60B1, 0, "i", "velocity offset")
TORQUE_OFFSET: Final = Entry(0x60B2, 0, "h", "torque offset")
PROBE_FUNCTION: Final = Entry(0x60B8, 0, "H", "touch probe function")
PROBE_STATUS: Final = Entry(0x60B9, 0, "H", "touch probe status")
IP_SUB_MODE: Final = Entry(0x60C0, 0, "h", "interpolation sub mode select")
IP_RECORD: Final = Entry(0x60C1, 1, "i", "interpolation data record")
PERIOD: Final = Entry(0x60C2, 1, "B", "interpolation time period value")
PERIOD_INDEX: Final = Entry(0x60C2, 2, "b", "interpolation time index")
IP_SIZE: Final = Entry(0x60C4, 2, "I", "actual buffer size")
IP_ORGANISATION: Final = Entry(0x60C4, 3, "B", "buffer organisation")
IP_POSITION: Final = Entry(0x60C4, 4, "H", "buffer position")
IP_CLEAR: Final = Entry(0x60C4, 6, "B", "buffer clear")
ACCELERATION_MAX: Final = Entry(0x60C5, 0, "I", "max acceleration")
DECELERATION_MAX: Final = Entry(0x60C6, 0, "I", "max deceleration")
TORQUE_POSITIVE: Final = Entry(0x60E0, 0, "H", "positive torque limit value")
TORQUE_NEGATIVE: Final = Entry(0x60E1, 0, "H", "negative torque limit value")
POSITIONING: Final = Entry(0x60F2, 0, "H", "positioning option code")
FOLLOWING_ERROR: Final = Entry(0x60F4, 0, "i", "following error actual value")
SLIPPAGE: Final = Entry(0x60F8, 0, "i", "max slippage")
POSITION_DEMAND_INTERNAL: Final = Entry(0x60FC, 0, "i", "position demand internal value")
INPUTS: Final = Entry(0x60FD, 0, "I", "digital inputs")
TARGET_VELOCITY: Final = Entry(0x60FF, 0, "i", "target velocity")
SUPPORTED_MODES: Final = Entry(0x6502, 0, "I", "supported drive modes")


@final
class Mode(IntEnum):
    """Modes of operation (6060h); the bit of a mode in 6502h is one less."""

    PP = 1
    VL = 2
    PV = 3
    TQ = 4
    HM = 6
    IP = 7
    CSP = 8
    CSV = 9
    CST = 10

    def __str__(self) -> str:
        return self.name.lower()


@final
class State(Enum):
    """States of the PDS FSA: mask and value of the statusword."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    def __str__(self) -> str:
        return self.name.lower().replace("_", " ")


def state_of(statusword: int) -> State | None:
    """Return the state that a statusword shows, or None if it shows none."""
    for state in State:
        mask, value = state.value
        if statusword & mask == value:
            return state
    return None


# Controlwords that consist of a command alone (CiA 402-2, controlword)
SHUTDOWN: Final = 0x06
SWITCH_ON: Final = 0x07
ENABLE: Final = 0x0F
QUICK_STOP: Final = 0x02
DISABLE_VOLTAGE: Final = 0x00
FAULT_RESET: Final = 0x80
# Further bits of the controlword
NEW_SET_POINT: Final = 0x0010
START_HOMING: Final = 0x0010
IMMEDIATELY: Final = 0x0020
RELATIVE: Final = 0x0040
HALT: Final = 0x0100
ON_SET_POINT: Final = 0x0200
# Bits of the statusword
VOLTAGE_ENABLED: Final = 0x0010
REMOTE: Final = 0x0200
WARNING: Final = 0x0080
TARGET_REACHED: Final = 0x0400
INTERNAL_LIMIT: Final = 0x0800
BIT_12: Final = 0x1000
BIT_13: Final = 0x2000
