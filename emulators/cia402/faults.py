"""Table of faults: error code (603Fh), bits of 1001h, reaction and reset.

The codes are those of CiA 301 (7.2.7.1) and of the list in CiA 402-1. The bits of the error
register are CiA 301's (7.5.2.2). The standards leave the reaction to the vendor. This drive knows
two:

- *605Eh*: brake according to the fault reaction option code, as Technosoft's iPOS does on I2t,
  under-voltage and excess temperature (manual P091.063, 5.4.9).
- *At once*: switch the power stage off immediately, so that the motor coasts. A power stage that
  protects itself cannot brake (short circuit; over-voltage, which braking would raise;
  under-voltage). Without a sensor no loop can be closed and no motor commutated.

A fault is reset by a rising edge of controlword bit 7 once its cause is gone. Before that the edge
has no effect (iPOS drives behave the same: yarp-devices issue 215). Lost memory contents return
only with the next reset node.
"""

from typing import Final, final

from motorhil.emulators.canopen import emcy
from motorhil.emulators.canopen import emcy as can_state
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.settings.protection import STO_ERROR

GENERIC: Final = 0x01
CURRENT: Final = 0x02
VOLTAGE: Final = 0x04
TEMPERATURE: Final = 0x08
COMMUNICATION: Final = 0x10
PROFILE: Final = 0x20
VENDOR: Final = 0x80

CONTINUOUS_OVER_CURRENT: Final = 0x2310
SHORT_CIRCUIT: Final = 0x2320
MAINS_OVER_VOLTAGE: Final = 0x3110
MAINS_UNDER_VOLTAGE: Final = 0x3120
OVER_VOLTAGE: Final = 0x3210
UNDER_VOLTAGE: Final = 0x3220
DEVICE_TEMPERATURE: Final = 0x4210
DRIVE_TEMPERATURE: Final = 0x4310
MEMORY: Final = 0x5530
ENCODER: Final = 0x7305
COMMUNICATION_LOST: Final = emcy.COMMUNICATION
ERROR_PASSIVE: Final = can_state.ERROR_PASSIVE
HEARTBEAT_LOST: Final = emcy.HEARTBEAT_LOST
BUS_OFF_RECOVERED: Final = can_state.BUS_OFF_RECOVERED
FOLLOWING_ERROR: Final = 0x8611
SAFE_TORQUE_OFF: Final = STO_ERROR

# The faults that flags of the axis stand for, in any state.
OF_FLAGS: Final = (
    (f.OVER_VOLTAGE, OVER_VOLTAGE),
    (f.OVER_TEMPERATURE, DRIVE_TEMPERATURE),
    (f.I2T_LIMIT, CONTINUOUS_OVER_CURRENT),
)
WARNING_FLAGS: Final = f.TEMPERATURE_WARNING | f.I2T_WARNING
WARNED_BY_FLAGS: Final = 1  # bits of Standing.warnings
WARNED_BY_INPUT: Final = 2

# Error register bits by the code's first digit; the standards do not assign them.
_CLASSES: Final[dict[int, int]] = {
    0x2: CURRENT,
    0x3: VOLTAGE,
    0x4: TEMPERATURE,
}
_OF_VENDOR: Final = 0xFF  # FFxxh; F0xxh are additional functions, which have no bit of their own
_COMMUNICATION_BELOW: Final = 0x8300  # 81xxh and 82xxh; the rest of 8xxxh is motion


@final
class Fault:
    """One row of the table.

    Attributes:
        code: error code for 603Fh and EMCY.
        text: description for a person.
        at_once: True if the power stage goes off immediately; otherwise 605Eh decides.
        resettable: True if controlword bit 7 can reset it.
    """

    def __init__(self, code: int, text: str, at_once: bool = False, resettable: bool = True):
        self.code = code
        self.text = text
        self.at_once = at_once
        self.resettable = resettable


