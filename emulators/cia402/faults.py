"""What a drive finds wrong: error code (603Fh), bits of 1001h, reaction, way out; one table.

The codes are those of CiA 301 (7.2.7.1) and of the list in CiA 402-1; the bits of the error
register are CiA 301's (7.5.2.2). The standards leave the reaction to the vendor. Here:

- *By 605Eh* brakes as the fault reaction option code says, as Technosoft's iPOS does on I2t,
  under-voltage and excess temperature (manual P091.063, 5.4.9).
- *At once* switches the power stage off in that instant, and the motor coasts: a power stage that
  protects itself cannot brake (a short circuit; an over-voltage, which braking would raise; an
  under-voltage), and without a sensor no loop can be closed, nor a motor commutated.

A fault is reset by an edge of controlword bit 7 once its cause is gone; as long as it stands the
edge does nothing (so do iPOS drives: yarp-devices issue 215). What memory has lost comes back with
the next reset node only.
"""

from typing import Final, final

from emulators.canopen import can_state, emcy
from emulators.firmware import flags as f
from emulators.protection_settings import STO_ERROR

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

# What the axis says of itself, and the fault that it is while it says so; in any state.
OF_FLAGS: Final = (
    (f.OVER_VOLTAGE, OVER_VOLTAGE),
    (f.OVER_TEMPERATURE, DRIVE_TEMPERATURE),
    (f.I2T_LIMIT, CONTINUOUS_OVER_CURRENT),
)
WARNING_FLAGS: Final = f.TEMPERATURE_WARNING | f.I2T_WARNING
WARNED_BY_FLAGS: Final = 1  # bits of Standing.warnings
WARNED_BY_INPUT: Final = 2

# What the standards leave to the reader: the bits by the code's first digits.
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
        code: 603Fh, and the EMCY's.
        text: for a person.
        at_once: the power stage goes off in that instant; otherwise 605Eh says.
        resettable: whether controlword bit 7 gets rid of it.
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
    Fault(SAFE_TORQUE_OFF, "safe torque off", at_once=True),  # maxon's EPOS4, INVT's joints
)
FAULTS: Final[dict[int, Fault]] = {row.code: row for row in _ROWS}


def error_register(code: int) -> int:
    """The bits of 1001h that go with an error code; generic (bit 0) always does."""
    if code >> 12 == 0x8:
        return GENERIC | (COMMUNICATION if code < _COMMUNICATION_BELOW else PROFILE)
    return GENERIC | (VENDOR if code >> 8 == _OF_VENDOR else _CLASSES.get(code >> 12, 0))


def is_at_once(code: int) -> bool:
    """Whether the power stage goes off in the instant of the fault, whatever 605Eh says."""
    row = FAULTS.get(code)
    return row is not None and row.at_once


def is_resettable(code: int) -> bool:
    """Whether an edge of controlword bit 7 resets the fault, once its cause is gone."""
    row = FAULTS.get(code)
    return row is None or row.resettable


def told(code: int) -> str:
    """The fault in words, for the record."""
    row = FAULTS.get(code)
    return f"fault {code:04X}h" + (f" ({row.text})" if row is not None else "")


@final
class Standing:
    """What stands against the drive, whatever its state.

    Attributes:
        causes: error codes whose cause is there; meanwhile no fault can be reset.
        noted: the error codes since the last reset; each may stand in the way of the next one.
        torque_off: the input "safe torque off" is demanded; meanwhile transition 2 is not taken.
        warnings: a bit for each thing that warns; any is statusword bit 7.
        seen: what the axis last said of a plant with extras, in its flags.
    """

    def __init__(self) -> None:
        self.causes: list[int] = []
        self.noted: list[int] = []
        self.torque_off: bool = False
        self.warnings: int = 0
        self.seen: int = 0

    def note(self, code: int) -> int:
        """A fault has this error code; the same."""
        if code not in self.noted:
            self.noted.append(code)
        return code

    def lets_reset(self, has_supply: bool) -> bool:
        """Whether an edge of controlword bit 7 may take transition 15."""
        if self.causes or (UNDER_VOLTAGE in self.noted and not has_supply):
            return False
        return all(is_resettable(code) for code in self.noted)

    def add(self, code: int) -> bool:
        """The cause of this fault has come; whether that is news."""
        if code in self.causes:
            return False
        self.causes.append(code)
        return True

    def remove(self, code: int) -> None:
        """The cause is gone; the fault waits for its reset."""
        if code in self.causes:
            self.causes.remove(code)

    def warn(self, bit: int, warns: bool) -> None:
        """Whoever has this bit warns, or no longer."""
        self.warnings = self.warnings | bit if warns else self.warnings & ~bit

    def see(self, seen: int, is_on: bool) -> list[int]:
        """What the axis says of its plant has changed; the error codes of the faults it comes to.

        Too little voltage is one only while the motor has current (`is_on`).
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
