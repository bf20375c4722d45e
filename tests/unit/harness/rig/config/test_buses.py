"""Modbus lines in a rig file: valid tables and mistakes."""

import tomllib
from pathlib import Path

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness.rig.config.buses import host_and_port
from motorhil.harness.rig.config.rig_file import Known, parse_rig
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.rig import Rig
from tests.unit.harness.rig.config.test_schema import VALIDATOR

KNOWN = Known(controllers=("cia402", "drive"), adaptations=("drive",))
GOOD = """\
[bus.rs485]
kind = "modbus_rtu"
baud_bit_s = 115_200
parity = "N"

[bus.gateway]
kind = "modbus_tcp"

[bus.can0]
bitrate_bit_s = 500_000

[controller.mast]
kind = "drive"
bus = "rs485"
unit = 7

[controller.arm]
kind = "drive"
bus = "gateway"
unit = 7

[motor.mast]
adaptation = "drive"
controller = "mast"
model = {}

[motor.spare]
adaptation = "drive"
bus = "rs485"
unit = 247
model = {}

[[fault]]
bus = "rs485"
kind = "pause"
unit = 7
function = 3
after = 2
delay_s = 0.001
"""


def parse(text):
    return parse_rig(Source(Path("rig.toml"), text), KNOWN)


def test_rig_with_lines_is_read_as_written():
    rig = parse(GOOD)
    line, gateway = rig.buses["rs485"], rig.buses["gateway"]
    assert (line.kind, line.bitrate_bit_s, line.parity, line.stop_bits) == (
        *("modbus_rtu", 115_200, "N"),
        1,
    )
    assert (gateway.kind, gateway.latency_ns) == ("modbus_tcp", 50_000)
    assert (line.address, gateway.address) == ("/dev/rs485", "gateway:502")
    assert rig.controllers["mast"].node_id == rig.controllers["arm"].node_id == 7
    assert (rig.motors["mast"].bus, rig.motors["mast"].node_id) == ("rs485", 7)
    assert rig.motors["spare"].node_id == 247
    assert rig.faults[0].rule == SerialFaultRule(
        "fault 1", SerialFaultKind.PAUSE, unit=7, function=3, after=2, delay_ns=1_000_000
    )
    assert VALIDATOR.is_valid(tomllib.loads(GOOD))


REFUSALS = [
    (
        "baud_bit_s = 115_200",
        "bitrate_bit_s = 115_200",
        '3: bus.rs485.bitrate_bit_s: belongs to kind "can"; take it out, or write kind = "can"',
    ),
    (
        "baud_bit_s = 115_200",
        "baud = 115_200",
        "3: bus.rs485.baud: unknown key (known: kind, bitrate_bit_s, data_bitrate_bit_s, message, "
        "node, baud_bit_s, parity, stop_bits, latency_s, timeout_s, address);"
        " did you mean baud_bit_s?",
    ),
    (
        "baud_bit_s = 115_200",
        "baud_bit_s = 100",
        "3: bus.rs485.baud_bit_s: 100 bit/s is out of range; allowed: 300 to 10000000 bit/s",
    ),
    (
        'parity = "N"',
        'parity = "M"',
        '4: bus.rs485.parity: unknown parity "M" (known: E, O, N);'
        " take it out, or use one of these",
    ),
    (
        "baud_bit_s = 115_200",
        'address = "ttyUSB0"',
        '3: bus.rs485.address: "ttyUSB0" is not the path of a serial port; write "/dev/ttyUSB0"',
    ),
    *(
        (
            'kind = "modbus_tcp"',
            f'kind = "modbus_tcp"\naddress = "{address}"',
            f'8: bus.gateway.address: "{address}" is not the address of a gateway; write'
            ' "HOST:PORT"',
        )
        for address in ("192.0.2.7", ":502", "gateway:0", "gateway:65536", "gateway:\u0661")
    ),
    (
        "baud_bit_s = 115_200",
        'address = "/dev/a"\n[bus.second]\nkind = "serial"\naddress = "/dev/a"',
        '6: bus.second.address: "/dev/a" is that of "rs485"; write another',
    ),
    (
        "unit = 7",
        "node_id = 7",
        '15: controller.mast.node_id: bus "rs485" is of kind modbus_rtu: its controllers have a'
        " unit; write unit",
    ),
    (
        "unit = 7",
        "unit = 248",
        "15: controller.mast.unit: 248 is out of range; allowed: 1 to 247",
    ),
    (
        'bus = "gateway"',
        'bus = "rs485"',
        '20: controller.arm.unit: 7 on bus "rs485" is already used by controller "mast" (line 15);'
        " the first free unit is 1",
    ),
    (
        'controller = "mast"',
        'controller = "mast"\nunit = 7',
        "25: motor.mast.unit: follows from the controller; take out unit",
    ),
    (
        'bus = "rs485"\nunit = 247',
        'bus = "can0"\nunit = 1',
        '30: motor.spare.unit: bus "can0" is of kind can: a CAN bus has node-IDs; write node_id',
    ),
    (
        'kind = "pause"',
        'kind = "drop"',
        '35: fault[0].kind: unknown fault kind "drop" (known: lose, delay, corrupt, truncate,'
        " pause, repeat, noise); take it out, or use one of these",
    ),
    (
        'bus = "rs485"\nkind = "pause"',
        'bus = "gateway"\nkind = "noise"',
        '35: fault[0].kind: unknown fault kind "noise" (known: lose, delay, truncate, pause);'
        " did you mean lose?",
    ),
    (
        'bus = "rs485"\nkind = "pause"',
        'bus = "can0"\nkind = "delay"',
        '36: fault[0].unit: bus "can0" is not a line; remove it: it is for Modbus',
    ),
    ("after = 2\n", "", "33: fault[0].after: is missing; write after = 3"),
    (
        "after = 2",
        'after = 2\nflip = "01"',
        '39: fault[0].flip: belongs to kind "corrupt"; take it out',
    ),
    (
        "after = 2",
        "after = 2\nidentifier = 0x181",
        '39: fault[0].identifier: bus "rs485" is a line; take it out',
    ),
]


