"""Faults: EMCY, error objects, reaction, reset. CiA 301 (EMCY), CiA 402-2 (603Fh, 605Eh, 6007h)."""

import struct

import pytest

from motorhil.emulators.cia402.faults import error_register
from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import MS, NODE, Bench

V, A, QUICK = 40_000, 409_600, 819_200


def running(**settings: object) -> Bench:
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}, **settings)
    bench.enable(mode=3)
    bench.set(0x60FF, 0, V, 4)
    bench.run(300 * MS)
    return bench


def state(bench: Bench) -> float:
    return bench.truth("state")


def fault(bench: Bench, code: int) -> None:
    bench.drive.stimulate("fault", code, bench.now)
    bench._drain()


def test_following_error_emcy_is_the_golden_frame():
    """Check against drives.md (Faulhaber MC5010): 080h + node, 11 86 20 02 00 00 00 00.

    Code and profile bit are the standard's. In CiA 301, bit 0, generic, is set with every error.
    The
    rest is the vendor's.
    """
    bench = Bench(objects={"6065h": 500, "6066h": 10}, plant={"preset": "wheel_60w"})
    bench.enable(mode=1)
    bench.drive.stimulate("load_torque_n_m", 30.0, bench.now)  # stalls: 8 A give 13.7 N m
    bench.run(200 * MS)
    frames = [(time, data) for time, can_id, data in bench.sent if can_id == 0x080 + NODE]
    assert [data for _, data in frames] == [bytes.fromhex("1186210000000000")]
    assert bench.read(0x603F, signed=False) == 0x8611
    assert bench.read(0x1001) == 0x21
    assert bench.statusword() & 0x4F == 0x08
    assert ("error", "fault 8611h (following error)") in bench.events


def test_following_error_fault_needs_its_time():
    bench = Bench(objects={"6065h": 100, "6066h": 50})
    bench.enable(mode=1)
    bench.run(10 * MS)
    bench.drive.stimulate("load_torque_n_m", 30.0, bench.now)
    while abs(bench.truth("following_error_inc")) <= 100:
        bench.run(1 * MS)
    beyond = bench.now // MS * MS
    bench.run_while(lambda: state(bench) == PdsState.OPERATION_ENABLED)
    assert bench.now - beyond in (50 * MS, 51 * MS)


@pytest.mark.parametrize("window", [0, 0xFFFF_FFFF])
def test_following_error_can_be_switched_off(window):
    bench = Bench(objects={"6065h": window, "6066h": 0})
    bench.enable(mode=1)
    bench.drive.stimulate("load_torque_n_m", 30.0, bench.now)
    bench.run(300 * MS)
    assert abs(bench.truth("following_error_inc")) > 2000
    assert state(bench) == PdsState.OPERATION_ENABLED


@pytest.mark.parametrize(("option", "deceleration"), [(1, A), (2, QUICK)])
def test_fault_reaction_brakes_then_enters_fault(option, deceleration):
    bench = running()
    bench.set(0x605E, 0, option, 2)
    at = bench.now
    fault(bench, 0x4310)
    assert bench.hex_since(len(bench.sent) - 3)[0] == "085#1043090000000000"
    assert bench.last(0x185) == bytes.fromhex("1F02")
    assert state(bench) == PdsState.FAULT_REACTION_ACTIVE
    bench.controlword(0x00)
    bench.controlword(0x80)  # only the end of the reaction leaves this state
    stopping = round(1e9 * V / deceleration)
    bench.run_until(at + stopping - 1 * MS)
    assert state(bench) == PdsState.FAULT_REACTION_ACTIVE
    bench.run_until(at + stopping + 2 * MS)
    assert state(bench) == PdsState.FAULT
    bench.run(10 * MS)
    assert bench.last(0x185) == bytes.fromhex("1802")
    assert bench.truth("velocity_rad_s") < 0.5


def test_fault_reaction_0_coasts():
    bench = running()
    bench.set(0x605E, 0, 0, 2)
    fault(bench, 0x7300)
    assert state(bench) == PdsState.FAULT
    bench.run(2 * MS)
    assert bench.truth("velocity_rad_s") > 1.0
    assert bench.truth("current_a") == pytest.approx(0.0, abs=1e-6)


