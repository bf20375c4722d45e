"""A rig whose drives' clocks disagree: a group's common moves end apart."""

from pathlib import Path

import pytest

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory

NAMES = ("left", "right")
DRIVE = """
[controller.{name}]
kind = "cia402"
bus = "can0"
node_id = {node}
plant = {{ preset = "wheel_60w", load_inertia_kg_m2 = 0.0 }}
oscillator = {{ {oscillator} }}
[motor.{name}]
adaptation = "cia402"
controller = "{name}"
[motor.{name}.model]
velocity_max_rad_s = 2.0
acceleration_max_rad_s2 = 10.0
gear_ratio = 66.0
encoder_increments_rev = 2000
"""


def rig_with(left, right, seed=0):
    text = f"[rig]\nseed = {seed}\n[bus.can0]\nbitrate_bit_s = 1_000_000\n"
    for name, node, oscillator in (("left", 1, left), ("right", 2, right)):
        text += DRIVE.format(name=name, node=node, oscillator=oscillator)
    text += '[group.both]\nmotors = ["left", "right"]\n'
    return Rig(parse_rig(Source(Path("rig.toml"), text), installed_plugins()))


def first_and_last_s(rig, duration_s):
    """Return when each drive's demand of a common move started and arrived [s], to 0.1 ms."""
    group = rig.groups["both"]
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    distance_rad = 2.0 * (duration_s - 0.2)  # 0.2 s to reach 2 rad/s, and 0.2 s to stop
    group.set_trajectory(*(TrapezoidalTrajectory(distance_rad) for _ in group))
    group.start()
    demands = {name: [] for name in NAMES}
    for wait_s in (0.0, duration_s - 0.25):
        rig.runtime.run_for(wait_s)
        for _ in range(1500):
            for name in NAMES:
                demand = rig.controllers[name].snapshot()["demand_inc"]
                demands[name].append((rig.runtime.now_ns() / 1e9, demand))
            rig.runtime.run_for(0.0001)
    group.wait_until_done(timeout_s=1.0)
    left, arrived = [], []
    for seen in demands.values():
        left.append(next(t for t, demand in seen if demand != seen[0][1]))
        arrived.append(next(t for t, demand in seen if demand == seen[-1][1]))
    return left, arrived


@pytest.mark.parametrize("ppm", [0.0, 500.0, -2000.0])
def test_common_move_ends_apart_by_clock_error_times_duration(ppm):
    with rig_with(f"ppm = {ppm}", f"ppm = {-ppm}") as rig:
        left, arrived = first_and_last_s(rig, 10.0)
    assert abs(left[0] - left[1]) <= 0.0011  # within a servo tick of each drive
    # 10 s by each drive's clock; the profile's values are rounded to the drive's units
    assert arrived[1] - arrived[0] == pytest.approx(2 * ppm * 1e-6 * 10.0, abs=0.0021)
    assert sum(arrived) / 2 - sum(left) / 2 == pytest.approx(10.0, abs=0.005)


def test_random_clocks_follow_the_runs_seed():
    drawn = "ppm_max = 100, phase_max_s = 0.001"
    clocks = []
    for seed in (1, 1, 2):
        with rig_with(drawn, drawn, seed) as rig:
            clocks.append([rig.world.controller(name).oscillator for name in NAMES])
    assert clocks[0] == clocks[1] != clocks[2]
    assert clocks[0][0] != clocks[0][1]