@pytest.mark.parametrize(("old", "new", "told"), REFUSALS)
def test_mistake_is_one_line_with_file_line_key_and_remedy(old, new, told):
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    with pytest.raises(RigError) as caught:
        parse(text)
    assert str(caught.value) == f"rig.toml:{told}"


LINES_ONLY = """\
[bus.rs485]
kind = "modbus_rtu"
[bus.can0]
bitrate_bit_s = 500_000
[controller.drive]
kind = "cia402"
bus = "rs485"
unit = 1
"""


def test_controller_of_another_bus_kind_is_refused(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(LINES_ONLY)
    with pytest.raises(RigError) as caught:
        Rig.open(path)
    assert str(caught.value) == (
        f'{path}:7: controller.drive.bus: controller kind "cia402" is for buses of kind can, but'
        ' "rs485" is modbus_rtu; put it on another bus, or use another kind'
    )


def test_motor_of_another_bus_kind_is_refused(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(
        '[bus.rs485]\nkind = "modbus_rtu"\n[motor.m]\nadaptation = "cia402"\nbus = "rs485"\n'
        "unit = 1\nmodel = {velocity_max_rad_s = 1.0, acceleration_max_rad_s2 = 1.0}\n"
    )
    with Rig.open(path) as rig, pytest.raises(RigError) as caught:
        rig.motors["m"]
    assert f"{path}:5: motor.m.bus: adaptation" in str(caught.value)


def test_lines_and_buses_are_found_by_their_own_names(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('[bus.rs485]\nkind = "modbus_rtu"\n[bus.can0]\nbitrate_bit_s = 500_000\n')
    with Rig.open(path) as rig:
        assert (rig.line("rs485").framing, rig.bus("can0").channel) == ("rtu", "can0")
        with pytest.raises(KeyError, match=r"this rig has no bus 'rs485' \(known: can0\)"):
            rig.bus("rs485")
        with pytest.raises(KeyError, match=r"this rig has no line 'can0' \(known: rs485\)"):
            rig.line("can0")


def test_port_on_a_line_hears_others_with_their_times(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('[bus.rs485]\nkind = "modbus_rtu"\nbaud_bit_s = 19200\n')
    heard = []
    with Rig.open(path) as rig:
        line = rig.line("rs485")
        other = rig.world.add_line_host("rs485", "other", lambda *_: None)
        line.listen(lambda data, time_ns: heard.append((data, time_ns)))
        other.send(b"\x01\x02")
        rig.runtime.wait_until(lambda: bool(heard), 1.0)
        assert heard == [(b"\x01\x02", line.duration_ns(2))]
        assert line.duration_ns(2) == 22 * 10**9 // 19200


def test_line_faults_can_be_injected_lifted_and_counted(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('[bus.rs485]\nkind = "modbus_rtu"\n')
    lose = SerialFaultRule("lose", SerialFaultKind.LOSE)
    with Rig.open(path) as rig:
        line = rig.line("rs485")
        rig.faults.inject("rs485", lose)
        line.send(b"\x01\x02")
        rig.runtime.wait_until(lambda: False, 0.1)
        rig.faults.lift("rs485", "lose")
        line.send(b"\x01\x02")
        rig.runtime.wait_until(lambda: False, 0.1)
        assert rig.faults.fired() == {"lose": 1}
        with pytest.raises(ValueError, match="fault lose: unknown rule"):
            rig.faults.lift("rs485", "lose")


@pytest.mark.parametrize(
    ("address", "parts"),
    [
        ("localhost:502", ("localhost", 502)),
        ("[::1]:5020", ("::1", 5020)),
        ("gateway:0", ("gateway", 0)),
        ("gateway:65535", ("gateway", 65_535)),
        ("gateway:65536", None),
        ("gateway:99999999999999999999", None),
        ("::1:502", None),  # is it port 502, or an address without one?
        ("gateway:", None),
        ("gateway:+5", None),
        ("gateway:\u0665", None),  # a digit, but of no port
        (":502", None),
        ("gateway", None),
        ("", None),
    ],
)
def test_parts_of_an_address(address, parts):
    assert host_and_port(address) == parts
