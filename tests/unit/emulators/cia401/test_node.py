"""The I/O node: outputs, inputs, counters, and loss of the host.

Expected: CiA 401 (6000h, 6200h, 6206h, 6207h, 6411h, 6443h, 6444h and the default PDOs 1 and 2),
CiA 406 (6010h, 6020h, here 800h further), CiA 301 (multiple device modules, 1029h, PDOs).
"""

import math
import struct

import pytest

from tests.support.cia402.io_bench import MS, NODE, IoBench

HALF = 16384  # 5 V
FULL_A = 8.0  # at 10 V, wheel_60w


@pytest.fixture
def io() -> IoBench:
    return IoBench(channels=2)


def test_device_type_and_identity_are_standard(io):
    io.boot()
    # CiA 301, device type: of a multiple device module FFFFh and the first profile
    assert io.read(0x1000, signed=False) == 0xFFFF_0191
    # CiA 401: digital inputs and outputs, analogue outputs (bits 0, 1, 3); CiA 406: multi-sensor
    assert io.read(0x67FF, signed=False) == 0x000B_0191
    assert io.read(0x6FFF, signed=False) == 0x000A_0196
    assert [io.read(index, 0) for index in (0x6000, 0x6411, 0x6820)] == [1, 2, 2]
    assert io.write(0x6411, 3, 0, 2) == 0x0609_0011  # there is no channel 3


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_default_pdos_map_existing_channels(channels):
    io = IoBench(channels=channels)
    io.boot()
    outputs = [0x6411_0010 + (channel << 8) for channel in range(1, channels + 1)]
    counts = [0x6820_0020 + (channel << 8) for channel in range(1, channels + 1)]
    found = {}
    for mapping in (0x1600, 0x1601, 0x1A00, 0x1A01, 0x1A02):
        number = io.read(mapping, 0)
        found[mapping] = [io.read(mapping, place) for place in range(1, number + 1)]
    assert found == {
        0x1600: [0x6200_0108],
        0x1601: outputs,
        0x1A00: [0x6000_0108],
        0x1A01: counts[:2],
        0x1A02: counts[2:],
    }
    assert (io.read(0x1802, 1, signed=False) >> 31 == 0) is (channels > 2)
    io.nmt(0x01)
    io.sync()
    sizes = {can_id: len(data) for _, can_id, data in io.sent if 0x280 <= can_id < 0x400}
    expected = {0x280 + NODE: 4 * min(2, channels), 0x380 + NODE: 4 * (channels - 2)}
    assert sizes == {can_id: size for can_id, size in expected.items() if size > 0}


def test_amplifier_is_ready_after_enable_time_with_tpdo(io):
    io.operational()
    assert io.last(0x180 + NODE) == b"\x00"
    io.enables(0b10)
    asked = io.now
    io.run(5 * MS - 1)
    assert io.times(0x180 + NODE)[-1] <= asked
    io.run(1)
    assert io.times(0x180 + NODE)[-1] == asked + 5 * MS
    assert io.last(0x180 + NODE) == b"\x04"  # bit 2: ready of channel 2
    io.enables(0)
    assert io.last(0x180 + NODE) == b"\x00"
    assert io.times(0x180 + NODE)[-1] == io.now


def test_enable_shorter_than_delay_has_no_effect(io):
    io.operational()
    io.enables(1)
    io.run(4 * MS)
    io.enables(0)
    io.run(2 * MS)
    io.enables(1)
    io.run(4 * MS)
    assert io.read(0x6000, 1) == 0


@pytest.mark.parametrize(
    ("raw", "ampere"),
    [(HALF, FULL_A / 2), (-HALF, -FULL_A / 2), (-32768, -FULL_A), (1, FULL_A / 32768)],
)
def test_analogue_output_sets_motor_current(raw, ampere):
    """A load holds the motor, so that no back-EMF limits the current."""
    io = IoBench(channels=1, plant={"preset": "wheel_60w", "coulomb_friction_n_m": 100.0})
    io.ready()
    io.outputs(raw)
    io.run(50 * MS)
    assert io.truth("current_a") == pytest.approx(ampere, rel=1e-9)  # last bits of the current loop
    assert io.truth("output_v") == raw * 10 / 32768


def test_output_scale_comes_from_rig():
    plant = {"preset": "wheel_60w", "coulomb_friction_n_m": 100.0}
    amplifier = {"current_per_volt_a_v": 0.25}
    io = IoBench(plant=plant, amplifier=amplifier).ready()
    io.outputs(HALF)
    io.run(50 * MS)
    assert io.truth("current_a") == pytest.approx(1.25, rel=1e-9)
    io = IoBench(plant=plant, amplifier={"current_per_volt_a_v": 2.0}).ready()
    io.outputs(HALF)
    io.run(50 * MS)
    assert io.truth("current_a") == pytest.approx(FULL_A, rel=1e-9)  # limit of the amplifier


