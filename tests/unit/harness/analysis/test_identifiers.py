"""Proposals of identifiers: they help, are small, and "impossible" is correct."""

from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.harness.analysis.advice import (
    ERRORS_MAX,
    at_rate,
    best_order,
    more_errors_probability,
    propose,
    queues_that_help,
    rate_that_helps,
    shortest_error_interval_ns,
    tolerances,
    with_changes,
)
from motorhil.harness.analysis.subject import is_canopen_reserved, reserves_nothing
from motorhil.motorapi.synchronization.can_response_time import (
    NO_ERRORS,
    BusLoad,
    ErrorModel,
    Message,
    are_in_time,
)
from tests.support.recordings.message_sets import MS, US, davis, sae


def _load(*times: tuple[int, int], rate: int = 125_000, movable: tuple[bool, ...] = ()) -> BusLoad:
    """Return messages of 7 bytes and 1 ms, most urgent first: (period, deadline) [us]."""
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


def test_propose_for_davis_counter_example_is_impossible():
    proposal = propose(davis(), NO_ERRORS, reserves_nothing)
    assert (proposal.changes, proposal.is_impossible) == (None, True)
    assert rate_that_helps(davis()) == 250_000
    assert are_in_time(at_rate(davis(), 250_000))


def test_propose_changes_one_identifier_if_sufficient():
    load = _load((10_000, 10_000), (10_000, 10_000), (10_000, 10_000), (10_000, 2_500))
    proposal = propose(load, NO_ERRORS, reserves_nothing)
    assert proposal.changes is not None
    (change,) = proposal.changes
    assert (change.message.label, change.label) == ("106h", "0FFh")
    assert are_in_time(with_changes(load, proposal.changes))


def test_propose_avoids_reserved_identifiers():
    load = _load((10_000, 10_000), (10_000, 10_000), (10_000, 2_000))
    plain = propose(load, NO_ERRORS, reserves_nothing)
    assert plain.changes is not None
    kept_free = propose(load, NO_ERRORS, lambda number, _: number == plain.changes[0].identifier)
    assert kept_free.changes is not None
    assert kept_free.changes[0].identifier != plain.changes[0].identifier
    assert is_canopen_reserved(0x0FF, False)
    assert not is_canopen_reserved(0x181, False)
    assert not is_canopen_reserved(0x081, True)


def test_propose_keeps_immovable_messages():
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
def test_best_order_exists_iff_brute_force_finds_one(times):
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


def test_queues_that_help_names_the_fifo_sender():
    messages = (
        Message(0x100, 7, 10 * MS, deadline_ns=2 * MS, sender="node"),
        Message(0x200, 7, 10 * MS, deadline_ns=9 * MS, sender="other"),
        Message(0x300, 7, 10 * MS, deadline_ns=9 * MS, sender="node"),
    )
    load = BusLoad("can0", 125_000, messages, fifo=frozenset({"node"}))
    assert not are_in_time(load)
    assert queues_that_help(load) == ("node",)
    assert queues_that_help(davis()) is None


# --- margins


def test_shortest_error_interval_is_minimal():
    load = sae(250_000)
    interval_ns = shortest_error_interval_ns(load)
    assert interval_ns is not None
    assert are_in_time(load, ErrorModel(1, interval_ns))
    assert not are_in_time(load, ErrorModel(1, interval_ns * 998 // 1000 - US))
    assert shortest_error_interval_ns(davis()) is None


def test_tolerated_errors_are_maximal():
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


def test_late_probability_grows_with_bit_error_rate():
    tight = next(one for one in tolerances(sae(250_000)) if one.message.period_ns == 5 * MS)
    chances = [tight.late_probability(rate) for rate in (0.0, 1e-7, 1e-5, 1e-3)]
    assert chances == sorted(chances)
    assert chances[0] == 0.0 < chances[1] < 1e-9
    assert chances[-1] <= 1.0


@pytest.mark.parametrize("burst", [0, 1, 3])
def test_sae_benchmark_tolerates_error_bursts(burst: int):
    assert are_in_time(sae(500_000), ErrorModel(burst))


def test_more_errors_probability_equals_poisson_tail():
    # 1000 bits at 1e-3: a Poisson number of mean 1.0005. Its tail by the series, to three digits.
    assert more_errors_probability(0, 1000, 1e-3) == pytest.approx(0.6323, abs=1e-3)  # 1 - 0.999^n
    assert more_errors_probability(0, 1000, 1e-3) == pytest.approx(1 - 0.999**1000, rel=1e-9)
    assert more_errors_probability(2, 1000, 1e-3) == pytest.approx(0.0805, abs=1e-3)
    assert more_errors_probability(3, 100, 1e-6) == pytest.approx(1e-16 / 24, rel=1e-3)
    assert more_errors_probability(5, 100, 0.0) == 0.0
