"""The meaning of each kind's messages: requests, answers, motions and faults.

A message is that of the kind's decoder in `motorhil.traces.decoding`, and its frame beside it.
Where makers or firmwares differ, a request need not be answered, and its answer is no surplus.

Source: the sources that the decoders name.
"""

from collections.abc import Callable, Mapping
from typing import Final, final

from motorhil.frozen import frozen
from motorhil.traces.decoding import dynamixel, mit, moteus, rmd, vesc
from motorhil.traces.decoding.narrative import BusMessage

_EFF: Final = 0x8000_0000
_NODE_MAX: Final = 255
_ALL_SERVOS: Final = 0xFE
_RESTART_S: Final = 5.0
_ZERO_S: Final = 2.0  # CubeMars drives are deaf for 1.5 s after the zero was set
_TORQUE: Final = 0.05  # above the code beside 0


@final
@frozen
class Told:
    """The meaning of a message, to or from one drive.

    Attributes:
        asks: what is asked of the drive; "": nothing that is answered.
        may_ask: the same, if some drives do not answer it.
        answers: what it answers; "": it is no answer.
        is_own: True if the drive sent it.
        is_unasked: True if the drive sends such answers also by itself.
        reads: True if it only reads, or keeps alive.
        moves: True if it commands a motion.
        rests: True if it switches the motor off.
        clears: True if it resets a fault, or restarts the drive.
        fault: the fault that it tells; "": none; None: it tells nothing of faults.
        is_starved: True if the drive tells that it had no commands in time; None: nothing of that.
        quiet_s: time for which the drive need not answer [s].
    """

    asks: str = ""
    may_ask: str = ""
    answers: str = ""
    is_own: bool = False
    is_unasked: bool = False
    reads: bool = False
    moves: bool = False
    rests: bool = False
    clears: bool = False
    fault: str | None = None
    is_starved: bool | None = None
    quiet_s: float = 0.0


Read = Callable[[bytes, BusMessage], Told]
Decode = Callable[[bytes], BusMessage | None]


CAN_KINDS: Final = ("mit", "robstride", "rmd", "moteus", "vesc")
LINE_KINDS: Final = ("dynamixel",)
"""Kinds on serial lines that are not Modbus lines."""


def readers_of(kind: str, node: int, table: Mapping[str, object]) -> tuple[Decode, Read] | None:
    """Return decoder and meaning for one drive; None: its kind or number is not known here.

    The table may be from anybody's recording.
    """
    if not 0 <= node <= _NODE_MAX:
        return None
    if kind == "mit":
        return mit.build(node, table), _mit
    if kind == "robstride":
        return mit.build_robstride(node, table), _robstride
    plain: dict[str, tuple[Callable[[int], Decode], Read]] = {
        "rmd": (rmd.build, _rmd),
        "moteus": (moteus.build, _moteus),
        "vesc": (vesc.build, _vesc),
        "dynamixel": (dynamixel.build, _dynamixel),
    }
    if kind not in plain:
        return None
    build, read = plain[kind]
    return build(node), read


def _values(message: BusMessage) -> dict[str, int | float | str]:
    return {one.name: one.value for one in message.signals}


def _identifier(frame: bytes) -> int:
    return int.from_bytes(frame[:4], "little") & ~_EFF


def _is_torque(values: Mapping[str, int | float | str]) -> bool:
    """Return True for a command with stiffness, damping or torque."""
    stiff = any(float(values.get(name, 0.0)) > 0.0 for name in ("kp", "kd"))
    return stiff or abs(float(values.get("t", 0.0))) > _TORQUE


# ---- MIT, RobStride


def _mit(frame: bytes, message: BusMessage) -> Told:
    values, name = _values(message), message.name
    if name == "State":
        fault = None
        if "state" in values:
            fault = "" if values["state"] in ("disabled", "enabled") else str(values["state"])
        elif "fault" in values:
            fault = f"fault {values['fault']}" if values["fault"] else ""
        return Told(answers="state", is_own=True, fault=fault)
    if name == "Command":
        return Told(asks="state", moves=_is_torque(values))
    clears = name in ("Clear_Errors", "Enter", "Leave")
    return Told(may_ask="state", clears=clears, quiet_s=_ZERO_S if name == "Set_Zero" else 0.0)


def _robstride(frame: bytes, message: BusMessage) -> Told:
    values, name, identifier = _values(message), message.name, _identifier(frame)
    kind, is_value = identifier >> 24, message.name.startswith("Read")
    if kind == 2:
        told = f"faults {int(values['faults']):02X}h" if values.get("faults") else ""
        return Told(answers="feedback", is_own=True, fault=told)
    if kind == 21:
        return Told(is_own=True, fault="a fault by itself")
    if is_value and any(frame[12:16]):  # a reading has no value
        return Told(answers="parameter", is_own=True)
    if is_value:
        return Told(may_ask="parameter", reads=True)
    clears = name in ("Enable", "Stop")
    if name in ("Motion", "Enable", "Stop"):
        return Told(asks="feedback", clears=clears, moves=name == "Motion" and _is_torque(values))
    quiet_s = _ZERO_S if name == "Set_Zero" else 0.0
    return Told(may_ask="feedback", quiet_s=quiet_s)


# ---- RMD

