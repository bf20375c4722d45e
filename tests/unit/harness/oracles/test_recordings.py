"""Oracles on whole recordings: generated, altered, and imported."""

import random

import pytest

from motorhil.harness.oracles.base import RecordingContext, Verdict
from motorhil.harness.oracles.facts import Facts, read_limits, subjects_in
from motorhil.harness.oracles.judge import Pass, is_sound, judge
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, MotorError
from motorhil.traces.decoding.attached_rig import names_of
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import recorded_frames
from motorhil.traces.mcap.reader import read_trace
from tests.support.golden import GOLDEN, golden
from tests.support.motors.kinds import EVERY
from tests.support.recordings.altered import copied

_CAN = {
    *("limit-velocity", "heartbeat-kept", "sdo-answered", "one-sender", "no-reboot"),
    "owner-commands",
}
_DRIVE = _CAN | {"limit-acceleration", "pds-legal", "torque-off"}
_MODES = {"mode-signs", "arrival-true", "tpdo-times"}
_DRIVES = {"limit-velocity", "drive-answered", "one-drive", "fault-heeded"}
HELD = {
    "cia402": _DRIVE | _MODES | {"rest-when-told"},
    "overload": _DRIVE | _MODES | {"fault-told", "errors-listed"},
    "software": _CAN | {"sync-period", "sdo-refusals", "tpdo-times"},
    "dynamixel": _DRIVES,
    "leadshine": {"limit-velocity"},
    "leadshine_tcp": {"limit-velocity"},
    "dryve": {"torque-off"},
    "mit": _DRIVES,
    "moteus": _DRIVES,
    "oriental_az": {"limit-velocity"},
    "rmd": _DRIVES,
    "robstride": _DRIVES,
    "vesc": _DRIVES,
}


def verdicts(findings):
    """Return the verdicts by oracle, without oracles that had nothing to judge."""
    return {
        one.oracle: one.verdict
        for one in findings
        if one.verdict is not Verdict.NOT_JUDGED or one.first is not None
    }


def held(findings):
    return {name for name, verdict in verdicts(findings).items() if verdict is Verdict.HELD}


@pytest.mark.parametrize("name", GOLDEN)
def test_golden_recordings_are_sound(name):
    with golden(name) as path:
        findings = judge(path)
    assert is_sound(findings)
    assert set(verdicts(findings)) == held(findings) == HELD[name]
    assert all(one.looked for one in findings if one.verdict is Verdict.HELD)
    assert all(one.reason for one in findings if one.verdict is Verdict.NOT_JUDGED)


def test_demo_recording_is_sound(demo):
    findings = {one.oracle: one for one in judge(demo)}
    assert held(findings.values()) == _DRIVE | _MODES | {"rest-when-told", "limit-position"}
    assert is_sound(findings.values())
    assert findings["limit-velocity"].looked > 4_900
    assert findings["owner-commands"].looked == 818


def test_recording_with_missing_frames_is_not_broken():
    """As in an imported candump: no senders, each frame lost with a chance of 1 to 20 %."""
    for name in ("cia402", "overload", "software"):
        with golden(name) as path, read_trace(path) as trace:
            frames = list(recorded_frames(trace, Findings()))
            facts = Facts(subjects_in(trace.attachments))
            names = names_of(trace.attachments)
        suspected = 0
        for seed, chance in enumerate((0.01, 0.05, 0.1, 0.2) * 2):
            draw = random.Random(f"{name}:{seed}").random
            pass_ = Pass(RecordingContext(facts, names), ())
            for time_ns, bus, frame, _, _ in frames:
                if draw() >= chance:
                    pass_.take_frame(time_ns, bus, frame, "")
            pass_.imported("candump")
            findings = pass_.findings(None, None, None)
            assert Verdict.BROKEN not in verdicts(findings).values()
            suspected += sum(one.first is not None for one in findings)
        assert suspected  # missing frames are noticed


def test_limits_file_is_applied_to_measured_values(tmp_path):
    file = tmp_path / "limits.toml"
    expected = {  # the recording has 2 rad/s, from 0 to 1 and back to 0.5 rad
        "velocity_max_rad_s = 1.9": "limit-velocity",
        "position_max_rad = 0.99": "limit-position",
        "position_min_rad = 0.01": "limit-position",
        "acceleration_max_rad_s2 = 3.5": "limit-acceleration",
        "torque_max_n_m = 0.1": "limit-torque",
        "current_max_a = 0.05": "limit-torque",
        "position_max_inc = 21000": "limit-position",
        "following_error_max_inc = 2": "following-bounded",
        "following_error_max_rad = 1e-4": "following-bounded",
    }
    with golden("cia402") as path:
        for line, oracle in expected.items():
            file.write_text(f"[motor.left]\n{line}\n")
            findings = judge(path, Facts(read_limits(file)))
            broken = {one.oracle: one for one in findings if one.verdict is Verdict.BROKEN}
            assert list(broken) == [oracle], line
            first = broken[oracle].first
            assert first.motor == "left"
            assert abs(first.value) > abs(first.limit) or "min" in line
        file.write_text(
            "[motor.left]\nvelocity_max_rad_s = 2.2\nposition_max_rad = 1.01\n"
            "following_error_max_inc = 20\nposition_min_rad = -0.01\n"
            "acceleration_max_rad_s2 = 6.0\ntorque_max_n_m = 5.0\n"
        )
        findings = judge(path, Facts(read_limits(file)))
        assert is_sound(findings)
        limits = [one for one in findings if one.oracle.startswith("limit-")]
        limits += [one for one in findings if one.oracle == "following-bounded"]
        assert [one.verdict for one in limits] == [Verdict.HELD] * 5


