"""Every protective fault: EMCY, error objects, reaction, torque, and recovery.

Codes: CiA 301 (7.2.7.1) and the list of CiA 402-1 (also marel-keytech/openCANopen,
cia402-error-codes.h); bits of 1001h: CiA 301, 7.5.2.2. Statuswords: CiA 402-2, table of states.
"""

import struct

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import BOOT_UP, MS, NODE, Bench

V = 40_000
S = PdsState

# stimulus, its bad value, its good one, EMCY code, 1001h, whether the motor brakes (605Eh = 2)
FAULTS = [
    ("short_circuit", 1, 0, 0x2320, 0x03, False),
    ("mains_over_voltage", 1, 0, 0x3110, 0x05, False),
    ("mains_under_voltage", 1, 0, 0x3120, 0x05, True),
    ("power", 0, 1, 0x3220, 0x05, False),
    ("device_temperature_c", 85.0, 84.9, 0x4210, 0x09, True),
    ("encoder", 0, 1, 0x7305, 0x01, False),
    ("sto", 1, 0, 0x8A88, 0x21, False),
]
STO_FAULTS = {"sto": "fault"}


def running(**settings: object) -> Bench:
    bench = Bench(plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.1}, **settings)
    bench.enable(mode=3)
    bench.set(0x60FF, 0, V, 4)
    bench.run(300 * MS)
    return bench


def state(bench: Bench) -> float:
    return bench.truth("state")


def stimulate(bench: Bench, name: str, value: float) -> None:
    bench.drive.stimulate(name, value, bench.now)
    bench._drain()


def emergencies(bench: Bench) -> list[str]:
    return [data.hex() for _, can_id, data in bench.sent if can_id == 0x080 + NODE]


@pytest.mark.parametrize(("name", "bad", "good", "code", "register", "braked"), FAULTS)
def test_fault_is_reported_cuts_torque_and_can_be_reset(name, bad, good, code, register, braked):
    bench = running(protection=STO_FAULTS)
    speed = bench.truth("velocity_rad_s")
    stimulate(bench, name, bad)
    assert emergencies(bench) == [struct.pack("<HB5x", code, register).hex()]
    assert bench.read(0x603F, signed=False) == code
    assert bench.read(0x1001, signed=False) == register
    assert bench.read(0x1003, 0) == 1
    assert bench.read(0x1003, 1) == code
    assert state(bench) == (S.FAULT_REACTION_ACTIVE if braked else S.FAULT)
    if not braked:  # coasts without current from the next tick on
        assert bench.truth("current_a") == 0.0
        assert bench.truth("velocity_rad_s") > 0.9 * speed
    bench.run(100 * MS)
    assert state(bench) == S.FAULT
    assert bench.truth("current_a") == 0.0
    assert (bench.truth("velocity_rad_s") < 0.1 * speed) is braked
    assert bench.statusword() & 0x4F == 0x08

    bench.controlword(0x80)  # the cause still stands
    assert state(bench) == S.FAULT
    assert len(emergencies(bench)) == 1
    stimulate(bench, name, good)
    assert state(bench) == S.FAULT  # no fault resets itself
    bench.controlword(0x00)
    bench.controlword(0x80)
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert emergencies(bench)[1:] == ["0000000000000000"]
    assert bench.read(0x603F) == 0
    assert bench.read(0x1001) == 0
    assert bench.read(0x1003, 1) == code  # the history is kept
    bench.run(20_000 * MS)  # comes to rest
    assert bench.truth("current_a") == 0.0  # no torque until enabled again
    bench.enable()


