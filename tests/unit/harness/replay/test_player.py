"""Exchange log players with hosts that deviate from the recorded one, by hand and at random."""

from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.harness.replay.player import LOOK_AHEAD, ExchangePlayer
from motorhil.traces.exchange.steps import START, ExchangeLog, Role, Sent, Step, Turn, period_ns

MS = 1_000_000


def command(number, *reactions):
    """Return a write of `number` to its own object; reactions are (delay, frame)."""
    return Step(
        Role.COMMAND,
        ("sdo", number, bytes([number & 0xFF])),
        number * MS,
        f"write {number}",
        turns=[Turn(b"w", [Sent(MS, b"ok%d" % number)])],
        reactions=[Sent(delay, frame) for delay, frame in reactions],
    )


def poll(number, answer):
    return Step(
        Role.POLL,
        ("read", number, b""),
        0,
        f"read {number}",
        turns=[Turn(b"r", [Sent(MS, answer)])],
    )


def log(*steps, periods_ns=None):
    first = Step(Role.COMMAND, START, 0, "")
    return ExchangeLog("can0", 1, [first, *steps], periods_ns or {})


def played(*steps, periods_ns=None):
    player = ExchangePlayer(log(*steps, periods_ns=periods_ns))
    player.start(0)
    return player


def key(number):
    return ("sdo", number, bytes([number & 0xFF]))


def answers(step):
    return None if step is None else [sent.data for turn in step.turns for sent in turn.answers]


def test_reactions_keep_their_delay_after_the_command():
    player = played(command(1, (5 * MS, b"a"), (9 * MS, b"b")))
    player.command(key(1), 100 * MS)
    assert player.next_deadline_ns() == 105 * MS
    assert player.take(105 * MS - 1) == []
    assert player.take(105 * MS) == [b"a"]
    assert player.next_deadline_ns() == 109 * MS
    assert player.take(200 * MS) == [b"b"]
    assert player.next_deadline_ns() is None


def test_next_command_cuts_short_pending_reactions():
    """The last frame of each identifier is sent, in their order."""
    a1, a2, b1 = b"\x81\1\0\0one", b"\x81\1\0\0two", b"\x01\7\0\0up"
    player = played(command(1, (5 * MS, a1), (6 * MS, b1), (7 * MS, a2)), command(2))
    player.command(key(1), 0)
    player.command(key(2), MS)
    assert player.take(MS) == [b1, a2]


def test_polls_are_answered_in_order_and_last_one_repeats():
    player = played(command(1), poll(7, b"not yet"), poll(7, b"done"), command(2), poll(7, b"off"))
    player.command(key(1), 0)
    read = ("read", 7, b"")
    assert [answers(player.poll(read, 0))[0] for _ in range(4)] == [
        b"not yet",
        b"done",
        b"done",
        b"done",
    ]
    player.command(key(2), MS)
    assert answers(player.poll(read, 0)) == [b"off"]


def test_drive_is_silent_exactly_as_long_as_recorded():
    """The recorded host polls before boot-up; a later host finds the drive present."""
    read = ("read", 7, b"")
    silent, there = poll(7, b""), poll(7, b"here")
    silent.turns[0].answers.clear()
    there.time_ns = 300 * MS
    player = played(silent, there)
    assert answers(player.poll(read, 299 * MS)) == []
    player = played(silent, there)
    assert answers(player.poll(read, 300 * MS)) == [b"here"]
    recorded = log(silent, there)
    recorded.steps[0].reactions.append(Sent(200 * MS, b"\1\7\0\0boot"))
    for now_ns, expected in ((200 * MS - 1, []), (200 * MS, [b"here"])):
        player = ExchangePlayer(recorded)
        player.start(0)
        assert answers(player.poll(read, now_ns)) == expected


def test_poll_of_another_epoch_needs_constant_answer():
    player = played(
        poll(7, b"a"), poll(8, b"same"), command(1), poll(7, b"b"), poll(8, b"same"), command(2)
    )
    player.command(key(1), 0)
    player.command(key(2), 0)
    assert player.poll(("read", 7, b""), 0) is None
    assert answers(player.poll(("read", 8, b""), 0)) == [b"same"]
    assert player.poll(("read", 9, b""), 0) is None


def test_repeated_command_is_answered_without_reactions():
    player = played(command(1, (MS, b"moves")), command(2), command(1, (MS, b"moves again")))
    assert player.command(key(1), 0) is not None
    player.take(10 * MS)
    assert answers(player.command(key(1), 20 * MS)) == [b"ok1"]
    assert player.repeated == 1
    assert player.next_deadline_ns() is None  # the second motion belongs to another command
    player.command(key(2), 30 * MS)
    player.command(key(1), 40 * MS)
    assert player.take(50 * MS) == [b"moves again"]


def test_skipped_command_may_come_later():
    player = played(command(1), command(2), command(3))
    for number in (1, 3, 2):
        assert player.command(key(number), 0) is not None
    assert player.never_came() == []


def test_command_beyond_look_ahead_is_not_found():
    steps = [command(1 + number) for number in range(LOOK_AHEAD + 1)]
    last = steps[-1]
    assert played(*steps).command(last.key, 0) is None
    assert played(*steps[1:]).command(last.key, 0) is not None


