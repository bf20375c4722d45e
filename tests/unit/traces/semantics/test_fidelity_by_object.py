"""Fidelity by object; each case plants one difference."""

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.replay.host import compared
from motorhil.traces.can_frame import RTR, classic
from motorhil.traces.exchange.host import HostCutter, Listener, answer_size
from motorhil.traces.schema import Direction
from motorhil.traces.semantics.diff import Tolerance

SAME = (
    *("701#00", "601#4041600000000000", "581#4B41600031020000", "701#7F", "1E5#0102"),
    *("601#406C600000000000", "581#436C600064000000", "601#4064600000000000"),
    *("581#4364600001000000", "601#2F60600001000000", "581#6060600000000000"),
)


def alike(tmp_path, first, second):
    """Return objects and differences of two recordings with a frame every 10 ms."""
    paths = []
    for name, frames in (("first", first), ("second", second)):
        log, path = tmp_path / f"{name}.log", tmp_path / f"{name}.mcap"
        rows = [f"({number / 100:.6f}) can0 {one}\n" for number, one in enumerate(frames)]
        log.write_text("".join(rows))
        assert main(["convert", str(log), "-o", str(path), "--force"]) == 0
        paths.append(path)
    return compared(*paths, [(0, 0)], Tolerance())


def share(objects):
    return sum(one.agreeing for one in objects) / sum(one.of for one in objects)


def test_equal_recordings_have_no_difference(tmp_path):
    objects, differing = alike(tmp_path, SAME, SAME)
    assert (share(objects), differing) == (1.0, [])


@pytest.mark.parametrize(
    ("place", "other"),
    [
        (2, "581#4B41600037020000"),  # a state
        (3, "701#05"),  # NMT state
        (4, "1E5#0103"),  # of a PDO without a known mapping
        (8, "581#4364600011000000"),  # a position
        (2, "581#8041600000000206"),  # a refused answer
        (10, "581#8060600030000906"),  # a refused write
        (10, "6E5#0102"),  # of no service
        (10, "181F0001#01"),  # extended
        (10, "081#2082010000000000"),  # an emergency that only the second one has
    ],
)
def test_one_difference_lowers_the_share(tmp_path, place, other):
    second = [*SAME[:place], other, *SAME[place + 1 :]]
    objects, differing = alike(tmp_path, SAME, second)
    assert share(objects) < 1.0
    assert differing
    objects, differing = alike(tmp_path, second, SAME)
    assert share(objects) < 1.0
    assert differing


def test_object_of_second_recording_only_does_not_agree(tmp_path):
    objects, differing = alike(tmp_path, SAME, (*SAME, "081#2082010000000000"))
    (one,) = [one for one in objects if one.share < 1.0]
    assert (one.label, one.first, one.second) == ("can0, node 1, emergency", 0, 1)
    assert len(differing) == 1


def test_uncompared_object_is_listed(tmp_path):
    """A measured velocity differs from run to run."""
    objects, _ = alike(tmp_path, SAME, [*SAME[:6], "581#436C600099990000", *SAME[7:]])
    (one,) = [one for one in objects if not one.is_compared]
    assert "606Ch" in one.label
    assert (one.first, one.second, one.of) == (1, 1, 0)


def test_remote_frames_belong_to_the_host():
    cutter = HostCutter(Listener({}), lambda *_: 0)
    cutter.take_frame(5, "can0", classic(0x701 | RTR, b""), Direction.UNKNOWN)
    assert [step.frame[3] & 0x40 for step in cutter.steps()] == [0x40]


@pytest.mark.parametrize(
    "told",
    [
        "012B0E01010000020002" + "4142" + "010158" + "0000",  # specification 6.21: two objects
        "011800060002" + "01B81284" + "0000",  # 6.18: read FIFO queue, byte count in two bytes
        "010302022B0000",
        "01830200" + "00",
    ],
)
def test_answer_size_detects_the_end(told):
    data = bytes.fromhex(told)
    assert answer_size(data, False) == len(data)
    assert all((answer_size(data[:n], False) or len(data)) == len(data) for n in range(len(data)))