def test_rig_with_faults_is_broken_and_torque_off_held(tmp_path):
    """One drive has safe torque off, and all frames of the other one are dropped."""
    text = EVERY["cia402"].rig() + (
        '[[stimulus]]\ncontroller = "left"\nname = "sto"\nvalue = 1\nat_s = 0.8\n'
        '[[fault]]\nbus = "can0"\nkind = "drop"\nsender = "right"\nfrom_s = 0.8\n'
    )
    path = tmp_path / "broken.mcap"
    description = parse_rig(Source(tmp_path / "rig.toml", text), installed_plugins())
    with Rig(description, record=path) as rig:
        left, right = rig.motors["left"], rig.motors["right"]
        left.enable()
        right.enable()
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(1.0)
        left.start()
        rig.runtime.run_for(0.85 - rig.runtime.now_ns() / 1e9)
        with pytest.raises(MotorError):
            right.hardware.read(0x1000, 0, "u32")
        rig.runtime.run_for(0.5)
    findings = {one.oracle: one for one in judge(path)}
    broken = {name: one for name, one in findings.items() if one.verdict is Verdict.BROKEN}
    assert list(broken) == ["heartbeat-kept", "sdo-answered", "tpdo-times"]
    for one in broken.values():
        assert (one.first.bus, one.first.node, one.first.motor) == ("can0", 2, "right")
    assert "1000h" in broken["sdo-answered"].first.text
    assert findings["torque-off"].verdict is Verdict.HELD
    assert findings["torque-off"].looked > 10


def test_unreadable_message_makes_recording_incomplete(tmp_path):
    with golden("cia402") as path:
        spoilt = copied(
            path,
            tmp_path / "spoilt.mcap",
            lambda n, topic, _, data: b"\xff" if n == 300 else data,
        )
    assert Verdict.BROKEN not in verdicts(judge(spoilt)).values()


# Contents of the real recordings, examined frame by frame; (verdict, further) of violations.
BROKEN, PERHAPS = Verdict.BROKEN, Verdict.NOT_JUDGED
REAL = {
    # A client asks node 15 for 4001h and aborts with 0504 0000h 0.4 s later, five times in all.
    "canopen_machine_pcan1.trc": {"sdo-answered": (BROKEN, 4)},
    # The same seven times; heartbeats and a reset are missing around rows garbled by the converter.
    # Nodes are heard after eight resets without a boot-up between them.
    "canopen_machine_pcanrouter_pcan3.trc": {
        **{"sdo-answered": (BROKEN, 6), "heartbeat-kept": (PERHAPS, 2), "no-reboot": (PERHAPS, 1)},
        **{"nmt-obeyed": (PERHAPS, 7)},
    },
}
REACHED = {  # the CANopen oracles that can judge the others
    "canopenlens_sample_amr_2wheel.log": {
        *("pds-legal", "sync-period", "heartbeat-kept", "sdo-answered", "no-reboot", "tpdo-times"),
    },
    "ros2canopen_issue298_fault_recovery.candump.txt": {
        *("sdo-answered", "no-reboot", "errors-listed"),
    },
    "ros2canopen_issue356_nanotec_n5_boot.candump.txt": {"sdo-answered", "no-reboot"},
    "roboteq_mbl1660_node12_candump.txt": {"no-reboot", "errors-listed"},
    "technosoft_ipos_segmented_sdo_and_pdo_mapping.pcan.txt": {"sdo-answered", "sdo-refusals"},
    "ather_scooter_candump.txt": set(),
    "moteus_dynamometer_canfd_candump.txt": set(),
    "rdm_inverter_bench_PV1.7.asc": set(),
    "savvycan_example_candump.log": set(),
    "uw_formula_cm_inverter_fault_on_stands_LOGS5.TXT": set(),
}


@pytest.mark.data
@pytest.mark.parametrize("name", [*REAL, *REACHED])
def test_real_traffic_has_exactly_the_known_violations(shared, name):
    findings = judge(shared / "data" / "traffic" / name)
    accused = {one.oracle: (one.verdict, one.further) for one in findings if one.first is not None}
    assert accused == REAL.get(name, {})
    assert held(findings) >= REACHED.get(name, set())
    if name in REACHED:
        assert held(findings) == REACHED[name]
