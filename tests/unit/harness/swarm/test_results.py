"""Result files: append, resume, merge, and what lanes learned from them."""

import errno
import io
import random
from dataclasses import replace

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.lanes import LANES, Lane
from motorhil.harness.swarm.plan import FUNCTION, Plan, Program
from motorhil.harness.swarm.results import create, open_results
from motorhil.harness.swarm.row import CANARY, Result, Row
from motorhil.harness.swarm.worlds.disturbance import Disturbance

PLAN = Plan("rig.toml", Program(FUNCTION, "app:main"))


def row(seed):
    world = (Disturbance("clock", "left", (("ppm", float(seed)),)),)
    return Row(seed, Result.PASSED, digest=f"{seed:x}", new=(f"pair {seed % 7}",), world=world)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "out"


def test_rows_that_are_there_are_not_written_again(folder):
    results = create(folder, PLAN)
    results.append([row(1), row(2), row(1)])
    results.append([row(2), row(3)])
    _, again = open_results(folder)
    assert (folder / "rows.jsonl").read_text().count("\n") == 3
    assert sorted(again.rows) == [1, 2, 3]
    assert again.missing(range(5)) == [0, 4]


def test_files_of_two_machines_are_one_set(folder):
    results = create(folder, PLAN)
    results.append([row(1), row(3), row(5)], part=(1, 2))
    (folder / "rows-2-of-2.jsonl").write_text(f"{row(2).as_line()}\n{row(3).as_line()}\n")
    _, again = open_results(folder)
    assert sorted(again.rows) == [1, 2, 3, 5]


def test_two_results_of_one_seed_are_refused(folder):
    results = create(folder, PLAN)
    results.append([row(1)])
    other = Row(1, Result.FAILED)
    (folder / "rows-2-of-2.jsonl").write_text(other.as_line() + "\n")
    with pytest.raises(RigError, match="seed 1 has two results"):
        open_results(folder)


def test_line_that_was_cut_is_absent_and_its_rest_removed(folder):
    results = create(folder, PLAN)
    results.append([row(1), row(2)])
    path = folder / "rows.jsonl"
    path.write_bytes(path.read_bytes()[:-5])
    _, again = open_results(folder)
    assert sorted(again.rows) == [1]
    again.append([row(2)])
    assert sorted(open_results(folder)[1].rows) == [1, 2]


def test_full_disk_leaves_whole_rows(folder, monkeypatch):
    results = create(folder, PLAN)
    results.append([row(1)])

    class Full(io.FileIO):
        def write(self, data):
            if len(data) < 100:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data[: len(data) // 2])

    path = folder / "rows.jsonl"
    before = path.read_bytes()
    monkeypatch.setattr(type(path), "open", lambda self, mode, buffering: Full(self, "a"))
    with pytest.raises(RigError, match=r"cannot be written: No space left.*--resume"):
        results.append([row(2), row(3)])
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert results.missing([1, 2, 3]) == [2, 3]
    results.append([row(2), row(3)])
    assert sorted(open_results(folder)[1].rows) == [1, 2, 3]


def test_lane_is_what_all_its_rows_below_teach_in_any_order(folder):
    seeds = [CANARY, *range(200)]
    random.Random(1).shuffle(seeds)
    results = create(folder, PLAN)
    for number, seed in enumerate(seeds):
        results.append([row(seed)])
        lane_number, before = number % LANES, (number * 37) % 210
        lane = results.lane(lane_number, before)
        expected = Lane()
        for one in sorted(results.rows):
            if one != CANARY and one % LANES == lane_number and one < before:
                expected.learn(results.rows[one])
        assert list(lane.seen) == list(expected.seen)
        assert lane.corpus == expected.corpus


def test_lane_looks_at_each_row_once(folder, monkeypatch):
    results = create(folder, PLAN)
    learned = []
    learn = Lane.learn
    monkeypatch.setattr(
        Lane, "learn", lambda self, one: (learned.append(one.seed), learn(self, one))
    )
    for seed in range(0, 50 * LANES, LANES):
        results.lane(0, seed)
        results.append([row(seed)])
    assert learned == sorted(set(learned))


def test_rows_of_worlds_that_shared_a_process_do_not_count_later(folder):
    results = create(folder, PLAN)
    results.append([row(1), row(2)])
    shown = replace(row(3), digest="other")
    results.begin_alone(shown, (1, 1))
    assert open_results(folder)[1].rows == results.rows == {}
    results.append([row(3), row(1)], (2, 2))
    _, again = open_results(folder)
    assert (again.is_alone, again.shown_by) == (True, 3)
    assert again.missing([1, 2, 3]) == [2]
