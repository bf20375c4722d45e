"""Fault rules: the frames that a plan hits."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.can.bus.fault_plan import NEVER_NS, FaultPlan
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import EFF_FLAG, pack, pack_remote

DROP = FaultKind.DROP


def _no_draw() -> float:
    raise AssertionError("a draw where none is needed")


def _sequence(*values: float) -> Callable[[], float]:
    return iter(values).__next__


def _hits(rule: FaultRule, frame: bytes, sender: str = "left", now_ns: int = 0) -> bool:
    return FaultPlan([rule], _no_draw).verdict(frame, sender, now_ns) is rule


def test_rule_without_conditions_hits_all_without_draw():
    for frame in (pack(0), pack(0x181, b"\x01"), pack_remote(0x701), pack(0x181 | EFF_FLAG)):
        assert _hits(FaultRule("all", DROP), frame)


@pytest.mark.parametrize(
    ("can_id", "hit"), [(0x181, True), (0x182, False), (0x181 | EFF_FLAG, False)]
)
def test_identifier_matches_its_own_format_only(can_id, hit):
    assert _hits(FaultRule("tpdo", DROP, identifier=0x181), pack(can_id)) is hit


def test_identifier_matches_data_and_remote_frames():
    assert _hits(FaultRule("tpdo", DROP, identifier=0x181), pack_remote(0x181))


@pytest.mark.parametrize(("can_id", "hit"), [(0x180, True), (0x1FF, True), (0x200, False)])
def test_mask_selects_bits_of_identifier(can_id, hit):
    rule = FaultRule("tpdos", DROP, identifier=0x185, mask=0x780)
    assert _hits(rule, pack(can_id)) is hit


def test_sender_is_matched_by_name():
    rule = FaultRule("left's", DROP, sender="left")
    assert _hits(rule, pack(1), sender="left")
    assert not _hits(rule, pack(1), sender="right")


@pytest.mark.parametrize(("now_ns", "hit"), [(9, False), (10, True), (19, True), (20, False)])
def test_window_includes_beginning_and_excludes_end(now_ns, hit):
    assert _hits(FaultRule("then", DROP, from_ns=10, until_ns=20), pack(1), now_ns=now_ns) is hit


def test_first_rule_that_fires_decides():
    plan = FaultPlan(
        [
            FaultRule("never", DROP, probability=0.5),
            FaultRule("first", DROP, identifier=1),
            FaultRule("second", DROP),
        ],
        _sequence(0.5, 0.5),
    )
    names = [rule.name for can_id in (1, 2) if (rule := plan.verdict(pack(can_id), "a", 0))]
    assert names == ["first", "second"]
    assert plan.fired() == {"never": 0, "first": 1, "second": 1}


@pytest.mark.parametrize(("draw", "hit"), [(0.0, True), (0.2499, True), (0.25, False)])
def test_probability_takes_one_draw_per_matching_frame(draw, hit):
    plan = FaultPlan([FaultRule("some", DROP, identifier=1, probability=0.25)], _sequence(draw))
    assert plan.verdict(pack(2), "left", 0) is None  # draws nothing
    assert (plan.verdict(pack(1), "left", 0) is not None) is hit


def test_skip_spares_first_frames_and_limit_ends_rule():
    plan = FaultPlan([FaultRule("third", DROP, skip=2, limit=2)], _no_draw)
    hits = [plan.verdict(pack(1), "left", time_ns) is not None for time_ns in range(6)]
    assert hits == [False, False, True, True, False, False]
    assert plan.fired() == {"third": 2}


def test_every_firing_is_reported_once():
    plan = FaultPlan([FaultRule("third", DROP, skip=2, limit=1)], _no_draw)
    for time_ns in range(6):
        plan.verdict(pack(time_ns), "left", time_ns)
    assert plan.take_events() == [(2, "third", "drop", pack(2))]
    assert plan.take_events() == []


@given(st.binary(min_size=1, max_size=8), st.floats(0, 1, exclude_max=True))
def test_corrupted_data_differ_in_one_drawn_bit(data, draw):
    rule = FaultRule("flip", FaultKind.CORRUPT)
    plan = FaultPlan([rule], _sequence(draw))
    frame = pack(0x181, data)
    other = plan.corrupted(rule, frame)
    assert len(other) == len(frame)
    assert other[:8] == frame[:8]
    assert other[8 + len(data) :] == frame[8 + len(data) :]
    difference = int.from_bytes(other[8:], "big") ^ int.from_bytes(frame[8:], "big")
    assert difference.bit_count() == 1


def test_every_data_bit_can_be_hit():
    rule = FaultRule("flip", FaultKind.CORRUPT)
    frame = pack(0x181, b"\x00\x00")
    seen = {
        FaultPlan([rule], _sequence((bit + 0.5) / 16)).corrupted(rule, frame) for bit in range(16)
    }
    assert len(seen) == 16


def test_flip_selects_bits_of_existing_data():
    rule = FaultRule("flip", FaultKind.CORRUPT, flip=b"\x00\xff\x01")
    plan = FaultPlan([rule], _no_draw)
    assert plan.corrupted(rule, pack(1, b"\x0f\x0f\x00\x07")) == pack(1, b"\x0f\xf0\x01\x07")
    assert plan.corrupted(rule, pack(1, b"\x0f\x0f")) == pack(1, b"\x0f\xf0")


@pytest.mark.parametrize("frame", [pack(0x80), pack(0x181, b"\x01"), pack_remote(0x181, 8)])
def test_frame_without_bits_to_flip_is_not_hit(frame):
    assert not _hits(FaultRule("flip", FaultKind.CORRUPT, flip=b"\x00\xff"), frame)


@pytest.mark.parametrize("frame", [pack(0x80), pack_remote(0x181, 8)])
def test_frame_without_data_is_not_corrupted(frame):
    assert not _hits(FaultRule("flip", FaultKind.CORRUPT), frame)


def test_cuts_are_reported_at_beginning_and_end():
    rule = FaultRule("cable", FaultKind.CUT, ports=("left", "right"), from_ns=5, until_ns=9)
    plan = FaultPlan([rule], _no_draw)
    assert [plan.next_change_ns(time_ns) for time_ns in (0, 4, 5, 8, 9)] == [5, 5, 9, 9, NEVER_NS]
    changed = []
    for time_ns in (4, 5, 8, 9):
        changed.append((plan.keep(time_ns), plan.lasting(FaultKind.CUT) == [rule]))
    assert changed == [(False, False), (True, True), (False, True), (True, False)]
    assert plan.take_events() == [
        (5, "cable", "left, right cut off", b""),
        (9, "cable", "left, right back", b""),
    ]
    assert plan.fired() == {"cable": 1}


def test_next_change_is_earliest_of_all_cuts():
    cuts = [
        FaultRule(f"{from_ns}", FaultKind.CUT, ports=("a",), from_ns=from_ns, until_ns=until_ns)
        for from_ns, until_ns in ((30, 40), (10, 35), (20, 50))
    ]
    plan = FaultPlan(cuts, _no_draw)
    changes = [0]
    while (next_ns := plan.next_change_ns(changes[-1])) != NEVER_NS:
        changes.append(next_ns)
    assert changes == [0, 10, 20, 30, 35, 40, 50]
    lasting = []
    for time_ns in changes:
        plan.keep(time_ns)
        lasting.append(len(plan.lasting(FaultKind.CUT)))
    assert lasting == [0, 1, 2, 3, 2, 1, 0]


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"probability": 1.01}, "probability 1.01"),
        ({"probability": -0.1}, "probability -0.1"),
        ({"from_ns": -1}, "from_ns -1"),
        ({"from_ns": 5, "until_ns": 5}, "until_ns 5"),
        ({"skip": -1}, "skip -1"),
        ({"limit": 0}, "limit 0"),
        ({"delay_ns": 1}, "delay_ns 1: invalid"),
        ({"kind": FaultKind.DELAY}, "delay_ns 0: invalid"),
        ({"kind": FaultKind.DELAY, "delay_ns": -1}, "delay_ns -1: invalid"),
        ({"flip": b"\x01"}, "flip: invalid; only corrupt"),
        ({"kind": FaultKind.CORRUPT, "flip": b"\x00"}, "at least one bit set"),
        ({"kind": FaultKind.CUT}, "cut: no ports"),
        ({"kind": FaultKind.CUT, "ports": ("a",), "identifier": 0}, "cut: invalid condition"),
        ({"kind": FaultKind.CUT, "ports": ("a",), "sender": "a"}, "cut: invalid condition"),
        ({"kind": FaultKind.CUT, "ports": ("a",), "skip": 1}, "cut: invalid condition"),
        ({"kind": FaultKind.CUT, "ports": ("a",), "limit": 1}, "cut: invalid condition"),
        ({"kind": FaultKind.CUT, "ports": ("a",), "probability": 0.5}, "cut: invalid condition"),
    ],
)
def test_invalid_rule_is_refused_by_name(settings, told):
    with pytest.raises(ValueError, match=f"fault odd: .*{told}"):
        FaultRule(**{"name": "odd", "kind": DROP, **settings})


def test_rule_names_stay_unique_after_removal():
    plan = FaultPlan([FaultRule("one", DROP)], _no_draw)
    with pytest.raises(ValueError, match="one"):
        plan.add(FaultRule("one", DROP))
    plan.remove("one")
    with pytest.raises(ValueError, match="one"):
        plan.add(FaultRule("one", DROP))


def test_removed_rule_hits_nothing_and_keeps_count():
    plan = FaultPlan([FaultRule("one", DROP)], _no_draw)
    assert plan.verdict(pack(1), "left", 0) is not None
    plan.remove("one")
    assert plan.verdict(pack(1), "left", 0) is None
    assert plan.is_empty()
    assert plan.fired() == {"one": 1}
    with pytest.raises(ValueError, match="fault one: unknown rule"):
        plan.remove("one")


@pytest.mark.parametrize(
    ("rule", "end_ns"),
    [
        (FaultRule("once", DROP, limit=1), 5),
        (FaultRule("until", DROP, until_ns=20), 20),
        (FaultRule("error", FaultKind.ERROR, until_ns=20, bit=3), 20),
    ],
    ids=lambda value: value.name if isinstance(value, FaultRule) else "",
)
def test_ended_rule_leaves_an_empty_plan_and_can_be_lifted(rule, end_ns):
    plan = FaultPlan([rule, FaultRule("longer", DROP, sender="host", until_ns=30)], _no_draw)
    plan.verdict(pack(1), "left", 5)
    assert not plan.end_rules(end_ns - 1)
    assert plan.end_rules(end_ns)
    assert not plan.end_rules(end_ns)
    assert not plan.is_empty()
    assert plan.end_rules(30)
    assert plan.is_empty()
    assert plan.fired() == {rule.name: int(rule.kind is DROP), "longer": 0}
    plan.remove(rule.name)
    with pytest.raises(ValueError, match="unknown rule"):
        plan.remove(rule.name)
    with pytest.raises(ValueError, match="name already used"):
        plan.add(rule)
