"""The table of figures that `make bench` compares with."""

import pytest

from tests.benchmarks import kept
from tests.benchmarks.__main__ import FELT, modules

RUNS = {"system: demo": ("x real time", [50.0, 52.0, 51.0]), "locks: a lock": ("us", [12.0, 12.5])}


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "kept.tsv"
    kept.write({name: kept.kept_of(*one) for name, one in RUNS.items()}, "of source 1", path)
    return kept.read(path)


def test_kept_table_is_read_as_written(table):
    assert list(table) == list(RUNS)
    assert table["system: demo"] == kept.Kept("x real time", 51.0, 50.0, 52.0)


@pytest.mark.parametrize(
    ("name", "figure", "words"),
    [
        ("system: demo", 49.0, ""),
        ("system: demo", 40.0, "moved -22% worse"),
        ("system: demo", 60.0, "moved +18% better"),
        ("locks: a lock", 20.0, "moved +60% worse"),
        ("locks: a lock", 9.0, "moved -28% better"),
    ],
)
def test_move_is_told_beyond_the_noise(table, name, figure, words):
    assert kept.told(table[name], figure, table[name].unit) == words


def test_figure_without_a_kept_one_is_new(table):
    assert kept.told(table.get("system: rest"), 1.0, "s") == "new"
    assert kept.told(table["system: demo"], 1.0, "s") == "new"


def test_machine_of_half_the_speed_has_the_same_scaled_figures():
    assert kept.scaled(8.0, "us", 20.0) == kept.scaled(4.0, "us", 10.0) == 4.0
    assert kept.scaled(25.0, "x real time", 20.0) == 50.0
    assert kept.scaled(1.6, "x", 20.0) == 1.6


def test_part_has_the_name_of_its_whole():
    figures = [("rate", 1.0, "1/s"), ("  ratio", 2.0, "x"), ("other", 3.0, "s")]
    assert [name for name, _, _ in kept.named(figures)] == ["rate", "rate: ratio", "other"]


def test_benchmarks_are_chosen_by_part_of_a_name():
    assert modules([], every=False) == sorted(FELT)
    assert modules(["locks"], every=False) == ["bench_locks"]
    assert set(modules([], every=True)) > set(FELT)


def test_figures_have_names_of_their_own():
    figures = [("a lock", 1.0, "us"), ("  with flock", 2.0, "us"), ("turns", 3.0, "1/s")]
    assert [name for name, *_ in kept.named(figures)] == ["a lock", "a lock: with flock", "turns"]
    assert len(list(kept.named([*figures, ("  with flock", 4.0, "1/s")]))) == 4
    with pytest.raises(ValueError, match=r"'a lock: with flock': told twice"):
        list(kept.named([*figures[:2], ("  with flock", 4.0, "us")]))
