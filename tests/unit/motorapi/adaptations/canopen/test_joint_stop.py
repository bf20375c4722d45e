"""Simultaneous stop of drives by one SYNC: frames and true demands."""

from contextlib import contextmanager
from pathlib import Path

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    DeviceFault,
    FaultReaction,
    Motor,
    MotorGroup,
    Synchronization,
    TrapezoidalTrajectory,
)
from motorhil.motorapi.adaptations.cia402.motor import joint_stop_of
from tests.support.motors.kinds import MODEL
from tests.support.motors.wheels import INCREMENT_RAD, frames_on
from tests.unit.motorapi.test_fault_reactions import DRIVE

MS = 1_000_000
UNIT = "velocity_unit_rad_s = 4.7599888690754445e-05"
SYNC = 0x080
HALT = 0x0100


@contextmanager
def opened(count, bitrate=1_000_000, velocity_unit_inc=1):
    names = [f"m{number}" for number in range(1, count + 1)]
    text = f"[bus.can0]\nbitrate_bit_s = {bitrate}\n"
    for number, name in enumerate(names, 1):
        text += DRIVE.format(name=name, bus=0, number=number) + MODEL
    units = f"units = {{ velocity_unit_inc_s = {velocity_unit_inc:.1f} }}"
    text = text.replace('kind = "cia402"', f'kind = "cia402"\n{units}')
    text = text.replace(UNIT, f"velocity_unit_rad_s = {velocity_unit_inc * INCREMENT_RAD}")
    text += f"[group.all]\nmotors = {names!r}\n".replace("'", '"')
    with Rig(parse_rig(Source(Path("stops.toml"), text), installed_plugins())) as rig:
        yield rig, rig.groups["all"]


def started(rig, group, seconds=0.7):
    """Bring all motors to their plateaus, at 2 rad/s."""
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*(TrapezoidalTrajectory(2.5) for _ in group))
    group.synchronization = Synchronization.PHASE
    group.fault_reaction = FaultReaction.TOGETHER
    group.start()
    rig.runtime.run_for(seconds)


class Demands:
    """Each drive's profile demand at every tick; a drive stops when its demand slows down."""

    def __init__(self, rig, names):
        self.rig, self.names, self.seen = rig, names, []
        rig.runtime.every(0.001, self.look)

    def look(self):
        truths = [self.rig.controllers[name].snapshot() for name in self.names]
        self.seen.append((self.rig.runtime.now_ns(), [one["demand_inc"] for one in truths]))

    def slowing_ns(self, place):
        """Return the time when the demand of one first covered 1 % less in a tick than at first."""
        steps = [
            (at_ns, now[place] - before[place])
            for (_, before), (at_ns, now) in zip(self.seen, self.seen[1:], strict=False)
        ]
        return next(at_ns for at_ns, step in steps if step < 0.99 * steps[0][1])


@pytest.mark.parametrize("by_priority", [False, True], ids=["fifo", "priority"])
def test_one_sync_halts_all_and_demands_slow_at_one_tick(by_priority):
    """Also if the host's controller sends the smallest identifier first: SYNC."""
    with opened(10, bitrate=250_000) as (rig, group):
        host = next(one for one in rig.world.bus("can0")._ports if one.name == "host")
        host.by_priority = by_priority
        started(rig, group)
        demands = Demands(rig, [motor.name for motor in list(group)[1:]])
        heard = frames_on(rig)
        rig.runtime.run_for(0.01)
        rig.controllers["m1"].stimulate("fault", 0x7500)
        rig.runtime.run_for(0.1)
        syncs = [at_ns for at_ns, _, can_id, _ in heard if can_id == SYNC]
        assert len(syncs) == 1
        halts = [
            (at_ns, can_id)
            for at_ns, sender, can_id, data in heard
            if sender == "host" and 0x200 <= can_id < 0x580 and data[1] & HALT >> 8
        ]
        latched = [at_ns for at_ns, can_id in halts if can_id & 0x780 == 0x300]
        assert len(latched) == 9
        assert max(latched) < syncs[0]
        at_once = [at_ns for at_ns, can_id in halts if can_id & 0x780 == 0x200 and at_ns > syncs[0]]
        assert len(at_once) >= 9  # in case one was lost
        # Frames that act at once, at 250 kbit/s, would take 9 x 0.26 ms: three ticks.
        begun = {demands.slowing_ns(place) for place in range(9)}
        assert max(begun) - min(begun) == 0


