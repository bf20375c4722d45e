"""Both implementations of CANSimple, compared with the vendor's DBC.

The DBC is parsed here: BO_ and SG_ give the places of the bits, SIG_VALTYPE_ the floats, VAL_ the
names of numbers.
"""

import random
import re
import struct
from dataclasses import dataclass, field

import pytest

from tests.support.outsider_source import importable

pytestmark = pytest.mark.data
AXES = 8


@dataclass
class Signal:
    name: str
    at: int
    bits: int
    signed: bool
    scale: float
    is_float: bool = False
    names: dict = field(default_factory=dict)


@dataclass
class Message:
    name: str
    length: int
    sender: str
    signals: dict = field(default_factory=dict)


def read_dbc(text):
    """Return {identifier: Message}."""
    messages = {}
    for line in text.splitlines():
        if found := re.match(r"BO_ (\d+) (\w+): (\d+) (\w+)", line):
            message = messages[int(found[1])] = Message(found[2], int(found[3]), found[4])
        elif found := re.match(
            r" SG_ (\w+) \w? ?: (\d+)\|(\d+)@(\d)([+-]) \(([^,]+),([^)]+)\)", line
        ):
            name, at, bits, order, sign, scale, offset = found.groups()
            assert (order, offset) == ("1", "0"), "little endian, no offset"
            message.signals[name] = Signal(name, int(at), int(bits), sign == "-", float(scale))
        elif found := re.match(r"SIG_VALTYPE_ (\d+) (\w+) : 1;", line):
            messages[int(found[1])].signals[found[2]].is_float = True
        elif found := re.match(r"VAL_ (\d+) (\w+) (.*);", line):
            pairs = re.findall(r'(\d+) "([^"]*)"', found[3])
            messages[int(found[1])].signals[found[2]].names = {int(n): name for n, name in pairs}
    return messages


@pytest.fixture(scope="module")
def dbc(shared):
    path = shared / "data" / "eds" / "odrive_cansimple_0.6.10.dbc"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    messages = read_dbc(path.read_text(encoding="utf-8", errors="replace"))
    assert len(messages) == AXES * 28
    return messages


@pytest.fixture(autouse=True)
def package(monkeypatch):
    importable(monkeypatch)


def sample(signal, rng):
    """Return a value and its raw bits."""
    if signal.is_float:
        value = rng.choice([0.0, -1.5, 1e-3, 123456.75, rng.uniform(-1e4, 1e4)])
        data = struct.pack("<f", value)
        return struct.unpack("<f", data)[0], int.from_bytes(data, "little")
    low = -(1 << signal.bits - 1) if signal.signed else 0
    high = low + (1 << signal.bits) - 1
    raw = rng.choice([low, high, rng.randint(low, high)])
    return raw if signal.scale == 1.0 else raw * signal.scale, raw


def packed(message, raws):
    number = 0
    for signal in message.signals.values():
        number |= (raws[signal.name] & (1 << signal.bits) - 1) << signal.at
    return number.to_bytes(message.length, "little")


def read(message, data):
    """Decode {name: value} as the DBC says."""
    number = int.from_bytes(data.ljust(8, b"\0"), "little")
    values = {}
    for signal in message.signals.values():
        raw = number >> signal.at & (1 << signal.bits) - 1
        if signal.is_float:
            values[signal.name] = struct.unpack("<f", raw.to_bytes(4, "little"))[0]
        else:
            raw -= (1 << signal.bits) if signal.signed and raw >> signal.bits - 1 else 0
            values[signal.name] = raw if signal.scale == 1.0 else raw * signal.scale
    return values


def of_axis_0(dbc):
    return {can_id: message for can_id, message in dbc.items() if can_id < 32}


def test_dbc_axes_have_equal_messages(dbc):
    for can_id, message in dbc.items():
        first = dbc[can_id & 0x1F]
        assert message.name == first.name.replace("Axis0", f"Axis{can_id >> 5}")
        assert {**message.signals}.keys() == first.signals.keys()


