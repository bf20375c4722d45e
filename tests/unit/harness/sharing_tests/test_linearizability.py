"""Linearizability checks against known histories and against brute force."""

from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from motorhil.harness.sharing_tests.history import (
    FOREVER_NS,
    Action,
    Answer,
    SharingViolated,
    Use,
    ended_by_death,
)
from motorhil.harness.sharing_tests.linearizability import (
    OwnedMotor,
    _with,
    events_of,
    require_linearizable,
    search,
)
from tests.support.repetition import examples

TAKE, GIVE, COMMAND, READ, DIE = Action
DONE, REFUSED, LOST, UNKNOWN = Answer
LATE = FOREVER_NS


def use(who, action, called_ns, returned_ns, answer=DONE, **facts):
    return Use(who, "m", action, called_ns, returned_ns, answer, **facts)


def take(who, called_ns, returned_ns, token, **facts):
    return use(who, TAKE, called_ns, returned_ns, token=token, **facts)


def command(who, called_ns, returned_ns, value, answer=DONE):
    return use(who, COMMAND, called_ns, returned_ns, answer, value=value)


def is_allowed(*uses):
    try:
        require_linearizable(uses)
    except SharingViolated:
        return False
    return True


# ---- known histories


def test_empty_history_is_allowed():
    assert require_linearizable(()) == 0


def test_sequential_history_is_allowed():
    assert is_allowed(
        take("a", 0, 1, 5),
        command("a", 2, 3, 7),
        use("a", GIVE, 4, 5),
        take("b", 6, 7, 6),
        command("b", 8, 9, 8),
        use("c", READ, 10, 11, value=8),
    )


def test_two_owners_at_once_are_refused():
    first = take("a", 0, 1, 1)
    assert not is_allowed(first, take("b", 2, 3, 2), use("a", GIVE, 4, 5))
    assert is_allowed(first, take("b", 2, 6, 2), use("a", GIVE, 4, 5))  # it may have had to wait


def test_token_that_does_not_grow_is_refused():
    given_back = (take("a", 0, 1, 4), use("a", GIVE, 2, 3))
    assert not is_allowed(*given_back, take("b", 4, 5, 4))
    assert not is_allowed(*given_back, take("b", 4, 5, 3))
    assert is_allowed(*given_back, take("b", 4, 5, 5))


@pytest.mark.parametrize(
    ("queued_ns", "allowed"),
    [
        (19, False),  # b waits before c asks at 20
        (20, True),  # at the same instant
        (None, True),  # the start of b's waiting is unknown
    ],
)
def test_waiting_party_is_served_before_later_request(queued_ns, allowed):
    assert (
        is_allowed(
            take("a", 0, 1, 1),
            take("b", 2, 60, 3, queued_ns=queued_ns),
            take("c", 20, 40, 2),
            use("a", GIVE, 30, 31),
            use("c", GIVE, 50, 51),
        )
        is allowed
    )


def test_refusal_needs_an_owner_or_a_waiting_party():
    assert not is_allowed(use("b", TAKE, 0, 1, REFUSED))
    assert is_allowed(take("a", 0, 5, 1), use("b", TAKE, 3, 4, REFUSED))
    # a waiting party is sufficient, since it is the next owner
    waits = take("b", 1, 9, 2, queued_ns=2)
    assert is_allowed(
        take("a", 0, 1, 1), waits, use("a", GIVE, 3, 4), use("c", TAKE, 5, 6, REFUSED)
    )


def test_command_without_ownership_is_refused():
    assert not is_allowed(command("a", 0, 1, 3))
    assert is_allowed(command("a", 0, 1, 3, REFUSED))
    assert not is_allowed(take("a", 0, 1, 1), command("a", 2, 3, 3, REFUSED))


def test_loser_after_takeover_does_not_command():
    taken = (take("a", 0, 1, 1), take("b", 2, 3, 2, forced=True))
    assert is_allowed(*taken, command("a", 4, 5, 1, LOST), use("a", GIVE, 6, 7, LOST))
    assert not is_allowed(*taken, command("a", 4, 5, 1))
    assert not is_allowed(*taken, use("a", GIVE, 6, 7))
    assert not is_allowed(take("a", 0, 1, 1), take("b", 2, 3, 2))  # not a takeover: two owners
    # either is possible during the takeover
    assert is_allowed(*taken[:1], take("b", 2, 6, 2, forced=True), command("a", 4, 5, 1))