_ROWS: Final = (
    Fault(CONTINUOUS_OVER_CURRENT, "continuous over-current"),
    Fault(SHORT_CIRCUIT, "short circuit", at_once=True),
    Fault(MAINS_OVER_VOLTAGE, "mains over-voltage", at_once=True),
    Fault(MAINS_UNDER_VOLTAGE, "mains under-voltage"),
    Fault(OVER_VOLTAGE, "DC-link over-voltage", at_once=True),
    Fault(UNDER_VOLTAGE, "DC-link under-voltage", at_once=True),
    Fault(DEVICE_TEMPERATURE, "device too hot"),
    Fault(DRIVE_TEMPERATURE, "drive too hot"),
    Fault(MEMORY, "EEPROM", resettable=False),
    Fault(0x7121, "motor blocked"),
    Fault(0x7122, "motor error, or commutation", at_once=True),
    Fault(0x7300, "sensor"),
    Fault(ENCODER, "incremental sensor 1", at_once=True),
    Fault(COMMUNICATION_LOST, "communication"),
    Fault(ERROR_PASSIVE, "CAN error passive"),
    Fault(HEARTBEAT_LOST, "heartbeat lost"),
    Fault(BUS_OFF_RECOVERED, "recovered from bus-off"),
    Fault(0x8400, "velocity controller"),
    Fault(FOLLOWING_ERROR, "following error"),
    Fault(
        SAFE_TORQUE_OFF, "safe torque off", at_once=True
    ),  # as in maxon's EPOS4 and INVT's joints
)
FAULTS: Final[dict[int, Fault]] = {row.code: row for row in _ROWS}


def error_register(code: int) -> int:
    """Return the bits of 1001h for an error code; generic (bit 0) is always set."""
    if code >> 12 == 0x8:
        return GENERIC | (COMMUNICATION if code < _COMMUNICATION_BELOW else PROFILE)
    return GENERIC | (VENDOR if code >> 8 == _OF_VENDOR else _CLASSES.get(code >> 12, 0))


def is_at_once(code: int) -> bool:
    """Return True if the fault switches the power stage off immediately, regardless of 605Eh."""
    row = FAULTS.get(code)
    return row is not None and row.at_once


def is_resettable(code: int) -> bool:
    """Return True if controlword bit 7 resets the fault once its cause is gone."""
    row = FAULTS.get(code)
    return row is None or row.resettable


def told(code: int) -> str:
    """Describe the fault in words, for the record."""
    row = FAULTS.get(code)
    return f"fault {code:04X}h" + (f" ({row.text})" if row is not None else "")


@final
class Standing:
    """Present faults, warnings and inhibits of the drive, in any state.

    Attributes:
        causes: error codes whose cause is present; no fault can be reset meanwhile.
        noted: error codes since the last reset; each can block the next reset.
        torque_off: True while "safe torque off" is requested; blocks transition 2.
        warnings: one bit per source of a warning; any of them sets statusword bit 7.
        seen: flags last reported by the axis of a nonlinear plant.
    """

    def __init__(self) -> None:
        self.causes: list[int] = []
        self.noted: list[int] = []
        self.torque_off: bool = False
        self.warnings: int = 0
        self.seen: int = 0

    def note(self, code: int) -> int:
        """Note the error code of a fault, and return it."""
        if code not in self.noted:
            self.noted.append(code)
        return code

    def lets_reset(self, has_supply: bool) -> bool:
        """Return True if controlword bit 7 may cause transition 15."""
        if self.causes or (UNDER_VOLTAGE in self.noted and not has_supply):
            return False
        return all(is_resettable(code) for code in self.noted)

    def add(self, code: int) -> bool:
        """Add the cause of a fault; return True if it is new."""
        if code in self.causes:
            return False
        self.causes.append(code)
        return True

    def remove(self, code: int) -> None:
        """Remove the cause of a fault, which then waits for its reset."""
        if code in self.causes:
            self.causes.remove(code)

    def warn(self, bit: int, warns: bool) -> None:
        """Set or clear the warning bit of one source."""
        self.warnings = self.warnings | bit if warns else self.warnings & ~bit

    def see(self, seen: int, is_on: bool) -> list[int]:
        """Handle changed flags of the axis; return the error codes of the resulting faults.

        Under-voltage is a fault only while the motor has current (`is_on`).
        """
        self.seen = seen
        self.warn(WARNED_BY_FLAGS, seen & WARNING_FLAGS != 0)
        codes = [UNDER_VOLTAGE] if is_on and seen & f.UNDER_VOLTAGE else []
        for flag, code in OF_FLAGS:
            if not seen & flag:
                self.remove(code)
            elif self.add(code):
                codes.append(code)
        return codes
