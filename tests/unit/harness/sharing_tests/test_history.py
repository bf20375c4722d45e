"""Histories: notes of uses, and checks of the notes alone."""

from motorhil.harness.sharing_tests.history import (
    FOREVER_NS,
    Action,
    Answer,
    History,
    Use,
    ended_by_death,
    from_line,
    from_notes,
    overtaken,
    to_line,
    to_note,
    tokens_that_did_not_grow,
    worst_gap_s,
)


def taken(who, called_ns, returned_ns, token, queued_ns=None, motor="m", forced=False):
    return Use(
        who,
        motor,
        Action.TAKE,
        called_ns,
        returned_ns,
        queued_ns=queued_ns,
        token=token,
        forced=forced,
    )


def test_use_is_unknown_until_completed():
    now = iter(range(10, 100, 10))
    history = History(lambda: next(now))
    note = history.call("a", "m", Action.TAKE)
    (use,) = history.uses()
    assert (use.answer, use.called_ns, use.returned_ns) == (Answer.UNKNOWN, 10, FOREVER_NS)
    note.queued()
    note.returned(token=3)
    assert history.uses() == (taken("a", 10, 30, 3, queued_ns=20),)


def test_death_ends_incomplete_uses_at_every_motor():
    begun = Use("a", "m", Action.COMMAND, 1, FOREVER_NS, Answer.UNKNOWN)
    done = Use("a", "n", Action.READ, 0, 1)
    other = Use("b", "m", Action.COMMAND, 1, FOREVER_NS, Answer.UNKNOWN)
    death = Use("a", "", Action.DIE, 5, 7)
    ended = ended_by_death((done, begun, other, death))
    assert [(use.who, use.motor, use.action, use.returned_ns) for use in ended] == [
        ("a", "n", Action.READ, 1),
        ("a", "m", Action.COMMAND, 7),
        ("b", "m", Action.COMMAND, FOREVER_NS),
        ("a", "n", Action.DIE, 7),
        ("a", "m", Action.DIE, 7),
    ]


def test_overtaken_finds_earlier_queued_later_served():
    first, second = taken("a", 0, 90, 2, queued_ns=9), taken("b", 10, 20, 1, queued_ns=11)
    assert overtaken((first, second)) == [(first, second)]
    assert overtaken((taken("a", 0, 90, 2, queued_ns=10), second)) == []  # at the same instant
    assert overtaken((taken("a", 0, 5, 1, queued_ns=9), taken("b", 10, 20, 2))) == []
    assert overtaken((first, taken("b", 10, 20, 1, queued_ns=11, motor="n"))) == []
    assert overtaken((first, taken("b", 10, 20, 1, queued_ns=11, forced=True))) == []


def test_tokens_must_grow_with_every_owner():
    one, two, three = taken("a", 0, 1, 1), taken("b", 2, 3, 2), taken("a", 4, 5, 2)
    assert tokens_that_did_not_grow((one, two)) == []
    assert tokens_that_did_not_grow((one, two, three)) == [(two, three)]


def test_tokens_of_overlapping_grants_have_no_order_of_reports():
    paused = taken("a", 0, 9, 1)  # it got the motor first, and reports it after the next owner
    assert tokens_that_did_not_grow((paused, taken("b", 1, 5, 2))) == []


def test_command_without_fencing_says_nothing_of_the_tokens():
    unfenced = Use("a", "m", Action.COMMAND, 10, 11)  # executed after b got the motor
    assert tokens_that_did_not_grow((taken("a", 0, 9, 1), taken("b", 1, 5, 2), unfenced)) == []


def test_token_shrinks_between_owners_that_never_waited_for_each_other():
    one, two = taken("a", 0, 1, 2), taken("b", 2, 3, 1)
    assert tokens_that_did_not_grow((one, two)) == [(one, two)]


def test_two_grants_have_no_token_in_common():
    one, two = taken("a", 0, 9, 1), taken("b", 1, 5, 1)
    assert tokens_that_did_not_grow((one, two)) == [(two, one)]


def test_worst_gap_includes_begin_and_end():
    uses = (taken("a", 0, 3_000_000_000, 1), taken("b", 0, 4_000_000_000, 2))
    assert worst_gap_s(uses, 0, 4_500_000_000) == 3.0
    assert worst_gap_s(uses, 2_000_000_000, 9_000_000_000) == 5.0
    assert worst_gap_s((), 0, 1_000_000_000) == 1.0


def test_from_line_inverts_to_line():
    use = Use("a", "m", Action.TAKE, 1, 2, Answer.LOST, 5, 6, 7, True)
    assert from_line(to_line(use)) == use
    assert "\n" not in to_line(use)


def test_note_that_its_writer_was_killed_in_is_none_wherever_it_ends():
    before, cut, death = taken("a", 1, 2, 3), taken("b", 4, 5, 6), Use("b", "", Action.DIE, 7, 8)
    note = to_note(cut)
    for size in range(len(note)):
        written = to_note(before) + note[:size] + to_note(death)
        whole = [cut] if size == len(note) - 1 else []  # all but its newline
        assert from_notes(written.decode()) == [before, *whole, death], size