def test_expired_lease_goes_to_longest_waiting_party():
    first = take("a", 0, 1, 1)
    waits = take("b", 2, 30, 2, queued_ns=3, forced=True)
    assert is_allowed(first, waits)
    assert not is_allowed(
        first,
        take("c", 5, 20, 2, queued_ns=6, forced=True),
        take("b", 2, 30, 3, queued_ns=3, forced=True),
    )


def test_read_returns_the_last_command():
    commanded = (take("a", 0, 1, 1), command("a", 2, 3, 7), command("a", 4, 9, 8))
    assert is_allowed(*commanded, use("r", READ, 5, 6, value=7))
    assert is_allowed(*commanded, use("r", READ, 5, 6, value=8))
    assert not is_allowed(*commanded, use("r", READ, 10, 11, value=7))
    both = (use("r", READ, 5, 6, value=8), use("r", READ, 7, 8, value=7))
    assert not is_allowed(*commanded, *both)  # not back and forth


def test_command_of_dead_party_took_effect_before_death():
    death = use("a", DIE, 10, 12)
    begun = command("a", 5, LATE, 9, UNKNOWN)
    told = ended_by_death((take("a", 0, 1, 1), begun, death))
    read = use("r", READ, 20, 21, value=9)
    assert is_allowed(*told, read)
    assert is_allowed(*told, use("r", READ, 20, 21, value=0))
    assert is_allowed(*told, use("r", READ, 20, 21, value=0), use("r", READ, 22, 23, value=0))
    assert not is_allowed(*told, use("r", READ, 20, 21, value=0), use("r", READ, 22, 23, value=9))
    assert is_allowed(*told, take("b", 6, 13, 2))  # freed by the death
    assert not is_allowed(*told, take("b", 6, 9, 2))  # not earlier


def test_use_with_unknown_result_may_have_had_effect():
    unsure = (take("a", 0, 1, 1), command("a", 5, 6, 9, UNKNOWN))
    seven, eight = (use("r", READ, at, at + 1, value=9) for at in (7, 9))
    assert is_allowed(*unsure, seven, eight)
    assert is_allowed(*unsure, replace(seven, value=0), replace(eight, value=0))
    assert not is_allowed(*unsure, replace(seven, value=0), eight)


def test_dead_party_may_have_taken_over():
    uses = (
        take("a", 0, 1, 1),
        use("b", TAKE, 2, LATE, UNKNOWN),
        use("b", DIE, 10, 12),
        command("a", 20, 21, 3, LOST),
    )
    assert is_allowed(*ended_by_death(uses))
    assert not is_allowed(*(one for one in uses if one.who == "a"))


def test_dead_waiting_party_leaves_the_queue():
    uses = (
        take("a", 0, 1, 1),
        use("b", TAKE, 2, LATE, UNKNOWN, queued_ns=3),
        use("b", DIE, 10, 12),
        take("c", 5, 30, 2, queued_ns=6),
        use("a", GIVE, 20, 21),
    )
    assert is_allowed(*ended_by_death(uses))
    alive = [one for one in uses if one.action is not DIE]
    assert not is_allowed(*alive)


def test_violation_names_the_conflicting_uses():
    with pytest.raises(SharingViolated, match=r"(?s)m: no order of its 2 uses.*b take m: done"):
        require_linearizable((take("a", 0, 1, 1), take("b", 2, 3, 2)))


def test_motors_are_judged_separately():
    good = take("a", 0, 1, 1)
    other = Use("b", "other", TAKE, 0, 1, DONE, token=1)
    assert is_allowed(good, other)
    with pytest.raises(SharingViolated, match=r"^other: "):
        require_linearizable((good, other, Use("c", "other", TAKE, 2, 3, DONE, token=2)))


def test_steps_grow_linearly_with_long_histories():
    uses = []
    for turn in range(2000):
        at = turn * 100
        who = f"w{turn % 5}"
        uses.append(take(who, max(0, at - 350), at + 10, turn + 1, queued_ns=max(0, at - 349)))
        uses.append(command(who, at + 20, at + 30, turn))
        uses.append(use(who, GIVE, at + 40, at + 50))
    assert require_linearizable(uses) < 10 * 8000