def test_refuse_expects_same_object_then_next_command():
    player = played(command(1), command(2))
    assert player.refuse(("sdo", 2, b"\xff"), "write 2 = ff", 5).expected.text == "write 2"
    assert player.refuse(("sdo", 9, b"\xff"), "write 9", 5).expected.text == "write 1"
    player.command(key(1), 0)
    player.command(key(2), 0)
    assert player.refuse(("sdo", 9, b"\xff"), "write 9", 5).expected is None


def test_periodic_frame_continues_but_single_one_does_not():
    beat, boot = b"\x01\7\0\0\5", b"\x02\7\0\0\0"
    first = command(1, (10 * MS, boot))
    first.reactions += [Sent(n * 100 * MS, beat, goes_on=True) for n in range(1, 4)]
    player = played(first, periods_ns={0x701: 100 * MS, 0x702: 100 * MS})
    player.command(key(1), 0)
    out = player.take(1_000 * MS)
    assert out[0] == boot
    # Three recorded frames; the next one half a period late, then one every period.
    assert out[1:] == [beat] * (3 + 6)
    assert player.next_deadline_ns() == 1_050 * MS


def test_period_ns_is_the_majority_interval():
    assert period_ns([0, 100, 201, 299, 400, 500]) == 100
    assert period_ns([0, 100, 200]) is None  # too few samples
    assert period_ns([0, 100, 130, 500, 900, 901]) is None
    assert period_ns([5] * 9) is None


def test_command_skipped_twice_means_the_later_step():
    again = command(1, (MS, b"again"))
    player = played(command(1, (MS, b"first")), again, command(3))
    player.command(key(3), 0)
    assert player.command(key(1), 10 * MS) is again


def test_repeated_unanswered_command_is_not_a_repetition():
    player = played(command(1))
    assert player.command(key(7), 0) is None
    assert player.command(key(7), 0) is None
    assert (player.matched, player.repeated) == (0, 0)


def test_drive_that_never_answered_stays_silent():
    silent = poll(7, b"")
    silent.turns[0].answers.clear()
    assert answers(played(silent).poll(("read", 7, b""), 10_000 * MS)) == []


def test_poll_answer_of_previous_epoch_is_not_reused():
    player = played(poll(7, b"a"), command(1), poll(8, b"x"), command(2), poll(7, b"b"))
    read = ("read", 7, b"")
    assert answers(player.poll(read, 0)) == [b"a"]
    player.command(key(1), MS)
    assert player.poll(read, MS) is None


def test_answer_precedes_reaction_due_at_same_time():
    player = played(command(1, (MS, b"by itself")))
    step = player.command(key(1), 0)
    player.answer(step.turns[0].answers, 0)
    assert player.take(MS) == [b"ok1", b"by itself"]


def test_last_eight_answers_with_text_are_kept():
    steps = [poll(number, b"x") for number in range(10)]
    for number, step in enumerate(steps):
        step.answer_text = f"answer {number}"
    silent, written = poll(100, b"x"), command(1)
    player = played(*steps, silent, written)
    for number in range(10):
        player.poll(("read", number, b""), 0)
    for _ in range(9):
        player.poll(silent.key, 0)
    player.command(written.key, 0)
    assert player.answered_last() == tuple(f"answer {number}" for number in range(2, 10))


def test_periodic_frame_continues_after_cut_short():
    """Half a period late, as after the last recorded one."""
    beat = b"\x01\7\0\0\5"
    first = command(1)
    first.reactions += [Sent(n * 100 * MS, beat, goes_on=True) for n in range(1, 4)]
    player = played(first, command(2), periods_ns={0x701: 100 * MS})
    player.command(key(1), 0)
    player.command(key(2), 50 * MS)
    assert player.take(50 * MS) == [beat]
    assert player.next_deadline_ns() == 200 * MS


HOSTS = st.lists(st.tuples(st.sampled_from("NRPS"), st.integers(0, 30)), max_size=40)


@given(st.integers(1, 25), HOSTS)
def test_any_host_finds_each_command_once(count, host):
    """N: the next command, R: any, P: a poll, S: time passes."""
    steps = []
    for number in range(1, count + 1):
        steps.append(command(number, (3 * MS, b"\x81\1\0\0%d" % number)))
        steps.append(poll(100, b"%d" % number))
    player = played(*steps)
    now_ns, following, found = 0, 1, []
    for what, number in host:
        if what == "S":
            now_ns += number * MS
            player.take(now_ns)
        elif what == "P":
            player.poll(("read", 100, b""), now_ns)
        else:
            wanted = following if what == "N" else number
            matched = player.matched
            step = player.command(key(wanted), now_ns)
            if step is None:
                assert not 1 <= wanted <= count
            else:
                assert step.key == key(wanted)
            if player.matched > matched:
                found.append(wanted)
                following = max(found) + 1
        due_ns = player.next_deadline_ns()
        assert due_ns is None or due_ns >= now_ns - 30 * MS
    assert len(found) == len(set(found)) == player.matched
    never = sorted(set(range(1, count + 1)) - set(found))
    assert never == [one.key[1] for one in player.never_came()]
    event(f"found {min(len(found), 5)}{'+' if len(found) > 5 else ''}")


@given(st.integers(1, 25))
def test_recorded_host_finds_every_command(count):
    steps = [command(number) for number in range(1, count + 1)]
    player = played(*steps)
    for number in range(1, count + 1):
        assert player.is_next(key(number))
        assert player.command(key(number), number) is steps[number - 1]
    assert (player.matched, player.never_came()) == (count, [])