def test_fault_is_reset_by_an_edge_only():
    bench = running()
    fault(bench, 0x2310)
    bench.run(500 * MS)
    for word in (0x06, 0x07, 0x0F, 0x00):
        bench.controlword(word)
        assert state(bench) == PdsState.FAULT
    count = len(bench.sent)
    bench.controlword(0x80)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    assert bench.hex_since(count)[0] == "085#0000000000000000"  # error reset, no error
    assert bench.read(0x603F) == 0
    assert bench.read(0x1001) == 0
    fault(bench, 0x2310)
    bench.controlword(0x80)  # the bit was still set: no edge
    assert state(bench) == PdsState.FAULT
    bench.controlword(0x0F)
    bench.controlword(0x8F)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    bench.run(100 * MS)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED  # 8Fh enables nothing
    bench.enable()


def test_fault_is_entered_with_the_power_stage_off():
    bench = Bench()
    bench.operational()
    fault(bench, 0x5530)
    assert state(bench) == PdsState.FAULT
    assert bench.last(0x085) == bytes.fromhex("3055010000000000")


def test_fault_during_power_up_keeps_the_power_stage_off():
    bench = Bench()
    bench.operational()
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(10 * MS)
    fault(bench, 0x3210)
    assert state(bench) == PdsState.FAULT
    bench.run(100 * MS)
    assert state(bench) == PdsState.FAULT


def test_second_fault_is_reported_and_changes_only_603fh():
    bench = Bench()
    bench.operational()
    fault(bench, 0x5530)
    fault(bench, 0x4310)
    assert bench.times(0x085) == [bench.now, bench.now]
    assert bench.read(0x603F, signed=False) == 0x4310


def test_without_supply_drive_cannot_enable_or_brake():
    bench = running()
    bench.drive.stimulate("power", 0, bench.now)
    bench._drain()
    assert state(bench) == PdsState.FAULT
    assert bench.last(0x085)[:3] == bytes.fromhex("203205")
    assert not bench.statusword() & 0x10  # voltage enabled
    bench.controlword(0x80)
    assert state(bench) == PdsState.FAULT  # its cause is still present
    bench.drive.stimulate("power", 1, bench.now)
    bench.controlword(0x00)
    bench.controlword(0x80)
    assert state(bench) == PdsState.SWITCH_ON_DISABLED
    assert bench.statusword() & 0x10
    bench.run(20_000 * MS)  # coasts to rest
    bench.drive.stimulate("power", 0, bench.now)
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(100 * MS)
    assert state(bench) == PdsState.FAULT


@pytest.mark.parametrize("code", [0, -1, 0x10000, 1.5])
def test_stimulus_not_an_error_code_is_rejected(code):
    with pytest.raises(ValueError, match="error code"):
        Bench().drive.stimulate("fault", code, 0)


def test_unknown_stimulus_is_rejected_with_the_known_ones():
    with pytest.raises(ValueError, match="known: load_torque_n_m, fault, power"):
        Bench().drive.stimulate("lamp", 1, 0)


@pytest.mark.parametrize(
    ("code", "register"),
    [  # CiA 301, object 1001h: 0 generic, 1 current, 2 voltage, 3 temperature, 4 communication,
        (0x1000, 0x01),  # 5 device profile, 7 manufacturer
        (0x2310, 0x03),
        (0x3210, 0x05),
        (0x4210, 0x09),
        (0x5530, 0x01),
        (0x7320, 0x01),
        (0x8130, 0x11),
        (0x8210, 0x11),
        (0x8611, 0x21),
        (0xF004, 0x01),  # additional functions: CiA 402's, not a manufacturer's
        (0xFF01, 0x81),
    ],
)
def test_error_register_matches_the_code(code, register):
    assert error_register(code) == register


# --- the host becomes silent: 1016h and 6007h


