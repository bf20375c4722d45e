"""Refusals and protocol violations of CANopen devices."""

from typing import Final, final

from motorhil.motorapi.errors import PeerError

NO_SUCH_OBJECT: Final = 0x0602_0000
# CiA 301, SDO abort codes.
_ABORT_TEXT: Final[dict[int, str]] = {
    0x0503_0000: "toggle bit not alternated",
    0x0504_0000: "SDO protocol timed out",
    0x0504_0001: "command specifier not valid or unknown",
    0x0504_0002: "invalid block size",
    0x0504_0003: "invalid sequence number",
    0x0504_0004: "CRC error",
    0x0504_0005: "out of memory",
    0x0601_0000: "unsupported access to an object",
    0x0601_0001: "attempt to read a write only object",
    0x0601_0002: "attempt to write a read only object",
    NO_SUCH_OBJECT: "object does not exist in the object dictionary",
    0x0604_0041: "object cannot be mapped to the PDO",
    0x0604_0042: "number and length of the objects to be mapped would exceed PDO length",
    0x0604_0043: "general parameter incompatibility",
    0x0604_0047: "general internal incompatibility in the device",
    0x0606_0000: "access failed due to a hardware error",
    0x0607_0010: "data type does not match, length of service parameter does not match",
    0x0607_0012: "data type does not match, length of service parameter too high",
    0x0607_0013: "data type does not match, length of service parameter too low",
    0x0609_0011: "sub-index does not exist",
    0x0609_0030: "invalid value for parameter",
    0x0609_0031: "value of parameter written too high",
    0x0609_0032: "value of parameter written too low",
    0x0609_0036: "maximum value is less than minimum value",
    0x060A_0023: "resource not available: SDO connection",
    0x0800_0000: "general error",
    0x0800_0020: "data cannot be transferred or stored to the application",
    0x0800_0021: "data cannot be transferred or stored because of local control",
    0x0800_0022: "data cannot be transferred or stored because of the present device state",
    0x0800_0023: "object dictionary dynamic generation fails or none is present",
    0x0800_0024: "no data available",
}


@final
class SdoAborted(PeerError):
    """The server aborted an SDO transfer (CiA 301, SDO abort transfer protocol).

    The attributes hold the facts, so that a caller never parses the message: node_id 1..127, index
    0..FFFFh, subindex 0..FFh, abort_code (unsigned 32 bit).
    """

    def __init__(self, *, node_id: int, index: int, subindex: int, abort_code: int) -> None:
        self.node_id = node_id
        self.index = index
        self.subindex = subindex
        self.abort_code = abort_code
        text = _ABORT_TEXT.get(abort_code, "code not listed in CiA 301")
        super().__init__(
            f"node {node_id}: SDO {index:04X}h:{subindex:02X}h aborted: {text} ({abort_code:08X}h)"
        )


@final
class ProtocolViolation(PeerError):
    """The device sent an answer that the protocol does not allow.

    Attributes: node_id, where ("SDO 6041h:00h"), problem (in words).
    """

    def __init__(self, *, node_id: int, where: str, problem: str) -> None:
        self.node_id = node_id
        self.where = where
        self.problem = problem
        super().__init__(f"node {node_id}: {where}: {problem}")
