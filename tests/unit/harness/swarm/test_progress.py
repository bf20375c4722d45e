"""Times of a campaign: files beside the rows."""

import json

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.report.progress import Progress, Times, progress_in
from tests.support.swarm.campaigns import failure


def rows(*seeds):
    return [failure(seed) for seed in seeds]


def test_folder_without_times_has_no_progress(tmp_path):
    assert progress_in(tmp_path) == Progress()
    assert Progress().seen(rows(1)) is None
    assert Progress().mean is None


def test_rows_come_at_their_times(tmp_path):
    times = Times(tmp_path, (1, 1), 0, 10, 100.0)
    times.take(rows(0, 1), 102.0)
    times.take(rows(2), 104.0)
    found = progress_in(tmp_path)
    assert (found.asked, found.begun_s, found.last_s, found.took_s) == (10, 100.0, 104.0, 4.0)
    assert found.mean == 3 / 4.0
    assert (found.seen(rows(2, 1)), found.seen(rows(2)), found.seen(rows(9))) == (2.0, 4.0, None)
    assert not found.is_over


def test_end_ends_the_campaign_until_it_is_resumed(tmp_path):
    times = Times(tmp_path, (1, 1), 0, 10, 100.0)
    times.take(rows(0), 101.0)
    times.end(109.0)
    found = progress_in(tmp_path)
    assert (found.is_over, found.took_s) == (True, 1.0)
    Times(tmp_path, (1, 1), 0, 10, 5000.0).take(rows(1), 5002.0)
    found = progress_in(tmp_path)
    assert (found.is_over, found.took_s, found.seen(rows(1))) == (False, 3.0, 3.0)


def test_parts_of_several_machines_merge(tmp_path):
    one, other = Times(tmp_path, (1, 2), 0, 10, 100.0), Times(tmp_path, (2, 2), 5, 10, 101.0)
    one.take(rows(0, 1), 104.0)
    other.take(rows(2), 102.0)
    other.end(103.0)
    found = progress_in(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "times-1-of-2.jsonl",
        "times-2-of-2.jsonl",
    ]
    # part 1 of seeds 0 to 9: 0, 2, 4, 6, 8; part 2 of seeds 5 to 14: 5, 7, 9, 11, 13
    assert (found.asked, found.begun_s, found.is_over) == (10, 100.0, False)
    assert found.seen(rows(2)) < found.seen(rows(0))
    one.end(106.0)
    assert progress_in(tmp_path).is_over


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ([((1, 1), 0, 10), ((1, 1), 0, 10)], 10),
        ([((1, 1), 0, 10), ((1, 1), 5, 10)], 15),
        ([((1, 1), 20, 10), ((1, 1), 0, 10)], 20),
        ([((1, 3), 0, 48), ((2, 3), 0, 48), ((3, 3), 0, 48)], 48),
        ([((16, 16), 0, 15)], 0),
        ([((16, 16), 0, 16)], 1),
    ],
)
def test_asked_counts_each_seed_once(tmp_path, asked, expected):
    for part, first, seeds in asked:
        Times(tmp_path, part, first, seeds, 100.0)
    assert progress_in(tmp_path).asked == expected


def test_damaged_lines_are_left_out(tmp_path):
    Times(tmp_path, (1, 1), 0, 10, 100.0).take(rows(0), 101.0)
    path = tmp_path / "times.jsonl"
    path.write_bytes(b'[1]\n{"at": "x"}\n\xff\n' + path.read_bytes() + b'{"at":102,"se')
    found = progress_in(tmp_path)
    assert (found.asked, found.took_s) == (10, 1.0)


def test_rate_is_drawn_over_equal_steps_of_time(tmp_path):
    times = Times(tmp_path, (1, 1), 0, 100, 0.0)
    for number in range(1, 9):
        times.take(rows(*range(10 * number, 10 * number + (3 if number > 4 else 1))), float(number))
    rate = progress_in(tmp_path).rate
    assert [time_s for time_s, _ in rate] == [0.0, 2.0, 6.0, 8.0]
    assert [count for _, count in rate] == pytest.approx([0.75, 0.75, 3.25, 3.25])  # 4 s each


def test_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(RigError, match=r"gone/times.jsonl: cannot be written: No such file"):
        Times(tmp_path / "gone", (1, 1), 0, 10, 100.0)


def test_lines_have_seeds_and_times_only(tmp_path):
    times = Times(tmp_path, (1, 1), 5, 10, 100.0)
    times.take(rows(5), 101.0)
    times.end(102.0)
    lines = (tmp_path / "times.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [
        {"at": 100.0, "first": 5, "asked": 10, "part": [1, 1]},
        {"at": 101.0, "seeds": [5]},
        {"at": 102.0, "ended": True},
    ]