@pytest.mark.parametrize(("name", "bad", "good", "code", "register", "braked"), FAULTS)
def test_cause_at_power_on_is_reported_after_boot_up(name, bad, good, code, register, braked):
    bench = Bench()
    stimulate(bench, name, bad)
    bench.run(BOOT_UP)
    if name in ("sto", "power"):  # no fault while no torque is wanted
        assert emergencies(bench) == []
        assert state(bench) == S.SWITCH_ON_DISABLED
        return
    frames = [(can_id, data.hex()) for _, can_id, data in bench.sent]
    assert frames == [
        (0x700 + NODE, "00"),
        (0x080 + NODE, struct.pack("<HB5x", code, register).hex()),
    ]
    assert state(bench) == S.FAULT
    stimulate(bench, name, good)
    bench.nmt(0x81)
    bench.run(BOOT_UP)
    assert state(bench) == S.SWITCH_ON_DISABLED


def test_fault_without_braking_ends_a_fault_reaction():
    bench = running()
    stimulate(bench, "device_temperature_c", 90.0)
    assert state(bench) == S.FAULT_REACTION_ACTIVE
    stimulate(bench, "short_circuit", 1)
    assert state(bench) == S.FAULT
    assert emergencies(bench) == ["1042090000000000", "20230b0000000000"]  # 1001h: both classes
    stimulate(bench, "short_circuit", 0)
    bench.controlword(0x80)
    assert state(bench) == S.FAULT  # the device is still hot
    assert bench.read(0x603F) == 0x2320  # the last one, as in 1003h:1


@pytest.mark.parametrize("code", [0x2320, 0x3110, 0x3210, 0x3220, 0x7122, 0x7305, 0x8A88])
def test_fault_where_braking_is_harmful_has_no_reaction(code):
    bench = running()
    stimulate(bench, "fault", code)
    assert state(bench) == S.FAULT


def test_memory_fault_ends_with_reset_node_only():
    bench = running()
    stimulate(bench, "fault", 0x5530)
    bench.run(200 * MS)
    bench.controlword(0x80)
    assert state(bench) == S.FAULT
    bench.nmt(0x81)
    bench.run(BOOT_UP)
    assert state(bench) == S.SWITCH_ON_DISABLED


# --- safe torque off


@pytest.mark.parametrize("words", [(), (0x06,), (0x06, 0x07), (0x06, 0x07, 0x0F)])
def test_safe_torque_off_disables_and_prevents_readiness(words):
    bench = Bench()
    bench.operational()
    for word in words:
        bench.controlword(word)
    bench.run(25 * MS)
    stimulate(bench, "sto", 1)
    assert state(bench) == S.SWITCH_ON_DISABLED
    bench.run(2 * MS)
    assert bench.truth("current_a") == 0.0
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(100 * MS)
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert bench.statusword() & 0x4F == 0x40
    stimulate(bench, "sto", 0)
    bench.run(100 * MS)
    bench.controlword(0x0F)  # as a host that repeats its word: no torque comes of it
    bench.run(100 * MS)
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert emergencies(bench) == []
    bench.enable()


def test_safe_torque_off_cuts_torque_while_braking():
    bench = running()
    stimulate(bench, "fault", 0x4310)
    assert state(bench) == S.FAULT_REACTION_ACTIVE
    stimulate(bench, "sto", 1)
    assert state(bench) == S.FAULT
    bench = running()
    bench.controlword(0x02)
    assert state(bench) == S.QUICK_STOP_ACTIVE
    stimulate(bench, "sto", 1)
    assert state(bench) == S.SWITCH_ON_DISABLED
    bench.run(2 * MS)
    assert bench.truth("current_a") == 0.0
    assert bench.truth("velocity_rad_s") > 1.0  # coasts


def test_safe_torque_off_as_a_fault_has_the_vendors_code():
    bench = running(protection={"sto": "fault", "sto_error_code": 0x5441})
    stimulate(bench, "sto", 1)
    assert emergencies(bench) == ["4154010000000000"]
    bench = Bench(protection=STO_FAULTS)
    bench.operational()
    bench.controlword(0x06)
    stimulate(bench, "sto", 1)  # without power there is no torque to lose
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert emergencies(bench) == []


# --- the encoder


