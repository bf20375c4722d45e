"""Exclusive bus use during low-level access: only the holder's frames.

A property over interleavings: Hypothesis chooses the actions and times of several parties, virtual
time makes one run of them, and the bus record is the judge. Two kinds of the host's frames are
addressed to no drive, so they are exempt: SYNC (080h) and the host's heartbeat (700h + 127).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import MotorBusyError, MotorError
from motorhil.motorapi.functions import Sine
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
from motorhil.motorapi.trajectory import ComplexTrajectory, TrapezoidalTrajectory
from tests.support.motors.drive_rigs import HEAD, drive
from tests.support.repetition import examples

NODE = 1
# CiA 301, predefined connection set: SDO request and the four RPDOs of the node; and NMT, below.
TO_NODE = (0x600 + NODE, 0x200 + NODE, 0x300 + NODE, 0x400 + NODE, 0x500 + NODE)

# --- the holder's actions: each is the frames that it puts on the bus --------------------------

Frame = tuple[int, bytes]


def read_statusword(motor: Cia402Motor, frames: list[Frame]) -> None:
    frames.append((0x601, bytes.fromhex("4041600000000000")))
    motor.hardware.read(0x6041)


def write_speed(motor: Cia402Motor, frames: list[Frame]) -> None:
    frames.append((0x601, bytes.fromhex("2381600034120000")))
    motor.hardware.write(0x6081, 0x1234)


def raw_shutdown(motor: Cia402Motor, frames: list[Frame]) -> None:
    frames.append((0x201, bytes.fromhex("0600")))
    sent = motor.hardware.send_frame(0x201, bytes.fromhex("0600"))
    motor.runtime.wait_until(lambda: sent.time_ns is not None, 0.1)


def use_the_interface(motor: Cia402Motor, frames: list[Frame]) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.05))
    for call in (motor.start, motor.stop, motor.enable, motor.position, motor.is_referenced):
        with suppress(MotorBusyError):
            call()


def let_time_pass(motor: Cia402Motor, frames: list[Frame]) -> None:
    motor.runtime.wait_until(lambda: False, 0.013)


HOLDS = (read_statusword, write_speed, raw_shutdown, use_the_interface, let_time_pass)


# --- the others' actions -----------------------------------------------------------------------


def move(motor: Cia402Motor) -> None:
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(TrapezoidalTrajectory(0.05))
    motor.start()


def stream(motor: Cia402Motor) -> None:
    """Stream set-points in csp, one per SYNC; the next party may stop them."""
    motor.set_control_mode(ControlMode.TRAJECTORY)
    motor.set_trajectory(ComplexTrajectory(Sine(0.02, 2.0).restricted(0.0, 0.3), relative=True))
    motor.start()


OTHERS: dict[str, Callable[[Cia402Motor], object]] = {
    "move": move,
    "stream": stream,
    "move and wait": lambda motor: (move(motor), motor.wait_until_done(timeout_s=1.0)),
    "wait": lambda motor: motor.wait_until_done(timeout_s=0.5),
    "stop": Cia402Motor.stop,
    "halt": Cia402Motor.halt,
    "quick stop": Cia402Motor.quick_stop,
    "enable": Cia402Motor.enable,
    "disable": Cia402Motor.disable,
    "home": lambda motor: motor.home(37, timeout_s=1.0),
    "reset": Cia402Motor.reset_fault,
    "position": Cia402Motor.position,
    "velocity": Cia402Motor.velocity,
    "torque": Cia402Motor.torque,
    "state": Cia402Motor.state,
    "fault": Cia402Motor.fault,
    "referenced": Cia402Motor.is_referenced,
    "capability": lambda motor: MotorGroup(motor).sync_capability(),
    "hardware reads": lambda motor: motor.hardware.read(0x6064),
    "hardware connects": lambda motor: motor.hardware.connect(),
    "hardware halts": lambda motor: motor.hardware.halt(),
    "hardware refreshes": lambda motor: motor.hardware.refresh(),
    "hardware sends": lambda motor: motor.hardware.send_frame(0x201, b"\x0f\0"),
}
IN_CALLBACKS = ("stop", "halt", "quick stop")


@dataclass(frozen=True)
class Scenario:
    polled: bool
    holders: list[list[tuple[float, list[int]]]]  # of each: (pause, acts of HOLDS), ...
    others: list[list[tuple[float, str]]]  # of each: (pause, one of OTHERS), ...
    callbacks: list[tuple[float, str]]  # (period, one of IN_CALLBACKS)


@dataclass
class Evidence:
    windows: list[tuple[int, int, list[Frame]]] = field(default_factory=list)
    sent: list[tuple[int, Frame]] = field(default_factory=list)
    refused: int = 0

    def intrusions(self) -> list[str]:
        """Return each window in which others than the holder sent frames to the drive."""
        found: list[str] = []
        for entered_ns, left_ns, expected in self.windows:
            seen = [frame for time_ns, frame in self.sent if entered_ns < time_ns <= left_ns]
            if seen != expected:
                found.append(f"{entered_ns} to {left_ns}: {seen} instead of {expected}")
        return found


@contextmanager
def rig_of(scenario: Scenario) -> Iterator[Rig]:
    text = drive("left", NODE, motor="status_period_ms = 0" if scenario.polled else "")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(HEAD + text)
        with Rig.open(path) as rig:
            yield rig


def run(scenario: Scenario) -> Evidence:
    evidence = Evidence()
    with rig_of(scenario) as rig:
        first = rig.motors["left"]
        assert isinstance(first, Cia402Motor)

        def on_frame(bus: str, time_ns: int, sender: str, frame: bytes) -> None:
            can_id = int.from_bytes(frame[:4], "little")
            data = frame[8 : 8 + frame[4]]
            nmt = can_id == 0 and data[1] in (0, NODE)
            if sender == "host" and (nmt or can_id in TO_NODE):
                evidence.sent.append((time_ns, (can_id, data)))

        def logical(name: str) -> Cia402Motor:
            return Cia402Motor(first.hardware, first.model, name=name)

        def holder(motor: Cia402Motor, turns: list[tuple[float, list[int]]]) -> None:
            for pause_s, acts in turns:
                rig.runtime.run_for(pause_s)
                with suppress(MotorError), motor.low_level(timeout_s=2.0):
                    entered_ns = rig.runtime.now_ns()
                    frames: list[Frame] = []
                    try:
                        for act in acts:
                            HOLDS[act](motor, frames)
                    finally:
                        evidence.windows.append((entered_ns, rig.runtime.now_ns(), frames))

        def attempt(motor: Cia402Motor, what: str) -> None:
            try:
                OTHERS[what](motor)
            except MotorBusyError as busy:
                evidence.refused += busy.purpose == "low-level access"
            except MotorError:
                pass  # every action of the holder ends with an error of the tree, if any

        def other(motor: Cia402Motor, acts: list[tuple[float, str]]) -> None:
            for pause_s, what in acts:
                rig.runtime.run_for(pause_s)
                attempt(motor, what)

        rig.world.tap_frames(on_frame)
        first.hardware.connect()
        parties = []
        for place, turns in enumerate(scenario.holders):
            motor = logical(f"holder {place}")
            parties.append(rig.runtime.spawn(motor.name, lambda m=motor, t=turns: holder(m, t)))
        for place, acts in enumerate(scenario.others):
            motor = logical(f"other {place}")
            parties.append(rig.runtime.spawn(motor.name, lambda m=motor, a=acts: other(m, a)))
        timers = [
            rig.runtime.every(period_s, lambda what=what: attempt(first, what))
            for period_s, what in scenario.callbacks
        ]
        for party in parties:
            assert party.join(60.0)
            assert party.error is None, party.error
        for timer in timers:
            timer.cancel()
    return evidence


PAUSES = st.sampled_from([0.0, 0.0003, 0.004, 0.03, 0.2, 0.4])
SCENARIOS = st.builds(
    Scenario,
    st.booleans(),
    st.lists(
        st.lists(
            st.tuples(PAUSES, st.lists(st.integers(0, len(HOLDS) - 1), max_size=6)),
            min_size=1,
            max_size=3,
        ),
        min_size=1,
        max_size=2,
    ),
    st.lists(
        st.lists(st.tuples(PAUSES, st.sampled_from(sorted(OTHERS))), min_size=1, max_size=8),
        min_size=1,
        max_size=3,
    ),
    st.lists(
        st.tuples(st.sampled_from([0.0007, 0.01, 0.1]), st.sampled_from(IN_CALLBACKS)), max_size=1
    ),
)


@settings(max_examples=examples(12))
@given(SCENARIOS)
def test_the_bus_carries_to_the_drive_what_the_holder_sent_and_nothing_else(scenario: Scenario):
    evidence = run(scenario)
    event(f"windows: {min(len(evidence.windows), 3)}")
    event(f"refused: {'some' if evidence.refused else 'none'}")
    event(f"frames of the holder: {'some' if any(w[2] for w in evidence.windows) else 'none'}")
    assert evidence.intrusions() == []


BUSY = Scenario(
    polled=True,
    holders=[[(0.4, [4, 0, 1, 4, 2, 3, 4])] * 3],
    others=[
        [(0.004, "position")] * 150,
        [(0.03, "move and wait"), (0.03, "stop")] * 8,
        [(0.0003, "hardware reads"), (0.004, "hardware sends")] * 100,
    ],
    callbacks=[(0.05, "stop")],
)


def test_scenario_has_a_holder_and_others_that_try():
    """A busy scenario, counted, shows that the property above is not empty."""
    evidence = run(BUSY)
    assert evidence.intrusions() == []
    assert len(evidence.windows) == 3
    assert [len(frames) for _, _, frames in evidence.windows] == [3, 3, 3]
    assert evidence.refused >= 20
    outside = len(evidence.sent) - 9
    assert outside > 100  # and they are heard outside of access


@pytest.mark.parametrize("gate", ["passage", "require_not_held_elsewhere", "is_over"])
def test_each_removed_gate_is_detected_on_the_bus(gate: str, monkeypatch: pytest.MonkeyPatch):
    """The property must be able to fail."""

    @contextmanager
    def open_passage(self: PhysicalMotor, motor: str, *, of_holder: bool = False) -> Iterator[None]:
        yield

    monkeypatch.setattr(PhysicalMotor, "require_free", lambda self: None)
    if gate == "passage":
        monkeypatch.setattr(PhysicalMotor, "passage", open_passage)
        monkeypatch.setattr(PhysicalMotor, "interrupt", open_passage)
    elif gate == "require_not_held_elsewhere":
        monkeypatch.setattr(PhysicalMotor, gate, lambda self: None)
    else:
        monkeypatch.setattr(LogicalMotor, "_is_at_rest", lambda motor, patient: True)
        monkeypatch.setattr(PhysicalMotor, "passage", open_passage)
    assert run(BUSY).intrusions() != []
