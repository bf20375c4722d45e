"""Rigs with recorded controllers: chosen logs, omitted settings, attached files."""

import os
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.harness.replay.device_node import (
    RecordedNode,
    RecordedUnit,
    build,
    recorded_exchanges,
)
from motorhil.harness.replay.rig import own_rig, rig_in, with_recorded
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import installed_plugins
from motorhil.traces.exchange.recording import exchanges_of
from motorhil.traces.exchange.steps import START
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, MODBUS_ADU, Direction, Schema
from tests.support.golden import described, golden
from tests.support.recordings.handmade import MS, Recorded
from tests.unit.traces.exchange.test_exchange_logs import frame

S = 1_000_000_000
ASK, KIND = "40001000", "4300100092010200"


def recording(path, *frames, metadata=None, attached=()):
    """Record frames, given as (bus, frame), without a rig."""
    with TraceWriter(path, metadata or {}) as writer:
        for name, data in attached:
            writer.attach(name, data, "application/toml")
        sources = {}
        for bus, one in frames:
            if bus not in sources:
                channel = writer.channel(f"/can/{bus}", Schema.of(CAN_FRAME))
                sources[bus] = writer.source(channel, "", Direction.RECEIVED)
            writer.extend([(sources[bus], one.time_ns, one.frame)])
    return path


def built(path, **settings):
    context = ControllerContext("left", path.parent, 1)
    return build({"recording": path.name, **settings}, context)


def booted(number):
    return frame(1_000, 0x700 + number, b"\0")


def test_node_on_two_buses_needs_recorded_bus(tmp_path):
    path = recording(tmp_path / "a.mcap", ("can0", booted(1)), ("can1", booted(1)))
    with pytest.raises(SettingError, match=r"name one of them; .* on several buses: can0, can1"):
        built(path, node_id=1)
    core = built(path, node_id=1, recorded_bus="can1")
    assert isinstance(core, RecordedNode)
    assert core.player.log.bus == "can1"


def test_unit_and_node_with_equal_number_are_distinct(tmp_path):
    one = Recorded(tmp_path / "a.mcap")
    one.sdo(1 * MS, 3, ASK, KIND)
    one.modbus(11 * MS, "000100000006030600010003", True)
    one.modbus(12 * MS, "000100000006030600010003", False)
    path = tmp_path / "a.mcap"
    one.close()
    unit, node = built(path, unit=3), built(path, node_id=3)
    assert isinstance(unit, RecordedUnit)
    assert isinstance(node, RecordedNode)
    assert (unit.player.log.bus, node.player.log.bus) == ("rs485", "can0")
    with pytest.raises(SettingError, match="no data of unit 4"):
        built(path, unit=4)


@pytest.mark.parametrize(("rate", "bit_ns"), [(1_000_000, 1_000), (125_000, 8_000)])
def test_frame_duration_follows_bit_rate(tmp_path, rate, bit_ns):
    """A boot-up frame 701h 00h: 52 bits without intermission, and at most 10 stuff bits."""
    path = recording(tmp_path / "a.mcap", ("can0", booted(1)))
    ((sent,),) = [
        one.reactions for one in built(path, node_id=1, bitrate_bit_s=rate).player.log.steps
    ]
    assert 52 * bit_ns <= sent.duration_ns <= 62 * bit_ns


def test_replaced_recording_is_read_again(tmp_path):
    """The new file has the same size."""
    path = recording(tmp_path / "a.mcap", ("can0", booted(1)))
    size = path.stat().st_size
    assert list(recorded_exchanges(path).logs) == [("can0", 1)]
    recording(path, ("can0", booted(2)))
    assert path.stat().st_size == size
    os.utime(path, ns=(1, 1))
    assert list(recorded_exchanges(path).logs) == [("can0", 2)]


@pytest.mark.parametrize(("metadata", "begin_ns"), [({"run": {}}, 0), ({}, 1 * S)])
def test_recording_starts_at_0_only_with_a_run(tmp_path, metadata, begin_ns):
    path = recording(tmp_path / "a.mcap", ("can0", booted(1)), metadata=metadata)
    with read_trace(path) as trace:
        (first,) = exchanges_of(trace).logs["can0", 1].steps
    assert (first.key, first.time_ns) == (START, begin_ns)
    assert [one.delay_ns for one in first.reactions] == [1 * S - begin_ns]


def test_invalid_messages_yield_no_logs(tmp_path):
    path = tmp_path / "a.mcap"
    with TraceWriter(path) as writer:
        for topic, table in (("/can/can0", CAN_FRAME), ("/modbus/rs485", MODBUS_ADU)):
            writer.write(writer.channel(topic, Schema.of(table)), 1, b"\xff\xff\xff")
    with read_trace(path) as trace:
        assert exchanges_of(trace).logs == {}


