"""Data sheet motors behind the emulated drive: bench experiments compared with printed values.

Nothing is taken from the plant's parameters.

Printed values: maxon catalogue page "EC 13 13 mm, brushless, 6 Watt", order number 305194, lines 2,
7 and 15; Faulhaber data sheets "DC-Micromotors 3,2 mNm, Series 1331 ... SR" and "Brushless
DC-Servomotors 47,1 mNm, Series 3564 ... B", no-load speed, stall torque, mechanical time constant.

In all three experiments the drive is in profile torque mode, with a command above the motor's
capability (6071h at its maximum, 6087h too). Its stage thus applies the whole supply to the
winding, as data sheets assume.

- No-load speed: the shaft is free; 606Ch [increments/s] after a second.
- Stall torque: a stop holds the shaft; 6077h by 6076h when the current is steady.
- Mechanical time constant: the step response of the free shaft. It starts at the voltage step (the
  last instant without current) and ends when a tachometer shows 63.2 % of the final speed.
"""

from itertools import pairwise

import pytest

from tests.support.cia402.bench import MS, NODE, Bench

TICK_NS = 200_000
SERVO = {"tick_s": TICK_NS / 1e9, "current_steps": 20}

# no-load speed [rpm], stall torque [mN m], mechanical time constant [ms]
PRINTED = {
    "maxon_ec_13_305194": (27_200, 7.83, 6.29),
    "faulhaber_1331t012sr": (9_900, 9.90, 7.0),
    "faulhaber_3564k036b": (11_550, 379.0, 11.0),
}


def all_voltage(preset, **plant):
    """Return a bench that has just received the command, and has not answered yet."""
    bench = Bench(plant={"preset": preset, **plant}, servo=SERVO)
    bench.enable(mode=4)
    bench.set(0x6072, 0, 0xFFFF, 2)
    bench.set(0x6087, 0, 0xFFFF_FFFF, 4)
    bench.send(0x600 + NODE, bytes.fromhex("2B716000FF7F0000"))
    return bench


def no_load_speed_rpm(preset):
    bench = all_voltage(preset)
    bench.run(1_000 * MS)
    return bench.read(0x606C) / 2000 * 60


def stall_torque_mn_m(preset):
    bench = all_voltage(preset, stop_high_rad=0.01)
    bench.run(30 * MS)
    assert bench.truth("velocity_rad_s") == 0.0
    return bench.read(0x6077) * bench.read(0x6076) / 1000


def mechanical_time_constant_ms(preset):
    end_rad_s = no_load_speed_rpm(preset) * 2 * 3.14159265 / 60
    bench = all_voltage(preset)
    began = bench.now
    seen = []
    for _ in range(500):
        bench.run(TICK_NS)
        if bench.truth("current_a") == 0.0:
            began = bench.now
        seen.append((bench.now, bench.truth("velocity_rad_s")))
    reached = 0.632 * end_rad_s
    (t0, w0), (t1, w1) = next(pair for pair in pairwise(seen) if pair[1][1] >= reached)
    return (t0 + (t1 - t0) * (reached - w0) / (w1 - w0) - began) / MS


@pytest.mark.parametrize("preset", PRINTED)
def test_experiments_give_the_data_sheet_values(preset):
    measured = (
        no_load_speed_rpm(preset),
        stall_torque_mn_m(preset),
        mechanical_time_constant_ms(preset),
    )
    row = (f"{m:.4g} of {p:.4g}" for m, p in zip(measured, PRINTED[preset], strict=True))
    print(preset, *row, sep=" | ")
    assert measured == pytest.approx(PRINTED[preset], rel=0.02)
