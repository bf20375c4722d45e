"""What goes over a line is in the record, byte for byte, with the line's own times."""

import pytest

from harness.rig import Rig
from tests.traces.protobuf_classes import google_class
from traces.reader import read_trace
from traces.schema import MODBUS_ADU

REQUEST = bytes.fromhex("010300000001840A")


def recorded(path):
    with read_trace(path) as trace:
        adu_class = google_class(MODBUS_ADU)
        return [
            (log_time_ns, adu_class.FromString(payload))
            for channel, log_time_ns, payload in trace.messages()
            if channel.topic == "/modbus/line"
        ]


@pytest.mark.parametrize("kind", ["modbus_rtu", "modbus_tcp"])
def test_adus_are_recorded_as_they_were_on_the_wire(tmp_path, kind):
    rig_file, trace = tmp_path / "rig.toml", tmp_path / "out.mcap"
    rig_file.write_text(f'[bus.line]\nkind = "{kind}"\n')
    adu = REQUEST if kind == "modbus_rtu" else bytes.fromhex("000500000006010300000001")
    with Rig.open(rig_file, record=trace) as rig:
        line = rig.line("line")
        line.send(adu)
        rig.runtime.wait_until(lambda: False, 0.1)
    sent = recorded(trace)[0]
    log_time_ns, message = sent
    assert message.data == adu
    assert (message.sender, message.direction) == ("host", 2)
    if kind == "modbus_rtu":
        assert (message.start_ns, message.end_ns) == (0, 8 * 11 * 10**9 // 19_200)
        assert log_time_ns == message.end_ns + 35 * 11 * 10**9 // (10 * 19_200)
        assert not message.tcp
    else:
        assert message.start_ns == message.end_ns == log_time_ns == 50_000
        assert message.tcp
        # nobody is behind this gateway, and it says so
        assert recorded(trace)[1][1].data == bytes.fromhex("00050000000301830B")
        assert recorded(trace)[1][1].sender == "line"