def test_stop_beside_a_cyclic_sync_halts_each_separately():
    with opened(3) as (rig, group):
        started(rig, group)
        bus = group[0].hardware.node.bus
        cyclic = bus.sync.join(0.01, lambda: None)
        rig.runtime.run_for(0.05)
        assert joint_stop_of(bus) is None
        heard = frames_on(rig)
        rig.controllers["m1"].stimulate("fault", 0x7500)
        rig.runtime.run_for(0.6)
        cyclic.cancel()
        assert not any(can_id & 0x780 == 0x300 for _, _, can_id, _ in heard)
        for motor in list(group)[1:]:
            assert abs(motor.velocity()) < 0.01


def test_stop_does_not_wait_for_a_missing_sync():
    with opened(3) as (rig, group):
        started(rig, group)
        rule = FaultRule("no sync", FaultKind.DROP, identifier=SYNC, mask=0x7FF, sender="host")
        rig.faults.inject("can0", rule)
        rig.controllers["m1"].stimulate("fault", 0x7500)
        rig.runtime.run_for(0.6)
        for motor in list(group)[1:]:
            assert abs(motor.velocity()) < 0.01


def test_sync_after_a_joint_stop_starts_nothing():
    with opened(3) as (rig, group):
        started(rig, group)
        rig.controllers["m1"].stimulate("fault", 0x7500)
        rig.runtime.run_for(0.8)
        others = MotorGroup(group[1], group[2])
        before = others.for_each(Motor.position)
        group[1].hardware.node.bus.sync.send()
        rig.runtime.run_for(0.2)
        assert others.for_each(Motor.position) == pytest.approx(before, abs=1e-4)  # two increments
        others.set_trajectory(TrapezoidalTrajectory(-0.5), TrapezoidalTrajectory(-0.5))
        others.start()
        others.wait_until_done(timeout_s=5)
        made = [b - a for a, b in zip(others.for_each(Motor.position), before, strict=True)]
        assert made == pytest.approx([0.5, 0.5], abs=0.001)
        with pytest.raises(DeviceFault):
            group.wait_until_done()


def test_latched_target_invalidates_the_believed_one():
    with opened(2) as (_, group):
        first, second = group
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)
        first.set_setpoint(1.0)
        first.start()
        first.wait_until_done()
        first.set_setpoint(1.5)
        second.set_setpoint(0.5)
        group.start()
        group.wait_until_done()
        first.set_setpoint(1.0)  # the target that was written last by SDO
        first.start()
        first.wait_until_done(timeout_s=5)
        assert first.position() == pytest.approx(1.0, abs=0.001)


def test_group_stop_halts_the_group_at_once():
    with opened(4) as (rig, group):
        started(rig, group)
        demands = Demands(rig, [motor.name for motor in group])
        heard = frames_on(rig)
        rig.runtime.run_for(0.01)
        group.stop()
        group.wait_until_done(timeout_s=2)
        assert [can_id for _, _, can_id, _ in heard].count(SYNC) == 1
        begun = {demands.slowing_ns(place) for place in range(4)}
        assert max(begun) - min(begun) == 0


def test_drive_without_halt_option_still_starts():
    with opened(2) as (rig, group):
        for name in ("m1", "m2"):
            rig.world.controller(name).od.get(0x605D, 0).access = "ro"
        started(rig, group)
        group.fault_reaction = FaultReaction.EACH
        group.stop()
        group.wait_until_done(timeout_s=2)
        group.set_trajectory(TrapezoidalTrajectory(0.5), TrapezoidalTrajectory(-0.1))
        group.start()
        group.wait_until_done(timeout_s=2)
        assert group[0].hardware.read("halt_option_code") == 1