def test_disabled_amplifier_has_no_current(io):
    io.operational()
    io.outputs(HALF, HALF)
    io.run(50 * MS)
    assert (io.truth("current_a"), io.truth("channel_2_current_a")) == (0.0, 0.0)
    for _ in range(2):
        io.enables(0b01)  # the present output is effective from ready on
        io.run(10 * MS)
        assert io.truth("current_a") > 1.0
        assert io.truth("channel_2_current_a") == 0.0
        io.enables(0)
        io.run(10 * MS)
    io.enables(0b01)
    io.run(10 * MS)
    assert io.truth("channel_2_current_a") == 0.0


def test_each_output_moves_its_motor_and_counter(io):
    io.ready()
    io.outputs(1000, -1000)
    io.run(100 * MS)
    first, second = io.counts()
    assert first > 100
    assert second < -100
    assert first == io.truth("position_inc")
    assert second == io.truth("channel_2_position_inc")
    radian = 2000 * 66 / (2 * math.pi)  # wheel_60w
    assert abs(first - io.truth("position_rad") * radian) <= 1


def test_constant_current_accelerates_rotor_by_inertia():
    """a = (K i - friction) / J of the motor's data sheet, to within the current's rise time."""
    io = IoBench().ready()
    io.outputs(3277)  # 1 V, 0.8 A
    io.run(100 * MS)
    before, start = io.truth("velocity_rad_s"), io.now
    io.run(100 * MS)
    inertia = 3.37e-6 + 0.05 / 66**2
    current = 3277 * 10 / 32768 * 0.8
    expected = (0.0259 * current - 4.0e-3) / inertia / 66 * (io.now - start) / 1e9
    # viscous friction takes a little; the current follows the back-EMF with a small lag
    assert io.truth("velocity_rad_s") - before == pytest.approx(expected, rel=0.02)


def test_synchronous_outputs_and_counters_act_at_sync(io):
    io.boot()
    io.set(0x1401, 2, 1, 1)
    io.nmt(0x01)
    io.enables(0b11)
    io.run(6 * MS)
    io.outputs(HALF, 0)
    io.run(20 * MS)
    assert io.truth("current_a") == 0.0
    io.sync()
    synced = io.now
    assert io.truth("output_v") == 5.0
    assert io.times(0x280 + NODE) == [synced]
    io.run(20 * MS)
    assert io.truth("current_a") > 1.0


def test_counter_change_without_sync_sends_nothing(io):
    io.ready()
    io.outputs(HALF, HALF)
    count = len(io.sent)
    io.run(500 * MS)
    assert io.sent[count:] == []


def test_preset_sets_counter_without_motion(io):
    io.ready()
    io.outputs(HALF, HALF)
    io.run(100 * MS)
    io.outputs(0, 0)
    before = io.truth("position_rad")
    io.set(0x6810, 2, -5, 4)
    assert io.read(0x6820, 2) - -5 < io.truth("channel_2_velocity_rad_s") * 21_100 * 0.003
    assert io.read(0x6820, 1) > 100
    assert io.truth("position_rad") >= before


def test_counter_wraps_around_at_32_bits():
    io = IoBench().ready()
    io.set(0x6810, 1, 0x7FFF_FFFF, 4)
    io.outputs(HALF)
    io.run(100 * MS)
    io.outputs(0)
    io.sync()
    assert struct.unpack("<i", io.last(0x280 + NODE))[0] < -0x7FFF_0000
    assert io.read(0x6820, 1) < -0x7FFF_0000


# --- loss of the host


def test_lost_host_sets_outputs_to_error_values(io):
    io.ready()
    io.watch_host(100)
    io.outputs(HALF, -HALF)
    io.run(99 * MS)
    assert io.truth("output_v") == 5.0
    lost = io.now
    io.run(1 * MS)
    assert (io.truth("output_v"), io.truth("channel_2_output_v")) == (0.0, 0.0)
    assert io.truth("ready") == 0.0
    io.run(250_000)  # the amplifier's next tick
    assert io.truth("current_a") == 0.0
    assert ("warning", "node 127 is lost: the outputs have their error values") in io.events
    # CiA 301: EMCY 8130h; communication error and generic error in 1001h
    emergencies = [data for time, can_id, data in io.sent if can_id == 0x080 + NODE and time > lost]
    assert emergencies[0][:3] == b"\x30\x81\x11"
    assert io.read(0x6411, 1) == 0
    assert io.read(0x6200, 1) == 0


def test_bus_off_sets_outputs_to_error_values(io):
    io.ready()
    io.outputs(HALF, -HALF)
    io.send(0x2000_0040, bytes(8))  # linux/can/error.h: bus-off
    assert (io.truth("output_v"), io.truth("channel_2_output_v")) == (0.0, 0.0)
    assert ("warning", "bus-off: the outputs have their error values") in io.events
    back = len(io.sent)
    io.send(0x2000_0100, bytes(8))  # restarted
    told = [data for _, can_id, data in io.sent[back:] if can_id == 0x080 + NODE]
    assert [data[:3] for data in told] == [b"\x40\x81\x11", b"\x00\x00\x00"]  # CiA 301: 8140h


