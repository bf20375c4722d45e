"""RobStride's frames: golden frames of the client robstride 0.1.0, commands, quirks."""

import struct
from math import pi

import pytest

from tests.unit.emulators.mit.bench import EFF, robstride

ENABLE, STOP, ZERO, MOTION, READ, WRITE = (
    *(EFF | 0x0300AA01, EFF | 0x0400AA01, EFF | 0x0600AA01),
    *(EFF | 0x01000001, EFF | 0x1100AA01, EFF | 0x1200AA01),
)
NOTHING = bytes(8)


def test_golden_frames_of_the_client():
    bench = robstride(model="rs01")
    assert bench.ask("1970000000000000", READ) == [
        (EFF | 0x110001AA, bytes.fromhex("1970000000000000"))
    ]
    bench.ask(NOTHING, ENABLE)
    told = bench.ask("1970000000000000", WRITE)  # refused: it is measured
    assert told == [(EFF | 0x028001AA, bytes.fromhex("7FFF7FFF7FFF00FA"))]
    assert "7019h" in bench.events()


def test_run_mode_changes_at_rest_only():
    bench = robstride(model="rs01")
    bench.ask("0570000002000000", WRITE)
    assert bench.ask("0570000000000000", READ)[0][1].hex() == "0570000002000000"
    bench.ask(NOTHING, ENABLE)
    bench.ask("0570000000000000", WRITE)
    assert "while stopped" in bench.events()


def motion(p, v, kp, kd, t):
    codes = (
        round((p + 4 * pi) / (8 * pi) * 65535),
        round((v + 44) / 88 * 65535),
        round(kp / 500 * 65535),
        round(kd / 5 * 65535),
    )
    return struct.pack(">4H", *codes), MOTION | round((t + 17) / 34 * 65535) << 8


def test_motion_command_holds_five_numbers():
    bench = robstride(model="rs01")
    bench.ask(NOTHING, ENABLE)
    bench.ask(*motion(1.0, -2.0, 50.0, 1.5, 4.0))
    truth = bench.truth()
    found = [truth[f"command_{name}"] for name in ("position_rad", "velocity_rad_s")]
    assert found == pytest.approx([1.0, -2.0], abs=1e-3)
    assert truth["command_kp_n_m_rad"] == pytest.approx(50.0, abs=0.01)
    assert truth["command_kd_n_m_s_rad"] == pytest.approx(1.5, abs=1e-3)
    assert truth["command_torque_n_m"] == pytest.approx(4.0, abs=1e-3)


def test_motion_command_moves_the_motor():
    bench = robstride(model="rs01")
    bench.ask(NOTHING, ENABLE)
    bench.ask(*motion(0.5, 0.0, 20.0, 2.0, 0.0))
    bench.run(2000)
    assert bench.truth()["position_rad"] == pytest.approx(0.5, abs=0.015)
    can_id, _ = bench.ask(NOTHING, STOP)[0]
    assert can_id >> 22 & 3 == 2  # before it acted
    assert bench.truth()["is_on"] == 0.0


def test_faults_are_in_the_identifier_until_cleared():
    bench = robstride(model="rs01")
    bench.ask(NOTHING, ENABLE)
    bench.drive.stimulate("fault", 2, bench.now_ns)
    assert bench.ask(NOTHING, ENABLE)[0][0] == EFF | 0x020201AA
    bench.ask(b"\x01" + bytes(7), STOP)
    assert bench.ask(NOTHING, STOP)[0][0] == EFF | 0x020001AA


def test_zero_needs_its_byte():
    bench = robstride(model="rs01", initial_position_rad=1.0)
    bench.ask(NOTHING, ZERO)
    assert bench.truth()["position_inc"] != 0.0
    bench.ask(b"\x01" + bytes(7), ZERO)
    assert bench.truth()["position_inc"] == 0.0


def test_frames_of_others_and_short_ones_have_no_effect():
    bench = robstride(model="rs01")
    assert bench.ask(NOTHING, EFF | 0x0300AA02) == []
    assert bench.ask(NOTHING, 0x301) == []
    assert bench.ask(bytes(7), ENABLE) == []
    assert "7 bytes" in bench.events()
    assert bench.ask(NOTHING, EFF | 0x1F00AA01) == []
    assert "type 31" in bench.events()


def test_watchdog_ends_a_command():
    bench = robstride(model="rs01", watchdog_s=0.1)
    bench.ask(NOTHING, ENABLE)
    bench.ask(*motion(1.0, 0.0, 50.0, 1.0, 0.0))
    bench.run(101)
    assert bench.truth()["command_kp_n_m_rad"] == 0.0