def test_lost_encoder_stops_counting_and_loses_reference():
    bench = running()
    bench.set(0x6060, 0, 6, 1)
    bench.run(500 * MS)
    bench.controlword(0x1F)
    bench.run(20 * MS)
    assert bench.statusword() & 0x1400 == 0x1400  # homing attained
    bench.controlword(0x0F)
    bench.set(0x6060, 0, 3, 1)
    bench.run(200 * MS)
    before = bench.truth("position_rad")
    stimulate(bench, "encoder", 0)
    position = bench.read(0x6064)
    assert bench.read(0x606C) == 0
    bench.run(50 * MS)
    assert bench.truth("position_rad") > before + 0.05  # the motor coasts unobserved
    assert bench.read(0x6064) == position
    bench.run(20_000 * MS)
    stimulate(bench, "encoder", 1)
    assert bench.read(0x6064) == position  # counting continues from there
    bench.controlword(0x80)
    bench.set(0x6060, 0, 6, 1)
    assert bench.statusword() & 0x1400 == 0  # homing is no longer attained
    bench.enable(mode=1)
    bench.set(0x607A, 0, position + 1000, 4)
    bench.controlword(0x1F)
    bench.run(1000 * MS)
    assert bench.read(0x6064) == pytest.approx(position + 1000, abs=5)  # target window


# --- warnings, and the bus


def test_warning_is_statusword_bit_7_only():
    bench = running(protection={"device_temperature_warning_c": 60.0})
    for celsius, warns in ((59.9, False), (60.0, True), (84.9, True), (20.0, False)):
        stimulate(bench, "device_temperature_c", celsius)
        bench.run(10 * MS)  # the inhibit time of TPDO 1
        assert (bench.last(0x185)[0] & 0x80 != 0) is warns
        assert bench.statusword() & 0x6F == 0x27
    assert emergencies(bench) == []


def test_error_passive_is_in_1001h_and_stops_nothing():
    bench = running()
    stimulate(bench, "error_passive", 1)
    assert emergencies(bench) == ["2081110000000000"]
    assert bench.read(0x1001) == 0x11
    assert state(bench) == S.OPERATION_ENABLED
    stimulate(bench, "error_passive", 0)
    assert emergencies(bench)[1:] == ["0000000000000000"]
    assert bench.read(0x1001) == 0


@pytest.mark.parametrize(
    ("option", "after"),
    [(0, S.OPERATION_ENABLED), (1, S.FAULT), (2, S.SWITCH_ON_DISABLED), (3, S.SWITCH_ON_DISABLED)],
)
def test_bus_off_acts_as_in_6007h_and_is_reported_after(option, after):
    bench = running()
    bench.set(0x6007, 0, option, 2)
    stimulate(bench, "bus_off", 1)
    assert emergencies(bench) == []  # bus off, nothing is sent
    bench.run(500 * MS)
    assert state(bench) == after
    stimulate(bench, "bus_off", 0)
    assert emergencies(bench)[0][:4] == "4081"
    assert int(emergencies(bench)[0][4:6], 16) & 0x11 == 0x11


@pytest.mark.parametrize("name", ["sto", "encoder", "short_circuit", "error_passive", "bus_off"])
@pytest.mark.parametrize("value", [-1, 0.5, 2, float("nan")])
def test_switch_stimulus_other_than_0_or_1_is_rejected(name, value):
    with pytest.raises(ValueError, match=f"{name} is 0 or 1"):
        Bench().drive.stimulate(name, value, 0)


@pytest.mark.parametrize("value", [-274, 1001, float("nan")])
def test_impossible_device_temperature_is_rejected(value):
    with pytest.raises(ValueError, match=r"-273\.15\.\.1000 C"):
        Bench().drive.stimulate("device_temperature_c", value, 0)


def test_switch_set_to_its_present_state_does_nothing():
    bench = running()
    for name, value in (("sto", 0), ("encoder", 1), ("error_passive", 0), ("bus_off", 0)):
        stimulate(bench, name, value)
    assert state(bench) == S.OPERATION_ENABLED
    assert emergencies(bench) == []
    stimulate(bench, "encoder", 0)
    stimulate(bench, "encoder", 0)
    assert len(emergencies(bench)) == 1