def test_both_sides_have_all_messages_but_endpoints(dbc):
    from motorhil_odrive.emulated import messages as drive
    from motorhil_odrive.host import messages as host

    told = {can_id for can_id, one in of_axis_0(dbc).items() if one.sender != "Master"}
    heard = set(of_axis_0(dbc)) - told
    sdo = {drive.RX_SDO, drive.TX_SDO}
    assert set(drive.TOLD) == told - sdo
    assert set(drive.HEARD) | {drive.ADDRESS} == heard - sdo
    assert {one.command for one in host.TOLD_BY_DRIVE} == told - sdo
    assert {one.command for one in host.TOLD_TO_DRIVE} == heard - sdo - {drive.ADDRESS}


def test_drive_signals_match_dbc(dbc):
    from motorhil_odrive.emulated import messages as drive

    rng = random.Random(610)
    for command, (layout, names) in {**drive.TOLD, **drive.HEARD}.items():
        message = of_axis_0(dbc)[command]
        assert set(names) == set(message.signals), message.name
        for _ in range(20):
            samples = {name: sample(message.signals[name], rng) for name in names}
            data = packed(message, {name: raw for name, (_, raw) in samples.items()})
            values = [samples[name][0] for name in names]
            read_here = list(layout.unpack_from(data))
            for place, name in enumerate(names):
                if message.signals[name].scale != 1.0:
                    assert message.signals[name].scale == drive.FEED_FORWARD_SCALE
                    read_here[place] *= drive.FEED_FORWARD_SCALE
            assert read_here == values, message.name
            if command in drive.TOLD:
                assert read(message, layout.pack(*values)) == dict(zip(names, values, strict=True))
                assert len(layout.pack(*values)) == message.length
            else:
                assert layout.size <= message.length


def test_host_signals_match_dbc(dbc):
    from motorhil_odrive.host import messages as host

    rng = random.Random(11)
    for ours in (*host.TOLD_BY_DRIVE, *host.TOLD_TO_DRIVE):
        message = of_axis_0(dbc)[ours.command]
        places = {signal.at: signal.name for signal in message.signals.values()}
        assert sorted(places) == sorted(one.at for one in ours.signals), message.name
        for _ in range(20):
            samples = {name: sample(one, rng) for name, one in message.signals.items()}
            data = packed(message, {name: raw for name, (_, raw) in samples.items()})
            values = tuple(samples[places[one.at]][0] for one in ours.signals)
            assert host.decoded(ours, data) == values, message.name
            written = host.encoded(ours, *values)
            assert len(written) == message.length, message.name
            assert read(message, written) == read(message, data), message.name


def test_value_names_match_dbc(dbc):
    from motorhil_odrive.emulated import messages as drive
    from motorhil_odrive.host import messages as host

    axis = of_axis_0(dbc)
    for command, signal, names in (
        (1, "Axis_State", drive.AxisState),
        (7, "Axis_Requested_State", drive.AxisState),
        (1, "Procedure_Result", drive.ProcedureResult),
        (1, "Axis_Error", drive.Error),
        (3, "Active_Errors", drive.Error),
        (3, "Disarm_Reason", drive.Error),
        (11, "Control_Mode", drive.ControlMode),
        (11, "Input_Mode", drive.InputMode),
        (22, "Action", drive.Action),
    ):
        told = {
            number: name.upper() for number, name in axis[command].signals[signal].names.items()
        }
        assert told == {one.value: one.name for one in names}, signal
    errors = axis[1].signals["Axis_Error"].names
    assert set(host.ERROR_TEXTS) == set(errors) - {0}
    assert len(host.RESULTS) == len(axis[1].signals["Procedure_Result"].names)
    states = {name: number for number, name in axis[1].signals["Axis_State"].names.items()}
    assert (*(states["IDLE"], states["CLOSED_LOOP_CONTROL"], states["HOMING"]),) == (
        host.IDLE,
        host.CLOSED_LOOP,
        host.HOMING,
    )
    modes = {name: number for number, name in axis[11].signals["Control_Mode"].names.items()}
    inputs = {name: number for number, name in axis[11].signals["Input_Mode"].names.items()}
    assert (*(modes[f"{name}_CONTROL"] for name in ("TORQUE", "VELOCITY", "POSITION")),) == (
        host.TORQUE_CONTROL,
        host.VELOCITY_CONTROL,
        host.POSITION_CONTROL,
    )
    assert (inputs["PASSTHROUGH"], inputs["TRAP_TRAJ"]) == (host.PASSTHROUGH, host.TRAPEZOID)
