"""Which identifiers to change: what is proposed helps, is small, and "none" is true."""

from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from harness.analysis.errors import NO_ERRORS, ErrorModel
from harness.analysis.identifiers import best_order, propose, with_changes
from harness.analysis.margins import (
    ERRORS_MAX,
    at_rate,
    queues_that_help,
    rate_that_helps,
    shortest_error_interval_ns,
    tolerances,
)
from harness.analysis.message import BusLoad, Message
from harness.analysis.response_time import are_in_time
from harness.analysis.subject import is_canopen_reserved, reserves_nothing
from tests.harness.analysis.sets import MS, US, davis, sae


def _load(*times: tuple[int, int], rate: int = 125_000, movable: tuple[bool, ...] = ()) -> BusLoad:
    """Messages of 7 bytes, 1 ms each, most urgent first: (period, deadline) [us]."""
    return BusLoad(
        "can0",
        rate,
        tuple(
            Message(
                0x100 + 2 * place,
                7,
                period_us * US,
                deadline_ns=deadline_us * US,
                movable=movable[place] if movable else True,
            )
            for place, (period_us, deadline_us) in enumerate(times)
        ),
    )


def test_the_counter_example_of_davis_and_others_has_no_order_that_helps():
    proposal = propose(davis(), NO_ERRORS, reserves_nothing)
    assert (proposal.changes, proposal.is_impossible) == (None, True)
    assert rate_that_helps(davis()) == 250_000
    assert are_in_time(at_rate(davis(), 250_000))


def test_one_identifier_is_changed_where_one_is_enough():
    load = _load((10_000, 10_000), (10_000, 10_000), (10_000, 10_000), (10_000, 2_500))
    proposal = propose(load, NO_ERRORS, reserves_nothing)
    assert proposal.changes is not None
    (change,) = proposal.changes
    assert (change.message.label, change.label) == ("106h", "0FFh")
    assert are_in_time(with_changes(load, proposal.changes))


def test_reserved_identifiers_are_not_given():
    load = _load((10_000, 10_000), (10_000, 10_000), (10_000, 2_000))
    plain = propose(load, NO_ERRORS, reserves_nothing)
    assert plain.changes is not None
    kept_free = propose(load, NO_ERRORS, lambda number, _: number == plain.changes[0].identifier)
    assert kept_free.changes is not None
    assert kept_free.changes[0].identifier != plain.changes[0].identifier
    assert is_canopen_reserved(0x0FF, False)
    assert not is_canopen_reserved(0x181, False)
    assert not is_canopen_reserved(0x081, True)


def test_what_cannot_move_does_not():
    times = ((10_000, 10_000), (10_000, 10_000), (10_000, 2_000))
    fixed = propose(_load(*times, movable=(False, False, False)), NO_ERRORS, reserves_nothing)
    assert (fixed.changes, fixed.is_impossible) == (None, True)
    other = propose(_load(*times, movable=(True, True, False)), NO_ERRORS, reserves_nothing)
    assert [one.message.label for one in other.changes or ()] == ["100h", "102h"]


@example([(4000, 4000), (4000, 3000), (4000, 2000), (4100, 4000)])  # two into a gap of one
@given(
    st.lists(
        st.tuples(st.integers(40, 120), st.integers(15, 60)).map(
            lambda both: (both[0] * 100, min(both) * 100)
        ),
        min_size=2,
        max_size=4,
    )
)
def test_an_order_is_found_exactly_where_one_of_all_orders_is_in_time(times):
    load = _load(*times)
    found = best_order(load)
    identifiers = [one.identifier for one in load.messages]
    some = any(
        are_in_time(
            replace(
                load,
                messages=tuple(
                    replace(one, identifier=identifier)
                    for one, identifier in zip(order, identifiers, strict=True)
                ),
            )
        )
        for order in permutations(load.messages)
    )
    assert (found is not None) == some
    proposal = propose(load, NO_ERRORS, reserves_nothing)
    assert (proposal.changes is not None) == some
    if proposal.changes:
        event(f"{len(proposal.changes)} changed")
    if proposal.changes is not None:
        assert are_in_time(with_changes(load, proposal.changes))


def test_a_queue_that_sends_the_urgent_first_can_help():
    messages = (
        Message(0x100, 7, 10 * MS, deadline_ns=2 * MS, sender="node"),
        Message(0x200, 7, 10 * MS, deadline_ns=9 * MS, sender="other"),
        Message(0x300, 7, 10 * MS, deadline_ns=9 * MS, sender="node"),
    )
    load = BusLoad("can0", 125_000, messages, fifo=frozenset({"node"}))
    assert not are_in_time(load)
    assert queues_that_help(load) == ("node",)
    assert queues_that_help(davis()) is None


# --- what it stands


def test_the_shortest_error_interval_is_on_the_edge():
    load = sae(250_000)
    interval_ns = shortest_error_interval_ns(load)
    assert interval_ns is not None
    assert are_in_time(load, ErrorModel(1, interval_ns))
    assert not are_in_time(load, ErrorModel(1, interval_ns * 998 // 1000 - US))
    assert shortest_error_interval_ns(davis()) is None


def test_so_many_errors_are_stood_and_not_one_more():
    load = sae(250_000)
    for one in tolerances(load):
        alone = replace(
            load,
            messages=tuple(
                each if each.rank == one.message.rank else replace(each, deadline_ns=None)
                for each in load.messages
            ),
        )
        assert one.errors is not None
        assert are_in_time(alone, ErrorModel(one.errors))
        assert one.errors == ERRORS_MAX or not are_in_time(alone, ErrorModel(one.errors + 1))
    assert [one.errors for one in tolerances(davis())][2] is None


def test_a_higher_bit_error_rate_makes_late_frames_likelier():
    tight = next(one for one in tolerances(sae(250_000)) if one.message.period_ns == 5 * MS)
    chances = [tight.late_probability(rate) for rate in (0.0, 1e-7, 1e-5, 1e-3)]
    assert chances == sorted(chances)
    assert chances[0] == 0.0 < chances[1] < 1e-9
    assert chances[-1] <= 1.0


@pytest.mark.parametrize("burst", [0, 1, 3])
def test_errors_never_make_anything_earlier(burst: int):
    assert are_in_time(sae(500_000), ErrorModel(burst))
