"""A small part of `make fuzz`, and its handling of failures."""

import pytest

from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.emulators.cia402.power_drive import PowerDrive
from tests.properties.fuzz import __main__ as fuzz
from tests.properties.fuzz.frames import line_of, steps_in
from tests.properties.fuzz.target import EPISODE, Reached, endure, episode

SEED = 7


def test_drive_survives_frames_that_reach_many_states():
    reached = Reached()
    for number in range(3):
        endure(episode(SEED, number, EPISODE), reached)
    assert reached.frames == 3 * EPISODE
    assert all(reached.transitions[number] for number in (0, 1, 2, 3, 4, 9, 13, 14, 15))
    assert len(reached.states) >= 7
    assert len(reached.nmt) == 4
    assert len(reached.aborts) >= 8


def test_same_seed_gives_the_same_steps_which_read_back():
    steps = list(episode(SEED, 0, 500))
    assert steps == list(episode(SEED, 0, 500))
    assert steps_in([line_of(step) for step in steps]) == steps
    assert steps != list(episode(SEED, 1, 500))


def _raises(patch):
    good = Cia402Drive.receive

    def receive(drive, data, now_ns):
        if data[:4] == b"\x05\x03\0\0" and data[4] == 4:
            raise IndexError("a drive that cannot count")
        good(drive, data, now_ns)

    patch.setattr(Cia402Drive, "receive", receive)


def _goes_silent(patch):
    good = Cia402Drive.receive
    patch.setattr(
        Cia402Drive,
        "receive",
        lambda drive, data, now_ns: None if data[8] == 0x81 else good(drive, data, now_ns),
    )


def _enables_by_a_reset_word(patch):
    good = PowerDrive._write_controlword

    def write(drive, word, now_ns):
        good(drive, word, now_ns)
        if word == 0x80:
            good(drive, 0x06, now_ns)

    patch.setattr(PowerDrive, "_write_controlword", write)


@pytest.mark.pure("compiled cores cannot be broken on purpose")
@pytest.mark.parametrize(
    ("plant", "told"),
    [
        (_raises, "IndexError: a drive that cannot count"),
        (_goes_silent, "0 boot-ups after reset node"),
        (_enables_by_a_reset_word, "forbidden"),
    ],
)
def test_planted_fault_is_found_and_reduced_to_few_steps(
    plant, told, monkeypatch, tmp_path, capsys
):
    plant(monkeypatch)
    monkeypatch.setattr(fuzz, "OUT", tmp_path)
    monkeypatch.setattr(fuzz, "EPISODE", 300)
    assert fuzz.fuzz(SEED, 3_000) == 1
    out = capsys.readouterr().out
    assert told in out
    (kept,) = tmp_path.iterdir()
    assert f"--again {kept}" in out
    assert len(kept.read_text().splitlines()) <= 8
    assert fuzz.again(kept) == 1
    monkeypatch.undo()
    assert fuzz.again(kept) == 0
