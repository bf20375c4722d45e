"""Rest of any motor after the end of its group's motion, until it has a new owner."""

import pytest

from motorhil.harness.oracles.base import Verdict
from motorhil.harness.oracles.judge import judge
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.protobuf import encode
from motorhil.traces.schema import GROUP_SYNC, JOINT_STATE, MOTOR_LOCK, JointStateEncoder, Schema
from tests.support.recordings.story import MS, RELEASED, TAKEN

START, END = 1, 2
MOVE = ((200, 0.0), (400, 0.4), (600, 0.8), (800, 1.0))
USUAL = ((100, TAKEN), (210, RELEASED), (200, START), (810, END))


def rests(path, positions, others=USUAL):
    """Return the finding of `rest-when-told` for these (ms, position), locks and groups."""
    with TraceWriter(path, {"run": {}}) as writer:
        state = writer.channel("/motor/pan/state", Schema.of(JOINT_STATE))
        lock = writer.channel("/motor/pan/lock", Schema.of(MOTOR_LOCK))
        group = writer.channel("/group/mast/sync", Schema.of(GROUP_SYNC))
        encoder = JointStateEncoder("pan")
        events = [(ms, state, encoder.encode(at, None, None)) for ms, at in positions]
        for ms, what in others:
            if what in (START, END) and not isinstance(what, type(TAKEN)):
                told = encode(GROUP_SYNC, {"phase": what, "motor": ["pan", "tilt"]})
                events.append((ms, group, told))
            else:
                values = {"action": what.value, "owner": "host", "token": 1}
                events.append((ms, lock, encode(MOTOR_LOCK, values)))
        for ms, channel, payload in sorted(events, key=lambda event: event[0]):
            writer.write(channel, ms * MS, payload)
    (finding,) = judge(path, only=["rest-when-told"])
    return finding


@pytest.mark.parametrize(
    ("positions", "others", "looked"),
    [
        (MOVE, (*USUAL, (2000, TAKEN)), 1),
        ((*MOVE, (880, 0.97), (1200, 0.981)), (*USUAL, (2000, TAKEN)), 1),  # it settles
        ((*MOVE, (2100, 1.0), (2200, 3.0)), (*USUAL, (2000, TAKEN)), 1),  # another owner
        ((*MOVE, (1200, 2.0)), (*USUAL, (1100, START), (2000, END), (3000, TAKEN)), 2),
        ((*MOVE, (1200, 2.0)), USUAL[:1] + USUAL[2:], 0),  # the owner may continue
        ((*MOVE, (1200, 2.0)), USUAL[2:], 0),  # no ownership is recorded
    ],
)
def test_resting_or_owned_motor_is_not_broken(tmp_path, positions, others, looked):
    finding = rests(tmp_path / "one.mcap", positions, others)
    assert (finding.looked, finding.first) == (looked, None)
    assert finding.verdict is (Verdict.HELD if looked else Verdict.NOT_JUDGED)


def test_creeping_motor_is_broken(tmp_path):
    """The travel was 1 rad; 2 % of it are allowed, from 100 ms after the end on."""
    positions = (*MOVE, (1200, 1.01), (1500, 1.05), (1700, 1.02))
    finding = rests(tmp_path / "one.mcap", positions, (*USUAL, (2000, TAKEN)))
    assert finding.verdict is Verdict.BROKEN
    first = finding.first
    assert (first.time_ns, first.motor) == (1500 * MS, "pan")
    assert first.value == pytest.approx(0.05)  # of two doubles
    assert first.limit == pytest.approx(0.021)
    within = (*MOVE, (1200, 1.02), (1500, 1.0))
    assert rests(tmp_path / "two.mcap", within, (*USUAL, (2000, TAKEN))).verdict is Verdict.HELD
