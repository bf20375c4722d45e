"""Rule D7 for the demo: one seed, one source, one digest."""

import pytest

from motorhil.harness.version import cores_are_compiled
from motorhil.traces.digest import digest
from tests.support.parallel_runs import FROM_SOURCES, outputs, start


def without_wall_time(text):
    """Return the demo's output without its duration and the record's path."""
    lines = [line for line in text.splitlines() if "simulated seconds per second" not in line]
    return [line.partition(", ")[2] if line.startswith("record ") else line for line in lines]


def test_two_processes_with_different_hash_seeds_make_one_demo(tmp_path):
    first, second = tmp_path / "first", tmp_path / "a" / "quite different" / "place"
    said = outputs(
        [start(first, 0, "demo"), start(second, 4242, "demo", "-o", "elsewhere/record.mcap")]
    )
    assert without_wall_time(said[0]) == without_wall_time(said[1])
    digests = [digest(first / "out/demo.mcap"), digest(second / "elsewhere/record.mcap")]
    assert digests[0] == digests[1]
    assert f"digest {digests[0]} (seed 7)" in said[0]


@pytest.mark.compiled
def test_compiled_cores_and_their_sources_make_one_demo(tmp_path):
    if not cores_are_compiled():
        pytest.skip("the cores here are pure Python: make test compares the two")
    compiled, pure = outputs(
        [
            start(tmp_path / "compiled", 0, "demo"),
            start(tmp_path / "pure", 0, "demo", program=FROM_SOURCES),
        ]
    )
    assert without_wall_time(compiled) == without_wall_time(pure)


def test_compiled_and_pure_cores_can_be_told_apart(tmp_path):
    """Otherwise the test above would compare one build with itself."""
    (said,) = outputs([start(tmp_path / "pure", 0, "--version", program=FROM_SOURCES)])
    assert "pure Python cores" in said
