"""Recorded Modbus lines: bytes and times as on the line."""

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.traces.formats.modbus import all_adus, recorded_adu
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import MODBUS_ADU
from tests.support.recordings.protobuf_classes import google_class
from tests.unit.traces.formats.pairing import paired

REQUEST = bytes.fromhex("010300000001840A")


def adu_in(one):
    """Return the ADU of a recorded message, at the time of its last bit."""
    values = decode(MODBUS_ADU, one.payload)
    return recorded_adu(values, values["end_ns"])


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
        # no unit is behind this gateway, so it answers itself
        assert recorded(trace)[1][1].data == bytes.fromhex("00050000000301830B")
        assert recorded(trace)[1][1].sender == "line"


MAST = """\
[bus.line]
kind = "{kind}"
[controller.mast]
kind = "leadshine_pr"
bus = "line"
unit = 1
plant = {{ preset = "mast_20w" }}
[motor.mast]
adaptation = "leadshine"
controller = "mast"
model = {{ gear_ratio = 100.0, velocity_max_rad_s = 1.0, acceleration_max_rad_s2 = 2.0 }}
"""


@pytest.mark.parametrize("kind", ["modbus_rtu", "modbus_tcp"])
def test_requests_and_responses_of_a_record_are_paired(tmp_path, kind):
    rig_file, record = tmp_path / "rig.toml", tmp_path / "out.mcap"
    rig_file.write_text(MAST.format(kind=kind))
    with Rig.open(rig_file, record=record) as rig:
        mast = rig.motors["mast"]
        mast.enable()
        lose = SerialFaultRule("lose", SerialFaultKind.LOSE, sender="mast", limit=1)
        rig.faults.inject("line", lose)
        position = mast.position()
    with read_trace(record) as trace:
        recorded_lines = list(all_adus(trace))
        assert {one.line for one in recorded_lines} == {"line"}
        adus = [adu_in(one) for one in recorded_lines]
    pairing = paired(adus)
    booting = [one for one in pairing.exchanges if one.response is None][:-1]
    answered = [one for one in pairing.exchanges if one.response is not None]
    assert position == 0.0
    assert pairing.strays == ()
    assert len(answered) >= 6
    # no answers during boot-up, and one later answer was lost
    assert len(pairing.exchanges) == len(answered) + len(booting) + 1
    if kind == "modbus_rtu":
        assert all(one.delay_s > 0.002 + 0.002 for one in answered)
    assert {one.request.unit for one in pairing.exchanges} == {1}


def test_corrupted_adus_are_reported_as_such(tmp_path):
    rig_file, record = tmp_path / "rig.toml", tmp_path / "out.mcap"
    rig_file.write_text('[bus.line]\nkind = "modbus_rtu"\n')
    pause = SerialFaultRule("pause", SerialFaultKind.PAUSE, after=3, delay_ns=1_200_000, limit=1)
    with Rig.open(rig_file, record=record) as rig:
        rig.faults.inject("line", pause)
        for data in (REQUEST, REQUEST[:-1] + b"\0", b"\1\2", REQUEST):
            rig.line("line").send(data)
            rig.runtime.wait_until(lambda: False, 0.1)
    with read_trace(record) as trace:
        found = [adu_in(one) for one in all_adus(trace)]
    assert [getattr(one, "problem", "") for one in found] == [
        "corrupted on the line",
        "wrong CRC",
        "2 bytes; an ADU has at least 4",
        "",
    ]
