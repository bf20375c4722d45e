"""Quick stop, shutdown, disable operation, power off: the effect of each on a running motor.

CiA 402-2, objects 605Ah to 605Ch, and transitions 5, 8, 9, 11, 12, 16.
"""

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import ENABLE, MS, Bench

V, A, QUICK = 40_000, 409_600, 819_200


@pytest.fixture
def bench() -> Bench:
    """Return a bench in pv at V; TPDO 1 reports all stops by 6041h, without inhibit time."""
    bench = Bench(
        objects={"1800h:3": 0},
        plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0},
    )
    bench.enable(mode=3)
    bench.set(0x60FF, 0, V, 4)
    bench.run(300 * MS)
    assert bench.read(0x606B) == V
    return bench


def state(bench: Bench) -> float:
    return bench.truth("state")


def stopping_ns(deceleration: int) -> int:
    return round(1e9 * V / deceleration)


@pytest.mark.parametrize(("option", "deceleration"), [(1, A), (2, QUICK), (5, A), (6, QUICK)])
def test_quick_stop_brakes_on_its_ramp(bench, option, deceleration):
    bench.set(0x605A, 0, option, 2)
    at = bench.now
    bench.controlword(0x02)
    assert state(bench) == PdsState.QUICK_STOP_ACTIVE
    assert bench.last(0x185) == bytes.fromhex("1702")
    bench.run_until(at + stopping_ns(deceleration) - 1 * MS)
    assert state(bench) == PdsState.QUICK_STOP_ACTIVE
    assert bench.read(0x606B) > 0
    bench.run_until(at + stopping_ns(deceleration) + 2 * MS)
    if option < 5:
        assert state(bench) == PdsState.SWITCH_ON_DISABLED  # transition 12
        assert bench.last(0x185) == bytes.fromhex("5002")
        bench.run(2 * MS)
        assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-6)
    else:
        assert state(bench) == PdsState.QUICK_STOP_ACTIVE
        assert bench.last(0x185) == bytes.fromhex("1706")  # target reached: standstill
        bench.run(1000 * MS)
        assert state(bench) == PdsState.QUICK_STOP_ACTIVE


def test_quick_stop_0_coasts(bench):
    bench.set(0x605A, 0, 0, 2)
    bench.controlword(0x02)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    bench.run(2 * MS)
    assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-6)
    assert bench.truth("velocity_rad_s") > 1.0
    bench.run(20_000 * MS)
    assert bench.truth("velocity_rad_s") == 0.0


@pytest.mark.parametrize(("option", "leads"), [(2, False), (5, True), (6, True)])
def test_transition_16_is_for_options_from_5_on(bench, option, leads):
    bench.set(0x605A, 0, option, 2)
    bench.controlword(0x02)
    bench.run(10 * MS)
    bench.controlword(0x0F)
    assert (state(bench) == PdsState.OPERATION_ENABLED) is leads
    bench.run(500 * MS)
    assert state(bench) == (PdsState.OPERATION_ENABLED if leads else PdsState.SWITCH_ON_DISABLED)
    assert bench.read(0x606B) == (V if leads else 0)  # pv: 60FFh applies again


def test_quick_stop_codes_without_behaviour_are_rejected(bench):
    for code in (-1, 9):
        assert bench.write(0x605A, 0, code, 2) == 0x0609_0030
    assert bench.read(0x605A) == 2


def test_disable_operation_brakes_by_default(bench):
    at = bench.now
    bench.controlword(0x07)
    assert state(bench) == PdsState.OPERATION_ENABLED
    bench.run_until(at + stopping_ns(A) - 1 * MS)
    assert state(bench) == PdsState.OPERATION_ENABLED
    bench.run_until(at + stopping_ns(A) + 2 * MS)
    assert state(bench) == PdsState.SWITCHED_ON
    bench.run(100 * MS)
    assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=0.01)


def test_disable_operation_0_coasts(bench):
    bench.set(0x605C, 0, 0, 2)
    bench.controlword(0x07)
    assert state(bench) == PdsState.SWITCHED_ON
    bench.run(2 * MS)
    assert bench.truth("velocity_rad_s") > 1.0


def test_shutdown_coasts_by_default_and_can_brake(bench):
    bench.set(0x605B, 0, 1, 2)
    bench.controlword(0x06)
    assert state(bench) == PdsState.OPERATION_ENABLED
    bench.run_until(bench.now + stopping_ns(A) + 2 * MS)
    assert state(bench) == PdsState.READY_TO_SWITCH_ON
    bench.set(0x605B, 0, 0, 2)
    bench.enable()
    bench.run(300 * MS)
    bench.controlword(0x06)
    assert state(bench) == PdsState.READY_TO_SWITCH_ON
    bench.run(2 * MS)
    assert bench.truth("velocity_rad_s") > 1.0


def test_enabling_during_braking_cancels_disabling(bench):
    bench.controlword(0x07)
    bench.run(50 * MS)
    bench.controlword(0x0F)
    count = len(bench.sent)
    bench.run(500 * MS)
    assert state(bench) == PdsState.OPERATION_ENABLED
    assert bench.read(0x606B) == V
    words = [data for _, can_id, data in bench.sent[count:] if can_id == 0x185]
    assert all(word[0] == 0x37 for word in words)  # the drive never left operation enabled


def test_later_command_overrides_disabling(bench):
    bench.controlword(0x07)
    bench.run(10 * MS)
    bench.controlword(0x02)
    assert state(bench) == PdsState.QUICK_STOP_ACTIVE
    bench.run(10 * MS)
    bench.controlword(0x00)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    assert bench.truth("velocity_rad_s") > 0.5  # still turning


@pytest.mark.parametrize("word", [0x00, 0x0D, 0xFF01 & ~0x80])
def test_disable_voltage_coasts_immediately(bench, word):
    bench.controlword(word)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    bench.run(2 * MS)
    assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-6)


def test_interrupted_move_is_not_resumed():
    """Check in pp: after a quick stop and a new enabling, the old set-point is discarded."""
    bench = Bench()
    bench.enable(mode=1)
    bench.set(0x607A, 0, 30_000, 4)
    bench.controlword(0x1F)
    bench.run(200 * MS)
    bench.controlword(0x02)
    bench.run(500 * MS)
    stood_at = bench.truth("position_inc")
    assert 0 < stood_at < 30_000
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(ENABLE + 1000 * MS)
    assert bench.truth("position_inc") == pytest.approx(stood_at, abs=10)


def test_nmt_stop_aborts_the_connection(bench):
    """Check 6007h = 1: fault. EMCY is not sent in STOPPED (CiA 301); the state shows it."""
    bench.nmt(0x02)
    assert state(bench) == PdsState.FAULT_REACTION_ACTIVE
    bench.run(500 * MS)
    assert state(bench) == PdsState.FAULT
    bench.nmt(0x80)
    assert bench.read(0x603F, signed=False) == 0x8100


def test_reset_communication_aborts_the_connection(bench):
    bench.set(0x6007, 0, 3, 2)
    bench.nmt(0x82)
    assert state(bench) == PdsState.QUICK_STOP_ACTIVE
    bench.run(500 * MS)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    assert bench.read(0x6007) == 3  # it does not reset 60xxh
