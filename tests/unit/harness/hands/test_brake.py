"""The brake alone: when events run, and at which instant an act takes effect."""

import pytest

from motorhil.harness.hands.brake import Brake
from motorhil.harness.hands.requests import Stimulate
from tests.unit.harness.hands.conftest import Script

MS = 1_000_000
LOAD = {"act": "stimulus", "controller": "left", "name": "load_torque_n_m", "value": 1.0}


class Hand:
    """Hands that note when each act takes effect."""

    def __init__(self):
        self.is_busy = False
        self.revision = 0
        self.acts, self.flushed = [], 0
        self.time_ns = 0

    def elements(self):
        return {}

    def state(self):
        return {"acts": len(self.acts)}

    def now_ns(self):
        return self.time_ns

    def flush(self):
        self.flushed += 1

    def act(self, request, time_ns):
        assert isinstance(request, Stimulate)
        self.acts.append(time_ns)


@pytest.fixture
def brake():
    """Return a function that makes a brake, its channel and its hand."""

    def make(requests, pace=1.0, is_stopped=False):
        channel, hand = Script(requests), Hand()
        return Brake(hand, channel, pace, is_stopped, lambda: channel.now_ns), channel, hand

    return make


def test_event_waits_for_its_wall_time(brake):
    one, channel, _ = brake([], pace=2.0)
    assert one(0) is False
    assert one(10 * MS) is False
    assert channel.now_ns == pytest.approx(5 * MS, abs=2)


def test_act_takes_effect_where_time_has_come(brake):
    one, channel, hand = brake([(0.004, LOAD)])
    one(0)
    channel.now_ns = 4 * MS
    assert one(10 * MS) is True
    assert hand.acts == [4 * MS]
    assert channel.answers == {1: ""}


@pytest.mark.parametrize(("now_ns", "due_ns", "wanted"), [(7, 9, 8), (7, 10, 8), (0, 2, 1)])
def test_act_is_strictly_between_two_events(brake, now_ns, due_ns, wanted):
    one, _, hand = brake([(0.0, LOAD)], is_stopped=True)
    hand.time_ns = one.held_ns = now_ns
    assert one(due_ns) is True
    assert hand.acts == [wanted]


def test_act_of_a_late_rig_is_before_the_next_event(brake):
    one, channel, hand = brake([(1.0, LOAD)])
    one(0)
    channel.now_ns = 10**9
    assert one(5 * MS) is True
    assert hand.acts == [5 * MS - 1]


def test_act_without_a_free_instant_waits_for_the_next_event(brake):
    one, channel, hand = brake([(0.0, LOAD)], is_stopped=True)
    hand.time_ns = one.held_ns = 7
    assert one(8) is False
    assert channel.answers == {}
    hand.time_ns = 8
    assert one(100) is True
    assert hand.acts == [9]


def test_step_lets_exactly_its_duration_pass(brake):
    requests = [(0.0, {"act": "step", "for_s": 0.01}), (9e9, LOAD)]  # the page stays
    one, channel, hand = brake(requests, is_stopped=True)
    assert one(3 * MS) is False
    hand.time_ns = 3 * MS
    assert one(10 * MS) is False
    hand.time_ns = 10 * MS
    assert one(10 * MS + 1) is True  # look again
    assert channel.states[-1]["at_s"] == 0.01
    assert hand.flushed == 1  # once for each standstill
    assert one(10 * MS + 1) is True
    assert hand.flushed == 1
    assert hand.acts == []


def test_act_after_a_step_waits_for_its_end(brake):
    requests = [(0.0, {"act": "step", "for_s": 0.01}), (0.0, LOAD)]
    one, channel, hand = brake(requests, is_stopped=True)
    assert one(3 * MS) is False
    assert channel.answers == {1: ""}
    hand.time_ns = 3 * MS
    assert one(20 * MS) is True
    assert hand.acts == [10 * MS]


def test_stop_holds_time_where_it_has_come(brake):
    one, channel, _ = brake([(0.004, {"act": "stop"}), (5.0, {"act": "continue"})])
    one(0)
    while one(10 * MS):
        pass
    held = [state["at_s"] for state in channel.states if state["stands"]]
    assert set(held) == {0.004}
    assert channel.states[-1]["stands"] is False
    assert channel.now_ns == pytest.approx(5 * 10**9 + 6 * MS, abs=10)


def test_pace_changes_from_the_present_time_on(brake):
    one, channel, _ = brake([(0.0, {"act": "pace", "pace": 0.1})])
    one(0)
    one(10 * MS)
    assert channel.now_ns == pytest.approx(100 * MS, abs=10)


def test_time_passes_again_when_the_page_server_has_ended(brake):
    one, channel, _ = brake([], is_stopped=True)
    channel.is_open = False
    assert one(1) is False


def test_end_refuses_what_waits(brake):
    one, channel, _ = brake([], is_stopped=True)
    channel.inbox.append({"id": 7, "act": LOAD})
    one.end()
    assert channel.answers == {7: "rig: the run is over"}
    assert channel.states[-1]["over"] is True
