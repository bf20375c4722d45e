"""A fault in one motor of three; the reaction is measured on the plants' true states.

No caller waits for any motor meanwhile: time only passes.
"""

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import (
    ControlMode,
    DeviceFault,
    FaultReaction,
    LinkError,
    MotionInterrupted,
    Motor,
    Synchronization,
    TrapezoidalTrajectory,
)
from tests.support.motors import software_rigs
from tests.support.motors.kinds import MODEL
from tests.support.repetition import examples

MS = 1_000_000
NAMES = ("m1", "m2", "m3")
WAYS = (1.0, -2.0, 0.5)  # proportional: at 2 rad/s of the second motor the others have 1 and 0.5
FAULT_S = 0.6  # since the start: all are at their plateaus, which begin at 0.5 s
VELOCITY, ACCELERATION = 2.0, 4.0
DRIVE = """\
[controller.{name}]
kind = "cia402"
bus = "can{bus}"
node_id = {number}
plant = {{ preset = "wheel_60w" }}
[motor.{name}]
adaptation = "cia402"
controller = "{name}"
servo_period_ms = 1.0
[motor.{name}.model]
"""
GROUP = '[group.all]\nmotors = ["m1", "m2", "m3"]\n'
IDEAL = '[motor.{name}]\nadaptation = "ideal"\naxis = "{name}"\n[motor.{name}.model]\n'


def drives(*buses):
    text = "".join(f"[bus.can{bus}]\nbitrate_bit_s = 1_000_000\n" for bus in sorted(set(buses)))
    for number, (name, bus) in enumerate(zip(NAMES, buses, strict=True), 1):
        text += DRIVE.format(name=name, bus=bus, number=number) + MODEL
    return text + GROUP


def servos():
    """Return a rig whose first motor has its own node, as its cable is cut."""
    limits = {"velocity": VELOCITY, "acceleration": ACCELERATION}
    return (
        "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
        + software_rigs.node("m1", 1)
        + software_rigs.node("io", 2, 2)
        + software_rigs.motor("m1", "m1", 1, **limits)
        + software_rigs.motor("m2", "io", 1, **limits)
        + software_rigs.motor("m3", "io", 2, **limits)
        + GROUP
    )


def ideals():
    return "".join(IDEAL.format(name=name) + MODEL for name in NAMES) + GROUP


@dataclass(frozen=True)
class Kind:
    """One kind of hardware.

    rig: its file. line: maximum deviation from the line [rad]. end_s: maximum time between the
    rests of motors stopped at one instant, for drives a profile tick and the lag of a servo.
    """

    name: str
    rig: str
    line: float
    end_s: float
    faults: tuple


KINDS = {
    kind.name: kind
    for kind in (
        Kind("one bus", drives(0, 0, 0), 0.0002, 0.0025, ("stimulus", "load", "cut")),
        Kind("two buses", drives(0, 0, 1), 0.0002, 0.0025, ("stimulus", "load", "cut")),
        Kind("servos", servos(), 0.0001, 0.0035, ("stimulus", "load", "cut")),
        Kind("ideal", ideals(), 1e-12, 0.001, ("stimulus",)),
    )
}
CASES = [(kind, fault) for kind in KINDS.values() for fault in kind.faults]
IDS = [f"{kind.name}-{fault}" for kind, fault in CASES]


def plant(rig, fault):
    """Cause a fault of the first motor."""
    if fault == "cut":
        rig.faults.inject("can0", FaultRule("cut", FaultKind.CUT, ports=("m1",)))
    elif "m1" not in rig.controllers:
        rig.motors["m1"].hardware.inject_fault(0x7500)
    elif fault == "load":
        rig.controllers["m1"].stimulate("load_torque_n_m", -100.0)
    else:
        is_drive = rig.description.controllers["m1"].kind == "cia402"
        rig.controllers["m1"].stimulate("fault", 0x7500 if is_drive else 1)


def true_position(rig, name):
    motor = rig.description.motors[name]
    if motor.controller is None:
        return rig.motors[name].position()
    prefix = "" if motor.settings.get("channel", 1) == 1 else "channel_2_"
    return rig.controllers[motor.controller].snapshot()[f"{prefix}position_rad"]


class Truth:
    """The true positions of the motors, every millisecond from its creation."""

    def __init__(self, rig, ways=WAYS):
        self.rig = rig
        self.ways = ways
        self.begun_ns = rig.runtime.now_ns()
        self.seen = []
        rig.runtime.every(0.001, self.look)
        self.look()

    def look(self):
        since_s = (self.rig.runtime.now_ns() - self.begun_ns) / 1e9
        self.seen.append((since_s, [true_position(self.rig, name) for name in NAMES]))

    def off_the_line(self):
        """Return the maximum deviation of the second and third motor from their line [rad]."""
        _, (_, two, three) = self.seen[0]
        ways = self.ways[1:]
        square = sum(way * way for way in ways)
        worst = 0.0
        for _, (_, second, third) in self.seen:
            made = (second - two, third - three)
            part = sum(m * way for m, way in zip(made, ways, strict=True)) / square
            offs = [abs(m - part * way) for m, way in zip(made, ways, strict=True)]
            worst = max(worst, *offs)
        return worst

    def rest_s(self, place):
        """Return the last time of the motor above 2 % of its plateau, since the start [s]."""
        least = 0.02 * abs(WAYS[place]) * 1e-3
        last_s = 0.0
        for (_, before), (at_s, now) in zip(self.seen, self.seen[1:], strict=False):
            if abs(now[place] - before[place]) > least:
                last_s = at_s
        return last_s

    def slowing_s(self, place):
        """Return its first time below 95 % of its plateau after the fault, since the start [s]."""
        least = 0.95 * abs(WAYS[place]) * 1e-3
        for (_, before), (at_s, now) in zip(self.seen, self.seen[1:], strict=False):
            if at_s > FAULT_S and abs(now[place] - before[place]) < least:
                return at_s
        return None


