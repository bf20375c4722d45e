"""Exclusive turns from arming to SYNC, among several hosts on a bus."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import execution
from motorhil.motorapi.adaptations.canopen.sync import BusSync
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from tests.support.motors.drive_rigs import HEAD, drive
from tests.support.motors.hosts import BusEvidence, host_with
from tests.support.motors.streaming import quintic, set_function
from tests.support.repetition import examples

WHOLE = [{0x301, 0x302}, {0x303, 0x304}]
DELAYS = st.lists(st.integers(0, 12_000), min_size=3, max_size=3)
ROUNDS = 2


def go(rig: Rig, motors: list[Cia402Motor], delay_us: int) -> None:
    group = MotorGroup(*motors)
    rig.runtime.run_for(delay_us / 1e6)
    for turn in range(ROUNDS):
        group.for_each(Motor.set_control_mode, ControlMode.SETPOINT)
        group.for_each(Motor.set_setpoint, 0.02 * (1 - turn))
        group.start()
        group.wait_until_done(5)


def stream(rig: Rig, motor: Cia402Motor, delay_us: int) -> None:
    rig.runtime.run_for(delay_us / 1e6)
    for _ in range(ROUNDS):
        set_function(motor, quintic(0.004, 0.05)).start()
        motor.wait_until_done(5)


def fired(delays: list[int]) -> list[set[int]]:
    """Return the set-points started by each SYNC, of two groups and a stream of three hosts."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(HEAD + "".join(drive(f"wheel{one}", one) for one in range(1, 6)))
        with (
            Rig.open(path) as rig,
            host_with(rig, 1, 2) as left,
            host_with(rig, 3, 4) as right,
            host_with(rig, 5) as (fifth,),
        ):
            for motor in (*left, *right, fifth):
                motor.enable()
                motor.position()
            seen = BusEvidence(rig)
            works: list[tuple[str, Callable[[], None]]] = [
                ("left", lambda: go(rig, left, delays[0])),
                ("right", lambda: go(rig, right, delays[1])),
                ("stream", lambda: stream(rig, fifth, delays[2])),
            ]
            parties = [rig.runtime.spawn(name, work) for name, work in works]
            for party in parties:
                assert party.join(20.0)
                assert party.error is None, party.error
            return [one - {0x305} for one in seen.fired() if one - {0x305}]


def are_whole(started: list[set[int]]) -> bool:
    return all(one in (*WHOLE, WHOLE[0] | WHOLE[1]) for one in started)


@settings(max_examples=examples(6))
@given(DELAYS)
def test_sync_of_any_sender_starts_whole_groups(delays: list[int]):
    started = fired(delays)
    assert are_whole(started), started
    assert sum(len(one) for one in started) == 2 * 2 * ROUNDS  # each group, each round, once
    event(f"{len(started)} SYNCs that started something")


@pytest.mark.parametrize("what", ["arming", "cyclic"])
def test_without_turns_partial_groups_are_started(what: str, monkeypatch: pytest.MonkeyPatch):
    if what == "arming":
        monkeypatch.setattr(execution, "_trigger_turns", lambda motors: [])
    monkeypatch.setattr(BusSync, "in_turn", lambda sync, who: nullcontext())
    assert not all(is_sound([delay, 0, 3000]) for delay in range(0, 6000, 500))


def is_sound(delays: list[int]) -> bool:
    try:
        return are_whole(fired(delays))
    except AssertionError:  # a party failed because of others' frames
        return False