def test_rig_in_without_rig_names_controllers_by_number(tmp_path):
    known = installed_plugins()
    one = rig_in(recording(tmp_path / "one.mcap", ("can0", booted(1)), ("can0", booted(2))), known)
    assert list(one.controllers) == ["node_1", "node_2"]
    two = rig_in(recording(tmp_path / "two.mcap", ("can0", booted(1)), ("can1", booted(1))), known)
    assert list(two.controllers) == ["can0_node_1", "can1_node_1"]


def test_faults_and_plants_are_left_out():
    """Their effects are in the recording."""
    with golden("cia402") as path:
        rig = described("cia402")
        left = replace(rig.controllers["left"], plants_from_model=(("plant",),))
        with_faults = replace(
            rig, controllers={**rig.controllers, "left": left}, faults=("a fault",)
        )
        found = with_recorded(with_faults, path)
    assert found.faults == ()
    assert [one.plants_from_model for one in found.controllers.values()] == [(), ()]
    assert {one.kind for one in found.controllers.values()} == {"recorded"}


RIG = b"""
[rig]
name = "far"
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 1
plant = { preset = "wheel_60w" }
[motor.left]
adaptation = "cia402"
controller = "left"
model = "%s"
"""


@pytest.mark.parametrize(
    "place", ["wheel.toml", "models/wheel.toml", "../" * 20 + "models/wheel.toml"]
)
def test_motor_model_is_found_at_any_path(tmp_path, place):
    with golden("cia402") as path, read_trace(path) as trace:
        text = tomllib.loads(trace.attachments[0].data.decode())["motor"]["left"]["model"]
    model = "".join(f"{key} = {value}\n" for key, value in text.items()).encode()
    attached = [("far.toml", RIG % place.encode()), ("wheel.toml", model)]
    path = recording(tmp_path / "a.mcap", ("can0", booted(1)), attached=attached)
    found = own_rig(path, installed_plugins())
    assert found.motors["left"].model == text
    assert found.source.error(("controller", "left", "kind"), "is wrong").line == 7


@pytest.mark.parametrize(
    ("key", "line"),
    [
        ("controller.left.kind", b'kind = "%s"'),
        ("motor.left.adaptation", b'adaptation = "%s"'),
    ],
)
def test_recording_names_no_code_to_run(tmp_path, key, line):
    text = RIG.replace(line % b"cia402", line % b"os:abort") % b"wheel.toml"
    path = recording(tmp_path / "a.mcap", attached=[("far.toml", text)])
    with pytest.raises(RigError) as caught:
        own_rig(path, installed_plugins())
    assert caught.value.key == key
    assert '"os:abort" names code to run, which a recording may not' in str(caught.value)
    assert str(caught.value).endswith("; give a rig file instead")


@pytest.mark.parametrize("quote", [b'"', b"'"])
@pytest.mark.parametrize("place", ["/etc/motorhil.txt", "{}/memory.txt", "../" * 70 + "memory.txt"])
def test_files_that_a_recording_names_stay_within_its_folder(tmp_path, place, quote):
    place = place.format(tmp_path)
    added = b"nonvolatile_memory = " + quote + place.encode() + quote
    text = RIG.replace(b"node_id = 1\n", b"node_id = 1\n" + added + b"\n") % place.encode()
    model = b'unit = "rad"\nvelocity_max_rad_s = 1.0\n'
    attached = [("far.toml", text), (place.rpartition("/")[2], model)]
    path = recording(tmp_path / "a.mcap", attached=attached)
    home = tmp_path / "home"
    found = own_rig(path, installed_plugins(), home)
    memory = Path(found.controllers["left"].settings["nonvolatile_memory"])
    assert memory.resolve().is_relative_to(home)
    assert memory.read_bytes() == model
    assert found.motors["left"].model == {"unit": "rad", "velocity_max_rad_s": 1.0}
    assert found.attached[0][0] == place.rpartition("/")[2]


def test_file_name_in_another_spelling_is_refused(tmp_path):
    text = RIG % rb"\u002fetc/wheel.toml"
    path = recording(tmp_path / "a.mcap", attached=[("far.toml", text)])
    with pytest.raises(RigError, match=r"names the file '/etc/wheel\.toml', in a spelling"):
        own_rig(path, installed_plugins())


@pytest.mark.parametrize("name", ["..", ".", ""])
def test_attachment_without_a_file_name_is_left_out(tmp_path, name):
    path = recording(tmp_path / "a.mcap", attached=[(name, RIG % b"wheel.toml")])
    assert own_rig(path, installed_plugins()) is None