def under_way(rig, reaction, ways=WAYS):
    """Return the moving group of the rig."""
    group = rig.groups["all"]
    group.for_each(Motor.enable)
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(*map(TrapezoidalTrajectory, ways))
    group.synchronization = Synchronization.PHASE
    group.fault_reaction = reaction
    group.start()
    return group


@contextmanager
def scene(kind, fault, reaction):
    """Cause the fault in the moving group and let time pass, without waiting for a motor."""
    description = parse_rig(Source(Path("reactions.toml"), kind.rig), installed_plugins())
    with Rig(description) as rig:
        group = under_way(rig, reaction)
        truth = Truth(rig)
        rig.runtime.run_for(FAULT_S)
        plant(rig, fault)
        rig.runtime.run_for(2.0)
        yield rig, group, truth


@pytest.mark.parametrize(("kind", "fault"), CASES, ids=IDS)
def test_reaction_together_stops_the_others_on_the_line(kind, fault):
    with scene(kind, fault, FaultReaction.TOGETHER) as (_, _, truth):
        assert truth.off_the_line() <= kind.line
        rests = [truth.rest_s(place) for place in (1, 2)]
        assert abs(rests[0] - rests[1]) <= kind.end_s
        assert abs(truth.seen[-1][1][1] - truth.seen[0][1][1]) < 1.9  # short of its target
        # From 2 rad/s at 4 rad/s^2: half a second after the fault was noticed.
        slowing_s = truth.slowing_s(1)
        assert rests[0] - slowing_s == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("kind", "fault"), CASES, ids=IDS)
def test_reaction_each_stops_each_at_its_own_limit(kind, fault):
    with scene(kind, fault, FaultReaction.EACH) as (_, _, truth):
        # 2 and 0.5 rad/s, both at 4 rad/s^2, which only the second motor uses on the line.
        for place, expected_s in ((1, 0.5), (2, 0.125)):
            assert truth.rest_s(place) - truth.slowing_s(place) == pytest.approx(
                expected_s, abs=0.05
            )


@pytest.mark.parametrize(("kind", "fault"), CASES, ids=IDS)
def test_reaction_none_lets_the_others_reach_their_targets(kind, fault):
    with scene(kind, fault, FaultReaction.NONE) as (_, group, truth):
        assert truth.off_the_line() <= kind.line
        for place in (1, 2):
            made = truth.seen[-1][1][place] - truth.seen[0][1][place]
            assert made == pytest.approx(WAYS[place], abs=0.001)  # the windows of all kinds
        assert [motor.is_done() for motor in list(group)[1:]] == [True, True]
        with pytest.raises((DeviceFault, LinkError)) as caught:
            group.wait_until_done()
        assert caught.value.__notes__[-1] == "from m1; the others of its group continue"


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_waiters_for_a_motor_and_the_group_get_their_causes(kind):
    with scene(kind, "stimulus", FaultReaction.EACH) as (rig, group, _):
        with pytest.raises(MotionInterrupted, match=r"fault reaction of its group \(m1: fault"):
            rig.motors["m3"].wait_until_done()
        for ask in (group.wait_until_done, group.is_done):
            with pytest.raises(DeviceFault, match="m1: fault") as caught:
                ask()
            assert caught.value.__notes__[-1] == "from m1; the others of its group were stopped"
        # After the end, the others start again alone, and the fault of the first motor is its own.
        other = rig.motors["m2"]
        other.set_trajectory(TrapezoidalTrajectory(0.25))
        other.start()
        other.wait_until_done(timeout_s=5)


@settings(max_examples=examples(5))
@given(
    st.floats(0.01, 1.45),
    st.lists(st.floats(0.3, 2.0), min_size=3, max_size=3),
    st.sampled_from([drives(0, 0, 0), drives(0, 1, 0), drives(0, 1, 1)]),
    st.sampled_from(["stimulus", "load"]),
)
def test_fault_at_any_instant_keeps_the_others_on_the_line(fault_s, ways, rig_file, fault):
    """Cause the fault at any instant of any straight line; on one bus or two."""
    description = parse_rig(Source(Path("any.toml"), rig_file), installed_plugins())
    with Rig(description) as rig:
        group = under_way(rig, FaultReaction.TOGETHER, ways)
        truth = Truth(rig, ways)
        rig.runtime.run_for(fault_s)
        plant(rig, fault)
        rig.runtime.run_for(3.0)
        assert truth.off_the_line() <= 0.0002
        made = abs(truth.seen[-1][1][1] - truth.seen[0][1][1]) / ways[1]
        event("stopped short" if made < 0.99 else "at the target")
        if made < 0.99:
            with pytest.raises(DeviceFault):
                group.wait_until_done()
