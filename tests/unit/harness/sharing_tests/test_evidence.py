"""Evidence from frames: frames by the standards, ownership as recorded."""

from collections.abc import Sequence
from dataclasses import replace

import pytest

from motorhil.harness.sharing_tests.bus_evidence import BusFrame, commanded_node, judge_frames
from motorhil.harness.sharing_tests.history import SharingViolated
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import LockEvent, ownership_of

MS = 1_000_000
NODES = {"pan": ("can0", 3)}


@pytest.mark.parametrize(
    ("can_id", "data", "node"),
    [
        (0x000, "01 03", None),  # NMT: start node 3
        (0x000, "02 03", 3),  # stop node 3
        (0x000, "80 00", 0),  # all: enter pre-operational
        (0x080, "", None),  # SYNC
        (0x183, "37 06", None),  # TPDO 1 of node 3
        (0x203, "0f 00 00 00 10 00", 3),  # RPDO 1: enable operation, a target
        (0x203, "1f 00 00 00 10 00", 3),  # new set-point
        (0x203, "0f 01", None),  # halt
        (0x203, "0b 00", None),  # quick stop
        (0x203, "0d 00", None),  # disable voltage
        (0x203, "07 00", None),  # disable operation
        (0x203, "8f 00", 3),  # fault reset
        (0x303, "0f 00", 3),
        (0x603, "40 41 60 00 00 00 00 00", None),  # upload
        (0x603, "60 00 00 00 00 00 00 00", None),  # upload segment
        (0x603, "80 41 60 00 00 00 04 05", None),  # abort
        (0x603, "23 81 60 00 e8 03 00 00", 3),  # download of 6081h
        (0x603, "00 01 02 03 04 05 06 07", 3),  # download segment
        (0x603, "c2 10 10 01 04 00 00 00", 3),  # block download
        (0x603, "2b 40 60 00 0f 01 00 00", None),  # a halt by SDO
        (0x603, "2b 40 60 00 1f 00 00 00", 3),  # a new set-point by SDO
        (0x703, "05", None),  # heartbeat
    ],
)
def test_commanded_node_ignores_reads_and_stops(can_id, data, node):
    assert commanded_node(can_id, bytes.fromhex(data)) == node


def told(at_ms, action, token, sender):
    return LockEvent(
        "pan", at_ms * MS, action, owner=sender, token=token, sender=sender, pid=ord(sender)
    )


def frame(at_ms, sender, can_id=0x203, data="1f 00 00 00"):
    return BusFrame("can0", round(at_ms * MS), sender, can_id, bytes.fromhex(data))


TAKEN, RELEASED, OVER = LockAction.TAKEN, LockAction.RELEASED, LockAction.TAKEN_OVER
TOLD = [
    told(10, TAKEN, 1, "a"),
    told(20, RELEASED, 1, "a"),
    told(30, TAKEN, 2, "b"),
    told(40, OVER, 3, "a"),
]


def judged(*frames, events=TOLD):
    return judge_frames(frames, ownership_of(events), NODES)


def test_frames_of_owner_and_of_free_time_are_sound():
    evidence = judged(frame(15, "a"), frame(25, "c"), frame(35, "b"), frame(50, "a"))
    evidence.require_sound()
    assert evidence.counts == {"pan: own": 3, "pan: free": 1}


class Counted(Sequence):
    """Tenures that count how often one of them is looked at."""

    looks = 0

    def __init__(self, tenures):
        self.tenures = tenures

    def __len__(self):
        return len(self.tenures)

    def __getitem__(self, place):
        self.looks += 1
        return self.tenures[place]


def test_owner_of_a_frame_is_found_without_looking_at_all_tenures():
    turns = [
        told(10 * number + at_ms, action, number, "a")
        for number in range(1, 1001)
        for at_ms, action in ((0, TAKEN), (5, RELEASED))
    ]
    record = ownership_of(turns)
    counted = Counted(record.tenures["pan"])
    frames = [frame(10 * number + 1, "a") for number in range(1, 1001)]
    evidence = judge_frames(frames, replace(record, tenures={"pan": counted}), NODES)
    assert evidence.counts == {"pan: own": 1000}
    assert counted.looks <= 1000 * 12


@pytest.mark.parametrize("at_ms", [10, 19.9, 30, 39.9, 45])
def test_foreign_frame_during_ownership_is_reported(at_ms):
    evidence = judged(frame(at_ms, "c"))
    with pytest.raises(
        SharingViolated, match="1 commanding frames from a process that did not own"
    ):
        evidence.require_sound()


def test_losers_frame_may_follow_within_late_s():
    judged(frame(42, "b")).require_sound()
    with pytest.raises(SharingViolated):
        judged(frame(42.1, "b")).require_sound()


def test_next_owner_may_send_settings_but_not_move():
    settings = frame(39, "a", 0x603, "23 81 60 00 e8 03 00 00")
    assert judged(settings).counts == {"pan: next": 1}
    with pytest.raises(SharingViolated):
        judged(frame(39, "a")).require_sound()


def test_other_nodes_buses_and_stops_do_not_count():
    others = [
        frame(15, "c", 0x204),
        BusFrame("can1", 15 * MS, "c", 0x203, b"\x1f\0"),
        frame(15, "c", 0x203, "0f 01"),
    ]
    assert judged(*others).counts == {}


@pytest.mark.parametrize(
    ("nodes", "named"),
    [
        ({"pan": ("can9", 3)}, r"pan \(can9 node 3\)"),
        ({"pan": ("can0", 3), "tilt": ("can0", 4)}, r"tilt \(can0 node 4\): no frame"),
        ({}, "any motor"),
    ],
)
def test_motor_without_commands_is_not_proved_sound(nodes, named):
    evidence = judge_frames([frame(15, "a")], ownership_of(TOLD), nodes)
    with pytest.raises(SharingViolated, match=f"nothing is proved about {named}"):
        evidence.require_sound()


def test_nmt_to_all_nodes_commands_each_motor():
    assert judged(frame(15, "c", 0x000, "81 00")).counts == {"pan: foreign": 1}


def test_crossed_handovers_are_ordered_by_tokens():
    crossed = [told(10, TAKEN, 2, "b"), told(11, TAKEN, 1, "a"), told(11, RELEASED, 1, "a")]
    evidence = judged(frame(12, "b"), events=crossed)
    evidence.require_sound()
    assert evidence.counts == {"pan: own": 1}
