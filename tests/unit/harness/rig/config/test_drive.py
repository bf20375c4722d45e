"""The CiA 402 drive in a rig file; mistakes give one line."""

import os
import signal
import tomllib
from pathlib import Path

import can
import jsonschema
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.schema import rig_schema
from motorhil.harness.rig.config.toml import RigError, Source, one_line
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig

SCHEMA = rig_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)

GOOD = """\
[bus.can0]
bitrate_bit_s = 500_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 5
supported_modes = ["pp", "csp"]
initial_position_rad = 0.25
[controller.left.plant]
preset = "wheel_60w"
gear_ratio = 33.0
load_torque_n_m = -0.5
[controller.left.servo]
tick_s = 0.001
current_steps = 10
[controller.left.oscillator]
ppm = 40.0
phase_max_s = 0.001
[controller.left.timing]
boot_up_s = 0.1
sdo_reply_s = 0.002
enable_s = 0.0
[controller.left.units]
velocity_unit_inc_s = 10.0
[controller.left.objects]
"6065h" = 2000
"1017h" = 100
[motor.left]
adaptation = "cia402"
controller = "left"
heartbeat_ms = 200
heartbeat_timeout_ms = 600
connect_timeout_s = 1.5
[motor.left.model]
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
increments_per_rad = 1000
"""
LINES = GOOD.splitlines()
ASSIGNMENTS = [number for number, line in enumerate(LINES) if " = " in line]


def opened(text):
    return Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins()))


def mistake_in(text):
    try:
        with opened(text) as rig:
            rig.build_motors()
    except RigError as error:
        return error
    return None


def test_settings_of_the_rig_reach_the_drive():
    VALIDATOR.validate(tomllib.loads(GOOD))
    with opened(GOOD) as rig:
        truth = rig.controllers["left"].snapshot()
        assert truth["position_rad"] == pytest.approx(0.25, abs=1e-3)  # within an increment
        bus = rig.bus("can0")
        boot_up = bus.recv(1.0)
        assert boot_up.arbitration_id == 0x705
        # The default would be 300 ms; the frame itself takes about 57 bits at 500 kbit/s.
        assert 0.1 < boot_up.timestamp < 0.1002
        sent = can.Message(
            arbitration_id=0x605, data=bytes.fromhex("4065600000000000"), is_extended_id=False
        )
        bus.send(sent)
        reply = bus.recv(1.0)
        while reply.arbitration_id != 0x585:  # heartbeats every 100 ms
            reply = bus.recv(1.0)
        assert int.from_bytes(reply.data[4:], "little") == 2000


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("node_id = 5", "node_id = 0", "6: controller.left.node_id: "),
        ("node_id = 5", "", "3: controller.left.node_id: is missing"),
        ("gear_ratio = 33.0", "gear = 33.0", "11: controller.left.plant.gear: "),
        ("gear_ratio = 33.0", "gear_ratio = -1", "11: controller.left.plant.gear_ratio: "),
        ("ppm = 40.0", "ppb = 40", "17: controller.left.oscillator.ppb: "),
        ("ppm = 40.0", "ppm = 2e5", "17: controller.left.oscillator.ppm: "),
        ("ppm = 40.0", "phase_s = 0.0", "18: controller.left.oscillator.phase_max_s: has no "),
        ("boot_up_s = 0.1", "boot_up_ms = 100", "20: controller.left.timing.boot_up_ms: "),
        ('"wheel_60w"', '"wheel_600w"', "10: controller.left.plant.preset: "),
        ('"6065h" = 2000', '"6065x" = 2000', "26: controller.left.objects.6065x: "),
        ("heartbeat_ms = 200", "heartbeat = 200", "31: motor.left.heartbeat: "),
        ("heartbeat_ms = 200", "heartbeat_ms = -1", "31: motor.left.heartbeat_ms: "),
        ("velocity_max_rad_s", "velocity_max", "35: motor.left.model.velocity_max: unknown key"),
        ("velocity_max_rad_s = 6.0", "", "34: motor.left.model.velocity_max_rad_s: is missing"),
        ("node_id = 5", 'node_id = 5\neds = "no.eds"', "7: controller.left.eds: "),
    ],
)
def test_wrong_drive_setting_is_reported_with_its_line(old, new, told):
    assert old in GOOD
    message = str(mistake_in(GOOD.replace(old, new, 1)))
    assert message.startswith(f"rig.toml:{told}")
    assert one_line(message) == message


ODD_VALUES = [
    *("0", "1", "-1", "127", "128", "nan", "inf", "true", '""', '"pp"', "[]", "{}", "[1]"),
    *("1979-05-27", '["pp","pp"]', '{preset="mast_20w"}', "1e-320", "0.0", "2147484"),
]
ODD_KEYS = [
    *("plant", "servo", "eds", '"6081h"', '"607Dh:1"', '"1A00h:0"', '"1016h:1"'),
    *("from_motor_model", "sdo_timeout_s", "status_inhibit_ms", "jerk_max_rad_s3"),
]
VALUES = st.one_of(
    st.integers(-(2**63) + 1, 2**63 - 1).map(str),
    st.floats().map(lambda value: f"{value!r}" if "e" not in f"{value!r}" else "1e300"),
    st.sampled_from(ODD_VALUES),
)
KEYS = st.sampled_from([*sorted({LINES[n].split(" = ")[0] for n in ASSIGNMENTS}), *ODD_KEYS])
EDITS = st.lists(st.tuples(st.sampled_from(ASSIGNMENTS), st.none() | KEYS, VALUES), max_size=3)


@given(EDITS)
def test_any_drive_setting_gives_a_rig_or_a_rig_error(edits):
    lines = LINES.copy()
    for number, key, value in edits:
        lines[number] = f"{key or LINES[number].split(' = ')[0]} = {value}"
    error = mistake_in("\n".join(lines))
    event("refused" if error else "accepted")
    if error:
        assert len(str(error).splitlines()) == 1
        assert error.remedy or error.message


@pytest.mark.wall
@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_works_while_only_the_cores_run(tmp_path):
    """Compiled code does not check for signals by itself (--cores compiled)."""
    (tmp_path / "rig.toml").write_text(
        "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
        '[controller.left]\nkind = "cia402"\nbus = "can0"\nnode_id = 1\n'
        'objects = { "1017h" = 1 }\n'  # a heartbeat every millisecond
    )
    before = signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    try:
        with Rig.open(tmp_path / "rig.toml") as rig:
            signal.setitimer(signal.ITIMER_REAL, 0.2)
            with pytest.raises(KeyboardInterrupt):
                rig.runtime.run_for(300.0)
            rig.runtime.run_for(0.1)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
