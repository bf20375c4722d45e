"""The determinism contract, rule by rule, on rigs of emulated drives."""

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, MotorGroup, TrapezoidalTrajectory
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.parallel_runs import outputs, start

PLANT = '{ preset = "wheel_60w" }'
BUSES, NODES = ("can0", "can1"), (1, 2)
MODEL = """\
velocity_max_rad_s = 6.0
acceleration_max_rad_s2 = 20.0
increments_per_rad = 21008.452488130184
velocity_unit_rad_s = 4.7599888690754445e-05
acceleration_unit_rad_s2 = 4.7599888690754445e-05
"""
UNSTEADY = '[[fault]]\nbus = "{bus}"\nkind = "duplicate"\nprobability = 0.1\n'


def rig_text(faulty=()):
    """Return a rig of four drives on two buses; `faulty` buses duplicate frames at random."""
    lines = ['rig = { name = "four", seed = 11 }']
    lines += [f"bus.{bus}.bitrate_bit_s = 1_000_000" for bus in BUSES]
    for bus in BUSES:
        for node in NODES:
            name = f"{bus}_{node}"
            lines += [f"[controller.{name}]", 'kind = "cia402"', f'bus = "{bus}"']
            lines += [f"node_id = {node}", f"plant = {PLANT}"]
            lines += [f"[motor.{name}]", 'adaptation = "cia402"', f'controller = "{name}"']
            lines += ['model = "wheel.toml"']
    return "\n".join(lines) + "\n" + "".join(UNSTEADY.format(bus=bus) for bus in faulty)


@pytest.fixture
def run(tmp_path):
    """Return a function that runs an application in a rig and returns the record's path."""
    (tmp_path / "wheel.toml").write_text(MODEL)
    count = 0

    def run(application, *, faulty=(), seed=None):
        nonlocal count
        count += 1
        (tmp_path / "rig.toml").write_text(rig_text(faulty))
        record = tmp_path / f"record {count}.mcap"
        with Rig.open(tmp_path / "rig.toml", seed=seed, record=record) as rig:
            application(rig)
        return record

    return run


def turn_together(rig):
    """Move all four drives, two by two, each pair started by a SYNC."""
    for bus in BUSES:
        group = MotorGroup(*(rig.motors[f"{bus}_{node}"] for node in NODES))
        for motor in group:
            motor.set_control_mode(ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(0.4), TrapezoidalTrajectory(-0.2))
        group.start()
        group.wait_until_done(timeout_s=5.0)


def frames(record, bus):
    with read_trace(record) as trace:
        return [(t, p) for channel, t, p in trace.messages() if channel.topic == f"/can/{bus}"]


def test_one_seed_gives_one_digest_and_another_seed_another(run):
    first = digest(run(turn_together, faulty=["can0"]))
    assert digest(run(turn_together, faulty=["can0"])) == first
    assert digest(run(turn_together, faulty=["can0"], seed=11)) == first
    assert digest(run(turn_together, faulty=["can0"], seed=12)) != first


def test_digest_without_randomness_ignores_the_seed(run):
    """Show that the other digest of the test above came only from randomness."""
    assert digest(run(turn_together, seed=11)) == digest(run(turn_together, seed=12))


def test_a_components_chance_does_not_hang_on_what_others_draw(run):
    alone = run(turn_together, faulty=["can0"])
    beside = run(turn_together, faulty=["can0", "can1"])
    quiet = run(turn_together)
    assert frames(beside, "can1") != frames(alone, "can1")
    # The two buses share one application, so can1 affects can0 only after can0's motion.
    until_ns = next(time_ns for time_ns, frame in frames(alone, "can1") if b"host" in frame)
    early = [[f for f in frames(r, "can0") if f[0] < until_ns] for r in (alone, beside, quiet)]
    assert early[0] == early[1]
    assert early[0] != early[2]


def test_times_are_whole_nanoseconds_from_0_in_order_and_what_is_told_is_immutable(run):
    heard = []

    def application(rig):
        rig.world.tap_frames(lambda bus, time_ns, sender, frame: heard.append((time_ns, frame)))
        turn_together(rig)

    run(application)
    assert len(heard) > 500
    assert {type(time_ns) for time_ns, _ in heard} == {int}
    assert {(type(frame), len(frame)) for _, frame in heard} == {(bytes, 16)}
    times_ns = [time_ns for time_ns, _ in heard]
    assert times_ns == sorted(times_ns)
    assert 0 < times_ns[0] < 1_000_000_000


def test_reading_state_changes_nothing(run):
    def looked_at(rig):
        def look():
            for name in reversed(list(rig.controllers)):
                rig.controllers[name].snapshot()
            for bus in rig.world.bus_names():
                rig.world.bus(bus).statistics.load(0, rig.runtime.now_ns() + 1)

        rig.runtime.every(0.000_37, look)
        turn_together(rig)

    seen, unseen = run(looked_at), run(turn_together)
    for bus in BUSES:
        assert frames(seen, bus) == frames(unseen, bus)


def test_fault_injected_during_the_run_is_repeatable(run):
    def disturbed(rig):
        rule = FaultRule("late", FaultKind.DUPLICATE, sender="can0_1", probability=0.2)
        rig.runtime.spawn(
            "trouble", lambda: (rig.runtime.run_for(1.0), rig.faults.inject("can0", rule))
        )
        turn_together(rig)
        assert rig.faults.fired()["late"] > 3

    assert digest(run(disturbed)) == digest(run(disturbed))


PARTIES = """\
import can
from motorhil.motorapi import runtime_of

with can.Bus() as bus:
    runtime = runtime_of(bus)
    said = []

    def speak(name, period_s):
        for _ in range(40):
            runtime.wait_until(lambda: False, period_s)
            said.append(name)
            runtime.send(bus, b"\\x23\\x01\\0\\0\\2\\0\\0\\0" + name.encode() + bytes(6))

    names = ["p0", "p1", "p2", "p3", "p4", "p5"]
    parties = [runtime.spawn(n, lambda n=n, i=i: speak(n, 0.002 + 0.001 * (i % 3)))
               for i, n in enumerate(names)]
    for party in parties:
        party.join()
    print(" ".join(said))
"""


def test_parties_take_the_same_turns_whatever_the_hash_seed(tmp_path):
    (tmp_path / "wheel.toml").write_text(MODEL)
    (tmp_path / "rig.toml").write_text(rig_text())
    words = ("run", str(tmp_path / "rig.toml"), "-", "-o", "record.mcap")
    folders = [tmp_path / f"run{hash_seed}" for hash_seed in (0, 1, 2)]
    said = outputs(
        [start(folder, seed, *words, text=PARTIES) for seed, folder in enumerate(folders)]
    )
    assert len(said[0].split()) == 240
    assert said[0].split()[:6] == ["p0", "p3", "p1", "p4", "p2", "p5"]
    assert said == [said[0]] * 3
    assert len({digest(folder / "record.mcap") for folder in folders}) == 1
