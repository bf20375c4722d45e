"""Function codes, exception codes and limits of the Modbus protocol.

Source: MODBUS Application Protocol Specification V1.1b3, sections 6 and 7.
"""

from typing import Final

READ_COILS: Final = 0x01
READ_DISCRETE_INPUTS: Final = 0x02
READ_HOLDING_REGISTERS: Final = 0x03
READ_INPUT_REGISTERS: Final = 0x04
WRITE_SINGLE_COIL: Final = 0x05
WRITE_SINGLE_REGISTER: Final = 0x06
DIAGNOSTICS: Final = 0x08
WRITE_MULTIPLE_COILS: Final = 0x0F
WRITE_MULTIPLE_REGISTERS: Final = 0x10
REPORT_SERVER_ID: Final = 0x11
MASK_WRITE_REGISTER: Final = 0x16
READ_WRITE_MULTIPLE_REGISTERS: Final = 0x17
ENCAPSULATED_INTERFACE: Final = 0x2B

ERROR: Final = 0x80
"""The flag of an exception response in the function code."""

OK: Final = 0
ILLEGAL_FUNCTION: Final = 0x01
ILLEGAL_DATA_ADDRESS: Final = 0x02
ILLEGAL_DATA_VALUE: Final = 0x03
SERVER_DEVICE_FAILURE: Final = 0x04
ACKNOWLEDGE: Final = 0x05
SERVER_DEVICE_BUSY: Final = 0x06
GATEWAY_PATH_UNAVAILABLE: Final = 0x0A
GATEWAY_TARGET_FAILED: Final = 0x0B

READ_BITS_MAX: Final = 2000
READ_REGISTERS_MAX: Final = 125
WRITE_BITS_MAX: Final = 1968
WRITE_REGISTERS_MAX: Final = 123
READ_WRITE_WRITE_MAX: Final = 121
PDU_MAX: Final = 253

BROADCAST: Final = 0
"""The server address of a request to all."""
UNITS: Final = range(1, 248)
"""The server addresses on a serial line; 248 to 255 are reserved."""