def test_reached_state_is_not_searched_again():
    readers = [use(f"r{number}", READ, 0, 10) for number in range(10)]
    impossible = use("x", READ, 20, 21, value=1)
    found = search(events_of([*readers, impossible]), OwnedMotor())
    assert found.order is None
    assert len(found.reached) == 10
    assert found.stuck == tuple(events_of([impossible]))
    assert found.steps <= 10 * 2**10 + 11  # instead of 10! orders


@given(st.permutations(range(9)), st.integers(0, 9))
def test_with_represents_sets_uniquely(numbers, many):
    passed = ahead = 0
    for number in numbers[:many]:
        passed, ahead = _with(passed, ahead, number)
    found = {number for number in range(9) if number < passed or ahead >> number - passed & 1}
    assert found == set(numbers[:many])


# ---- brute force


def brute_force(events, specification):
    """Return True if any order of the events fits the times and the specification."""
    for order in permutations(events):
        if any(
            later.returned_ns < earlier.called_ns
            for place, earlier in enumerate(order)
            for later in order[place + 1 :]
        ):
            continue
        states = [specification.initial()]
        for one in order:
            states = [after for state in states for after in specification.step(state, one)]
        if states:
            return True
    return False


TIMES = st.integers(0, 12)


@st.composite
def anything(draw):
    """Draw a use of any kind, mostly an implausible one."""
    begin, end = sorted((draw(TIMES), draw(TIMES)))
    action = draw(st.sampled_from(list(Action)))
    answer = draw(st.sampled_from([DONE, DONE, DONE, REFUSED, LOST, UNKNOWN]))
    return Use(
        draw(st.sampled_from("abc")),
        "m",
        action,
        begin,
        end,
        answer,
        queued_ns=draw(st.sampled_from([None, begin, end])) if action is TAKE else None,
        token=draw(st.integers(0, 3)) if action is TAKE else 0,
        value=draw(st.integers(0, 1)) if action in (COMMAND, READ) else 0,
        forced=action is TAKE and draw(st.booleans()),
    )


@st.composite
def plausible(draw):
    """Draw correct sequential uses with wider intervals, and at most one wrong use."""
    uses, holder, token, value = [], None, 0, 0
    for place in range(draw(st.integers(1, 4))):
        who = draw(st.sampled_from("abc"))
        at = 3 * place + 3
        begin, end = at - draw(st.integers(0, 7)), at + draw(st.integers(0, 7))
        kind = draw(st.sampled_from([TAKE, GIVE, COMMAND, READ]))
        if holder is not None and kind in (GIVE, COMMAND):
            who = draw(st.sampled_from([who, holder]))
        done = DONE if holder == who else LOST
        if kind is TAKE:
            if holder is None:
                holder, token = who, token + 1
                uses.append(take(who, begin, end, token))
            elif holder != who:
                uses.append(use(who, TAKE, begin, end, REFUSED))
        elif kind is READ:
            uses.append(use(who, READ, begin, end, value=value))
        else:
            value = place if kind is COMMAND and done is DONE else value
            uses.append(use(who, kind, begin, end, done, value=place if kind is COMMAND else 0))
            holder = None if kind is GIVE and done is DONE else holder
    if draw(st.booleans()):  # begun, without any effect
        begin, end = sorted((draw(TIMES), draw(TIMES)))  # and it died there
        begun = use("d", draw(st.sampled_from([TAKE, COMMAND, GIVE])), begin, end, UNKNOWN)
        uses.append(begun if draw(st.booleans()) else replace(begun, who="a"))
    if uses and draw(st.booleans()):
        victim = draw(st.integers(0, len(uses) - 1))
        uses[victim] = draw(anything())
    return uses


@settings(max_examples=examples(200))
@given(st.lists(anything(), max_size=4) | plausible())
def test_search_finds_an_order_iff_brute_force_does(uses):
    events, specification = events_of(uses), OwnedMotor()
    found = search(events, specification)
    expected = brute_force(events, specification)
    event(f"allowed: {expected}, events: {len(events)}")
    assert (found.order is not None) is expected
    if found.order is not None:
        assert sorted(map(repr, found.order)) == sorted(map(repr, events))