def heartbeat_bench(option: int | None = None) -> Bench:
    """Return a bench running in pv that expects a heartbeat of node 127 every 200 ms."""
    bench = running()
    if option is not None:
        bench.set(0x6007, 0, option, 2)
    bench.set(0x1016, 1, 127 << 16 | 200, 4)
    bench.set(0x1029, 1, 1, 1)  # stay operational, so that the statusword is sent
    for _ in range(5):
        bench.send(0x77F, b"\x05")
        bench.run(100 * MS)
    bench.send(0x77F, b"\x05")
    return bench


@pytest.mark.parametrize(
    ("option", "after", "state_bits", "error"),
    [
        (None, PdsState.FAULT_REACTION_ACTIVE, "1F02", 0x8130),
        (1, PdsState.FAULT_REACTION_ACTIVE, "1F02", 0x8130),
        (2, PdsState.SWITCH_ON_DISABLED, "5002", 0),
        (3, PdsState.QUICK_STOP_ACTIVE, "1702", 0),
        (0, PdsState.OPERATION_ENABLED, "3706", 0),
    ],
)
def test_heartbeat_loss_has_the_effect_set_in_6007h(option, after, state_bits, error):
    bench = heartbeat_bench(option)
    lost = bench.now + 200 * MS
    bench.run_until(lost - 1)
    assert state(bench) == PdsState.OPERATION_ENABLED
    assert bench.times(0x085) == []
    bench.run_until(lost)
    assert bench.times(0x085) == [lost]
    assert bench.last(0x085)[:2] == bytes.fromhex("3081")
    assert bench.last(0x085)[2] & 0x11 == 0x11
    assert state(bench) == after
    assert bench.last(0x185) == bytes.fromhex(state_bits)
    assert bench.read(0x603F, signed=False) == error


@pytest.mark.parametrize("option", [1, 2, 3])
def test_heartbeat_loss_during_power_up_keeps_it_off(option):
    bench = Bench()
    bench.operational()
    bench.set(0x6007, 0, option, 2)
    bench.set(0x1016, 1, 127 << 16 | 50, 4)
    bench.send(0x77F, b"\x05")
    bench.run(40 * MS)
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(200 * MS)
    assert state(bench) == (PdsState.FAULT if option == 1 else PdsState.SWITCH_ON_DISABLED)


def test_heartbeat_loss_does_not_affect_an_idle_drive():
    bench = Bench()
    bench.operational()
    bench.set(0x1016, 1, 127 << 16 | 200, 4)
    bench.send(0x77F, b"\x05")
    bench.run(300 * MS)
    assert bench.times(0x085) != []
    assert state(bench) == PdsState.SWITCH_ON_DISABLED


def test_drive_is_usable_again_after_heartbeat_loss():
    bench = heartbeat_bench()
    bench.run(1000 * MS)
    assert state(bench) == PdsState.FAULT
    bench.send(0x77F, b"\x05")
    bench.controlword(0x00)
    bench.controlword(0x80)
    for word in (0x06, 0x07, 0x0F):
        bench.send(0x77F, b"\x05")
        bench.controlword(word)
    bench.run(50 * MS)
    assert state(bench) == PdsState.OPERATION_ENABLED
    assert struct.unpack("<H", bench.last(0x185))[0] & 0x6F == 0x27


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("load_torque_n_m", float("nan"), r"load_torque_n_m is -1e\+09..1e\+09 N m, not nan"),
        ("load_torque_n_m", 1e308, r"load_torque_n_m is -1e\+09..1e\+09 N m, not 1e\+308"),
        ("fault", 0, "fault takes an error code 0001h..FFFFh, not 0"),
        ("power", float("nan"), "power is 0 or 1, not nan"),
        ("load", 1.0, "there is no stimulus 'load'; known: load_torque_n_m, fault, power"),
    ],
)
def test_invalid_stimulus_is_rejected_and_changes_nothing(name, value, text):
    bench = Bench()
    bench.enable(mode=1)
    with pytest.raises(ValueError, match=text):
        bench.drive.stimulate(name, value, bench.now)
    bench.run(100 * MS)
    assert state(bench) == PdsState.OPERATION_ENABLED
    assert bench.truth("position_inc") == 0
