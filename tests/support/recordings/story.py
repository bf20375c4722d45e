"""Hand-written frames of a drive on a bus: sound, and easy to alter.

Node 1 boots, is set up by SDO (its PDOs and limits), switches on, moves to 500, has a fault, and is
reset. Its CAN controller has errors up to bus-off and is restarted. Then the drive is switched off.
Bytes follow CiA 301 and 402-2, and linux/can/error.h.
"""

import struct

from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import (
    CAN_FRAME,
    LOG,
    MOTOR_LOCK,
    Direction,
    Level,
    LockAction,
    Schema,
    encode_log,
)

MS = 1_000_000
RIG = b"""
[rig]
name = "one"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.left]
bus = "can0"
node_id = 1
[motor.wheel]
controller = "left"
[motor.wheel.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 4.0
position_min_rad = -1.0
position_max_rad = 1.0
increments_per_rad = 1000.0
velocity_unit_rad_s = 0.001
acceleration_unit_rad_s2 = 0.001
"""
SET_UP = (  # objects read by the client: index, sub-index, bytes, value
    *((0x1000, 0, 4, 0x20192), (0x1014, 0, 4, 0x81), (0x1017, 0, 2, 100)),
    *((0x1600, 1, 4, 0x60400010), (0x1600, 0, 1, 1)),
    *((0x1A00, 1, 4, 0x60410010), (0x1A00, 2, 4, 0x60640020), (0x1A00, 0, 1, 2)),
    *((0x1A01, 1, 4, 0x60770010), (0x1A01, 2, 4, 0x606C0020), (0x1A01, 0, 1, 2)),
    *((0x1A02, 1, 4, 0x60F40020), (0x1A02, 0, 1, 1)),
    *((0x6061, 0, 1, 1), (0x6065, 0, 4, 50), (0x6066, 0, 2, 0), (0x6067, 0, 4, 5)),
    *((0x607D, 1, 4, -1000), (0x607D, 2, 4, 1000), (0x607F, 0, 4, 1500), (0x6072, 0, 2, 1000)),
)
WRITTEN = ((0x6083, 4, 4000), (0x6081, 4, 1000), (0x607A, 4, 500))
STATUS = (  # ms, statusword, position: TPDO 1
    *((300, 0x0250, 0), (420, 0x0231, 0), (440, 0x0233, 0), (460, 0x0237, 0)),
    *((520, 0x1237, 0), (700, 0x0237, 250), (900, 0x0637, 500), (1100, 0x0637, 501)),
    *((1300, 0x0637, 500), (1402, 0x021F, 500), (1420, 0x0218, 500), (1620, 0x0250, 500)),
    *((1700, 0x0250, 500),),
)
CONTROL = (  # ms, controlword: RPDO 1
    *((410, 0x06), (430, 0x07), (450, 0x0F), (510, 0x1F), (530, 0x0F), (1590, 0x00), (1610, 0x80)),
)
ERRORS = (  # ms, class, data: of node 1's CAN controller
    *((1660, 0x204, "0008000000006000"), (1665, 0x288, "0000840a00006800")),  # TX warning, 96
    *((1670, 0x204, "0020000000008000"), (1680, 0x240, "000000000000ff00")),  # passive, bus-off
    *((1690, 0x300, "0000000000000000"),),  # restarted
)


def error(ms, classes, data):
    """Return an error frame of node 1's CAN controller."""
    return ms, 0x2000_0000 | classes, bytes.fromhex(data)


def sdo(ms, index, subindex, size, value):
    """Yield an upload request and, 1 ms later, the server's answer."""
    place = struct.pack("<HB", index, subindex)
    data = (value % (1 << 8 * size)).to_bytes(size, "little").ljust(4, b"\0")
    yield ms, 0x601, b"\x40" + place + bytes(4)
    yield ms + 1, 0x581, bytes([0x43 | 4 - size << 2]) + place + data


def written(ms, index, size, value):
    """Yield a download and, 1 ms later, its confirmation."""
    place = struct.pack("<HB", index, 0)
    yield ms, 0x601, bytes([0x23 | 4 - size << 2]) + place + value.to_bytes(4, "little")
    yield ms + 1, 0x581, b"\x60" + place + bytes(4)


def story():
    """Return the frames (ms, identifier, data) by time."""
    frames = [(1, 0x701, b"\0"), (290, 0x000, b"\x01\x01")]
    for number, (index, subindex, size, value) in enumerate(SET_UP):
        frames += sdo(10 + 4 * number, index, subindex, size, value)
    for number, (index, size, value) in enumerate(WRITTEN):
        frames += written(470 + 4 * number, index, size, value)
    frames += [(ms, 0x181, struct.pack("<Hi", word, at)) for ms, word, at in STATUS]
    frames += [(ms, 0x201, struct.pack("<H", word)) for ms, word in CONTROL]
    for ms in range(305, 1700, 50):  # TPDO 2 and 3
        moving, powered = 520 <= ms < 900, 460 <= ms < 1402
        frames.append((ms, 0x281, struct.pack("<hi", 300 * powered, 1000 * moving)))
        frames.append((ms, 0x381, struct.pack("<i", 20 * moving)))
    frames += [(ms, 0x701, b"\x05") for ms in range(150, 2701, 100)]
    frames += [(ms, 0x080, b"") for ms in range(300, 1700, 10)]
    frames.append((1401, 0x081, bytes.fromhex("1186210000000000")))
    frames += [error(*one) for one in ERRORS]
    return sorted(frames, key=lambda frame: frame[0])


def record(path, frames, senders=None, locks=(), metadata=None, said=()):
    """Record these frames with `senders` by identifier, otherwise "host".

    Args:
        path: the file.
        frames: (ms, identifier, data), optionally with a sender.
        senders: senders by identifier.
        locks: (ms, action, owner).
        metadata: of the recording; None: that of a run.
        said: texts of events.
    """
    metadata = {"run": {}} if metadata is None else metadata
    with TraceWriter(path, metadata) as writer:
        writer.attach("one.toml", RIG, "application/toml")
        bus = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        lock = writer.channel("/motor/wheel/lock", Schema.of(MOTOR_LOCK)) if locks else 0
        for text in said:
            log = writer.channel("/events", Schema.of(LOG))
            writer.write(log, 0, encode_log(0, Level.WARNING, text, "can0"))
        sources = {}
        events = [(ms, 1, frame) for ms, *frame in frames] + [(ms, 0, one) for ms, *one in locks]
        for ms, is_frame, what in sorted(events, key=lambda one: one[:2]):
            if not is_frame:
                action, who = what
                values = {"action": action.value, "owner": who, "sender": who, "token": 1}
                writer.write(lock, ms * MS, encode(MOTOR_LOCK, values))
                continue
            identifier, data, *told = what
            is_own = identifier >> 7 in (1, 3, 5, 7, 11, 14) and identifier & 127
            own = "left" if is_own or identifier >> 29 else "host"
            sender = told[0] if told else (senders or {}).get(identifier, own)
            if sender not in sources:
                sources[sender] = writer.source(bus, sender, Direction.UNKNOWN)
            frame = struct.pack("<IB3x8s", identifier, len(data), data)
            writer.extend([(sources[sender], ms * MS, frame)])
    return path


TAKEN = LockAction.TAKEN
RELEASED = LockAction.RELEASED