_RMD_MOVES: Final = (
    *("torque current", "speed", "absolute position", "incremental position"),
    "single-turn position",
)
_RMD_READS: Final = (
    *("read gain", "read acceleration", "encoder position", "raw encoder position"),
    *("encoder offset", "operating mode", "power", "single-turn encoder", "multi-turn angle"),
    *("single-turn angle", "status 1", "status 2", "status 3", "run time", "software date"),
    "model",
)
_RMD_SILENT: Final = ("reset", "CAN ID", "active reply", "zero here", "write encoder offset")
_RMD_UNASKED: Final = ("status 1", "communication interrupted")


def _rmd(frame: bytes, message: BusMessage) -> Told:
    name = message.name.removesuffix(" answered").removesuffix(" to all")
    if message.name.endswith(" answered") or name == "communication interrupted":
        fault = None
        if name == "status 1":
            errors = _values(message).get("errors", 0)
            fault = str(errors) if errors else ""
        return Told(
            answers=name,
            is_own=True,
            is_unasked=name in _RMD_UNASKED,
            fault=fault,
            is_starved=name == "communication interrupted",
        )
    if name in _RMD_SILENT:
        restarts = name == "reset"
        return Told(may_ask=name, clears=restarts, quiet_s=_RESTART_S if restarts else 0.0)
    rests = name == "shutdown"
    moves = name in _RMD_MOVES or (name == "motion mode" and _is_torque(_values(message)))
    return Told(asks=name, reads=name in _RMD_READS, moves=moves, rests=rests)


# ---- moteus


def _moteus(frame: bytes, message: BusMessage) -> Told:
    mode = _values(message).get("mode")
    if message.name == "Reply":
        fault = None if mode is None else "mode fault" if mode == "fault" else ""
        starved = None if mode is None else mode == "position timeout"
        return Told(answers="reply", is_own=True, fault=fault, is_starved=starved)
    asks = "reply" if message.name == "Query" else ""
    moves = mode is not None and mode not in ("stopped", "fault", "brake")
    reads = all(one.name == "read" for one in message.signals)
    rests = mode == "stopped"
    return Told(asks=asks, reads=reads, moves=moves, rests=rests, clears=rests)


# ---- VESC

_VESC_MOVES: Final = ("SET_DUTY", "SET_CURRENT", "SET_RPM", "SET_POS", "SET_CURRENT_REL")
_VESC_ANSWERED: Final = ("FW_VERSION", "GET_VALUES", "GET_VALUES_SELECTIVE")
_VESC_ENDS: Final = ("PROCESS_SHORT_BUFFER", "PROCESS_RX_BUFFER")


def _vesc(frame: bytes, message: BusMessage) -> Told:
    values, (name, _, to) = _values(message), message.name.partition(" to ")
    if name in _VESC_ENDS and to not in ("", "all"):
        fault = values.get("fault")
        told = None if fault is None else "" if fault == "none" else str(fault)
        return Told(answers="packet", is_own=True, fault=told)
    if name == "PONG":
        return Told(answers="ping", is_own=True)
    if name == "PING":
        return Told(asks="ping", reads=True)
    if name.startswith(("STATUS", "NOTIFY")):
        return Told(is_own=True)
    if name in _VESC_ENDS:
        packet = values.get("packet", "")
        is_answered = packet in _VESC_ANSWERED and values.get("mode") in (0, 3)
        restarts = packet == "REBOOT"
        return Told(
            asks="packet" if is_answered else "",
            may_ask="" if is_answered or values.get("mode") == 2 else "packet",
            reads=is_answered or packet == "ALIVE",
            moves=packet in _VESC_MOVES,
            clears=restarts,
            quiet_s=_RESTART_S if restarts else 0.0,
        )
    is_still = next(iter(values.values()), 0) == 0 and name not in ("SET_RPM", "SET_POS")
    return Told(moves=name in _VESC_MOVES and not is_still)


# ---- Dynamixel

_EXPIRED: Final = 255  # in the register of the bus watchdog
_GOALS: Final = ("Goal_PWM", "Goal_Current", "Goal_Velocity", "Goal_Position")
_SERVO_RESTARTS: Final = ("Reboot", "Factory_Reset", "Control_Table_Backup")
_SERVO_READS: Final = ("Read", "Ping", "Sync_Read", "Bulk_Read", "Fast_Sync_Read", "Fast_Bulk_Read")
_SERVO_WRITES: Final = ("Write", "Sync_Write", "Bulk_Write")


def _dynamixel(frame: bytes, message: BusMessage) -> Told:
    values, name = _values(message), message.name
    if name in ("Status", "Fast_Status"):
        fault = None
        if "Torque_Enable" in values and "Hardware_Error_Status" in values:
            bits = int(values["Hardware_Error_Status"])
            fault = f"hardware error {bits:02X}h" if bits and not values["Torque_Enable"] else ""
        watchdog = values.get("Bus_Watchdog")
        starved = None if watchdog is None else watchdog == _EXPIRED
        return Told(answers="status", is_own=True, fault=fault, is_starved=starved)
    if name in _SERVO_READS:
        return Told(asks="status", reads=True)
    is_to_all = frame[4:5] == bytes((_ALL_SERVOS,))
    restarts = name in _SERVO_RESTARTS
    return Told(
        may_ask="" if is_to_all else "status",
        moves=name in _SERVO_WRITES and any(goal in values for goal in _GOALS),
        rests=name in _SERVO_WRITES and values.get("Torque_Enable") == 0,
        clears=restarts,
        quiet_s=_RESTART_S if restarts else 0.0,
    )