def test_603fh_is_the_last_error_and_all_bar_the_reset():
    """Check that 603Fh is the lower 16 bits of 1003h:1 (Kollmorgen's AKD manual, 603Fh)."""
    bench = running()
    stimulate(bench, "power", 0)
    stimulate(bench, "device_temperature_c", 90)
    for _ in range(2):
        assert bench.read(0x603F, signed=False) == 0x4210
        assert bench.read(0x1003, 1, signed=False) & 0xFFFF == 0x4210
        assert bench.read(0x1003, 2, signed=False) & 0xFFFF == 0x3220
        bench.controlword(0)
        bench.controlword(0x80)
        assert state(bench) == S.FAULT
        stimulate(bench, "device_temperature_c", 20)  # the supply is not back yet
    stimulate(bench, "power", 1)
    bench.controlword(0)
    bench.controlword(0x80)
    assert state(bench) == S.SWITCH_ON_DISABLED
    assert bench.read(0x603F, signed=False) == 0


def test_fault_without_reset_is_not_hidden_by_the_next():
    """Check that a memory fault ends with reset node only, whatever fails later."""
    bench = running()
    stimulate(bench, "fault", 0x5530)
    stimulate(bench, "fault", 0x8611)
    assert bench.read(0x603F, signed=False) == 0x8611
    bench.run(500 * MS)
    bench.controlword(0)
    bench.controlword(0x80)
    assert state(bench) == S.FAULT
    bench.nmt(0x81)
    bench.run(BOOT_UP + 10 * MS)
    assert state(bench) == S.SWITCH_ON_DISABLED


PASSIVE = (0x2000_0204, bytes.fromhex("0020000000008000"))  # linux/can/error.h: TEC 128
ACTIVE = (0x2000_0004, bytes.fromhex("0040000000000000"))
OFF = (0x2000_0040, bytes(8))
RESTARTED = (0x2000_0100, bytes(8))


def test_error_passive_controller_continues_and_reports_it():
    bench = running()
    bench.send(*PASSIVE)
    assert emergencies(bench) == ["2081110000000000"]
    assert state(bench) == S.OPERATION_ENABLED
    bench.send(*ACTIVE)
    assert emergencies(bench)[1:] == ["0000000000000000"]
    assert ("warning", "CAN error passive (TEC 128, REC 0)") in bench.events


@pytest.mark.parametrize("behaviour", [0, 1, 2])  # 1029h:1
@pytest.mark.parametrize(
    ("option", "after"),
    [(0, S.OPERATION_ENABLED), (1, S.FAULT), (2, S.SWITCH_ON_DISABLED), (3, S.SWITCH_ON_DISABLED)],
)
def test_bus_off_controller_acts_as_in_6007h_and_reports(option, after, behaviour):
    bench = running()
    bench.set(0x6007, 0, option, 2)
    bench.set(0x1029, 1, behaviour, 1)
    count = len(bench.sent)
    bench.send(*OFF)
    bench.run(500 * MS)
    assert bench.sent[count:] == []
    assert state(bench) == after
    bench.send(*RESTARTED)
    told = emergencies(bench)
    if behaviour == 2:
        assert told == []  # STOPPED: no EMCY (CiA 301, 7.3.2.2.4)
        return
    register = 0x11  # generic and communication, of the bus or of the fault caused by 6007h
    assert told[0] == struct.pack("<HB5x", 0x8140, register).hex()
    assert told[1] == struct.pack("<HB5x", 0, register if after is S.FAULT else 0).hex()
    assert bench.read(0x603F, signed=False) == (0x8100 if after is S.FAULT else 0)
    shown = {S.OPERATION_ENABLED: 0x27, S.FAULT: 0x08, S.SWITCH_ON_DISABLED: 0x40}
    assert bench.statusword() & 0x6F == shown[after]
