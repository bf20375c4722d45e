"""Small hand-made recordings for tests of programs that read recordings."""

import struct

from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import (
    CAN_FRAME,
    JOINT_STATE,
    LOG,
    MODBUS_ADU,
    Direction,
    JointStateEncoder,
    Level,
    Schema,
    encode_log,
)

S = 1_000_000_000
MS = 1_000_000
RIG = b"""
[rig]
name = "two"
[controller.left]
bus = "can0"
node_id = 1
eds = "left.eds"
[controller.right]
bus = "can0"
node_id = 2
[controller.lift]
bus = "rs485"
unit = 3
[motor.left_wheel]
controller = "left"
[motor.right_wheel]
bus = "can0"
node_id = 2
"""
EDS = b"[2020]\nParameterName=Winding temperature\nDataType=0x4\n"


class Recorded:
    """A small hand-made recording."""

    def __init__(self, path):
        self.path = str(path)
        self.writer = TraceWriter(path, {"run": {}})
        self.writer.attach("two.toml", RIG, "application/toml")
        self.writer.attach("left.eds", EDS, "text/plain")
        self.channels = {}
        self.can0 = self.writer.channel("/can/can0", Schema.of(CAN_FRAME))
        self.source = self.writer.source(self.can0, "host", Direction.TRANSMITTED)

    def channel(self, topic, table):
        """Return the channel of this topic."""
        if topic not in self.channels:
            self.channels[topic] = self.writer.channel(topic, Schema.of(table))
        return self.channels[topic]

    def frame(self, time_ns, identifier, data):
        content = bytes.fromhex(data)
        frame = struct.pack("<IB3x8s", identifier, len(content), content)
        self.writer.extend([(self.source, time_ns, frame)])
        return self

    def message(self, time_ns, topic, table, values):
        self.writer.write(self.channel(topic, table), time_ns, encode(table, values))
        return self

    def event(self, time_ns, text, name=""):
        channel = self.channel("/events", LOG)
        self.writer.write(channel, time_ns, encode_log(time_ns, Level.WARNING, text, name))
        return self

    def modbus(self, time_ns, data, request):
        direction = Direction.TRANSMITTED if request else Direction.RECEIVED
        values = {"direction": direction, "data": bytes.fromhex(data), "tcp": True}
        return self.message(time_ns, "/modbus/rs485", MODBUS_ADU, values)

    def position(self, time_ns, motor, position):
        channel = self.channel(f"/motor/{motor}/state", JOINT_STATE)
        self.writer.write(channel, time_ns, JointStateEncoder(motor).encode(position, None, None))
        return self

    def sdo(self, time_ns, node, request, response):
        """Write a request and, 1 ms later, its response."""
        self.frame(time_ns, 0x600 + node, request.ljust(16, "0"))
        return self.frame(time_ns + MS, 0x580 + node, response.ljust(16, "0"))

    def close(self):
        self.writer.close()
        return self.path