def test_error_values_and_modes_are_writable(io):
    io.ready()
    io.set(0x6444, 1, -3277, 4)
    io.set(0x6443, 2, 0, 1)
    io.set(0x6206, 1, 0b01, 1)
    io.set(0x6207, 1, 0b01, 1)
    io.watch_host(100)
    io.outputs(HALF, HALF)
    io.run(101 * MS)
    assert io.read(0x6411, 1) == -3277
    assert io.read(0x6411, 2) == HALF
    assert io.read(0x6200, 1, signed=False) == 0xFF
    assert (io.truth("ready"), io.truth("channel_2_ready")) == (1.0, 1.0)
    assert io.truth("output_v") == -3277 * 10 / 32768


def test_outputs_after_loss_stay_until_written(io):
    io.ready()
    io.watch_host(100)
    io.outputs(HALF, HALF)
    io.run(200 * MS)
    io.heartbeat()
    io.nmt(0x01)
    io.run(50 * MS)
    assert io.truth("output_v") == 0.0
    assert io.truth("ready") == 0.0
    io.enables(1)
    io.outputs(HALF, 0)
    io.heartbeat()
    io.run(10 * MS)
    assert io.truth("current_a") > 1.0


@pytest.mark.parametrize("command", [0x02, 0x82])
def test_stop_or_reset_communication_is_a_loss(io, command):
    io.ready()
    io.outputs(HALF, HALF)
    io.nmt(command)
    assert (io.truth("output_v"), io.truth("ready")) == (0.0, 0.0)


def test_pre_operational_keeps_outputs(io):
    io.ready()
    io.outputs(HALF, HALF)
    io.nmt(0x80)
    io.run(10 * MS)
    assert io.truth("output_v") == 5.0
    assert io.truth("ready") == 1.0


def test_reset_node_sets_outputs_to_zero(io):
    io.ready()
    io.set(0x6444, 1, HALF, 4)
    io.outputs(HALF, HALF)
    io.outputs(HALF, HALF)
    io.run(50 * MS)
    assert io.truth("position_inc") > 0
    io.nmt(0x81)
    assert io.truth("output_v") == 0.0
    assert io.truth("ready") == 0.0
    assert io.truth("position_inc") == 0.0  # an incremental encoder's counter restarts
    assert io.truth("position_rad") > 0.0


# --- the amplifier


def test_faulty_amplifier_stays_off_until_reset_without_cause(io):
    io.ready()
    io.outputs(HALF, HALF)
    io.run(10 * MS)
    io.drive.stimulate("fault", 1, io.now)
    io._drain()
    assert io.last(0x180 + NODE) == b"\x06"  # channel 1: fault, not ready; channel 2: ready
    io.run(250_000)  # the amplifier's next tick
    assert io.truth("current_a") == 0.0
    io.enables(0b10)
    assert io.last(0x180 + NODE) == b"\x06"  # the cause is still there
    io.enables(0b11)
    io.drive.stimulate("fault", 0, io.now)
    io.run(20 * MS)
    assert io.last(0x180 + NODE) == b"\x06"  # the enable input was not removed since
    io.enables(0b10)
    assert io.last(0x180 + NODE) == b"\x04"
    io.enables(0b11)
    io.run(10 * MS)
    assert io.last(0x180 + NODE) == b"\x05"
    assert ("error", "amplifier 1: fault") in io.events


def test_amplifier_without_supply_recovers_by_itself(io):
    io.ready()
    io.drive.stimulate("channel_2_power", 0, io.now)
    assert io.read(0x6000, 1) == 0b0001
    io.drive.stimulate("channel_2_power", 1, io.now)
    io.run(6 * MS)
    assert io.read(0x6000, 1) == 0b0101


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("heat", 1, "known: load_torque_n_m, fault, power, channel_2_load_torque_n_m"),
        ("channel_3_power", 1, "there is no stimulus 'channel_3_power'"),
        ("fault", 2, "fault is 0 or 1, not 2"),
        ("power", 0.5, "power is 0 or 1, not 0.5"),
        ("load_torque_n_m", math.inf, "load_torque_n_m is -1e"),
    ],
)
def test_unknown_stimulus_is_refused(io, name, value, told):
    with pytest.raises(ValueError, match=told):
        io.drive.stimulate(name, value, 0)


def test_load_moves_motor_without_current(io):
    io.boot()
    io.drive.stimulate("channel_2_load_torque_n_m", -2.0, io.now)
    io.run(100 * MS)
    assert io.truth("channel_2_position_rad") > 0.01
    assert io.truth("position_rad") == 0.0


def test_snapshot_has_no_side_effects(io):
    other = IoBench(channels=2)
    for bench in (io, other):
        bench.ready()
        bench.outputs(3000, -2000)
        for _ in range(40):
            bench.run(777_777)
            if bench is io:
                bench.drive.snapshot(bench.now)
        bench.run_until(400 * MS)
    assert io.drive.snapshot(io.now) == other.drive.snapshot(other.now)


def test_node_at_rest_has_no_deadline(io):
    io.boot()
    assert io.drive.next_deadline_ns() is None
    io.ready()
    assert io.drive.next_deadline_ns() is None
