"""Schedule of a replayed host: after what it waits for, within its patience."""

import pytest

from motorhil.harness.replay.host import HostPlayer, ReceiveQueue
from motorhil.traces.can_frame import classic
from motorhil.traces.exchange.host import ANSWER, HostStep, Listener, Told

MS = 1_000_000
PATIENCE = 2_000 * MS  # the default of `replay --patience`
ANSWERED = classic(0x585, bytes.fromhex("6040600000000000"))
BOOTED, STOPPED, OPERATIONAL = (classic(0x705, bytes([state])) for state in (0, 4, 5))


def step(start_ms, *waits, bus="can0", number=0, is_free=False):
    """Return a frame of the host that occupies its bus for 1 ms."""
    frame = classic(0x77F, b"\5") if is_free else classic(0x205, bytes([number]))
    begin = start_ms * MS
    return HostStep(begin, begin + MS, bus, frame, "a set-point", list(waits), is_free)


def answer(time_ms, bus="can0"):
    return Told(time_ms * MS, (bus, 5, ANSWER), True, "it has answered")


def state(time_ms, frame):
    """Return an observation that the recorded host heard, and now waits for."""
    listener = Listener({})
    (told,) = listener.told(time_ms * MS, "can0", listener.decode("can0", frame))
    return told


def started(*steps, now_ms=0, **options):
    player = HostPlayer(steps, Listener({}), **options)
    player.start(now_ms * MS)
    return player


def test_first_frame_keeps_recorded_delay_from_start():
    player = started(step(30), now_ms=100, begin_ns=20 * MS)
    assert player.next_deadline_ns() == 110 * MS
    assert player.take(110 * MS - 1) == []
    assert player.take(110 * MS) == [("can0", step(30).frame)]
    assert player.is_over()
    assert player.next_deadline_ns() is None


@pytest.mark.parametrize(("speed", "pause_ns"), [(1.0, 8 * MS), (2.0, 4 * MS), (0.5, 16 * MS)])
def test_frame_keeps_recorded_pause_after_live_answer(speed, pause_ns):
    player = started(step(0), step(20, answer(12)), speed=speed)
    assert len(player.take(0)) == 1
    player.heard("can0", ANSWERED, 500 * MS, False)
    assert player.next_deadline_ns() == 500 * MS + pause_ns
    assert player.take(500 * MS + pause_ns - 1) == []
    assert len(player.take(500 * MS + pause_ns)) == 1


def test_frame_without_wait_follows_end_of_previous():
    """Recorded end at 1 ms, next frame 4 ms later; the live end is at 7 ms."""
    player = started(step(0), step(5))
    player.take(0)
    player.heard("can0", step(0).frame, 7 * MS, True)
    assert player.next_deadline_ns() == 11 * MS
    assert player.pairs == [(1 * MS, 7 * MS)]


def test_anchor_is_the_later_recorded_event():
    """The answer (12 ms) followed the request (end at 1 ms), which is reported last today."""
    player = started(step(0), step(20, answer(12)))
    player.take(0)
    player.heard("can0", ANSWERED, 50 * MS, False)
    assert player.next_deadline_ns() == 58 * MS
    player.heard("can0", step(0).frame, 55 * MS, True)
    assert player.next_deadline_ns() == 58 * MS


def test_sent_frame_is_matched_by_bus():
    player = started(step(0, bus="can0"), step(0, bus="can1"))
    assert len(player.take(0)) == 2
    player.heard("can1", step(0).frame, 3 * MS, True)
    player.heard("can1", step(0).frame, 4 * MS, True)  # matches no frame
    assert player.pairs == [(1 * MS, 3 * MS)]
    player.heard("can0", step(0).frame, 5 * MS, True)
    assert player.pairs == [(1 * MS, 3 * MS), (1 * MS, 5 * MS)]


def test_missing_answer_is_missed_when_patience_ends():
    player = started(step(0), step(20, answer(12)), now_ms=5)
    player.take(5 * MS)
    over_ns = (5 + 12) * MS + PATIENCE  # recorded after 12 ms
    assert player.next_deadline_ns() == over_ns
    assert player.take(over_ns - 1) == []
    assert player.missed == []
    assert player.take(over_ns) == []
    (missed,) = player.missed
    assert (missed.time_ns, missed.awaited, missed.instead) == (
        over_ns,
        answer(12),
        "no answer",
    )
    assert missed.step.start_ns == 20 * MS
    assert player.next_deadline_ns() == over_ns + 8 * MS
    assert len(player.take(over_ns + 8 * MS)) == 1


def test_patience_applies_to_each_awaited_event():
    player = started(step(0), step(20, answer(8), answer(12)), patience_ns=100 * MS)
    player.take(10 * MS)
    player.take(110 * MS)
    assert [one.time_ns for one in player.missed] == [110 * MS]
    assert player.next_deadline_ns() == 214 * MS
    player.take(214 * MS)
    assert [one.time_ns for one in player.missed] == [110 * MS, 214 * MS]


def test_patience_begins_with_the_recording():
    player = started(step(20, state(10, BOOTED)), now_ms=60_000)
    player.take(60_000 * MS)
    assert player.missed == []
    assert player.next_deadline_ns() == 60_010 * MS + PATIENCE


@pytest.mark.parametrize(("speed", "wait_ms"), [(1.0, 60_000), (2.0, 30_000)])
def test_long_recorded_wait_is_extended_by_patience(speed, wait_ms):
    """A homing of one minute must not end in a disabled drive after two seconds."""
    player = started(step(0), step(60_001, state(60_000, OPERATIONAL)), speed=speed)
    player.take(0)
    assert player.take((wait_ms + 2_000) * MS - 1) == []
    assert player.missed == []
    player.take((wait_ms + 2_000) * MS)
    assert len(player.missed) == 1


def silent_after_three():
    """Return a player whose device has let three waits pass; the fourth request is due."""
    player = started(
        *(step(10 * place, *[answer(10 * place - 5)] * (place > 0)) for place in range(6))
    )
    for _ in range(3):
        player.take(player.next_deadline_ns())
        player.take(player.next_deadline_ns())
    return player


def test_silent_device_gets_patience_three_times():
    player = silent_after_three()
    assert len(player.missed) == 3
    sent_ns = player.next_deadline_ns()
    player.take(sent_ns)
    assert player.next_deadline_ns() == sent_ns + 5 * MS
    player.take(sent_ns + 5 * MS)
    assert player.silent == {("can0", 5, ANSWER)}


def test_device_that_answers_again_gets_patience():
    player = silent_after_three()
    sent_ns = player.next_deadline_ns()
    player.take(sent_ns)
    player.heard("can0", ANSWERED, sent_ns + 1 * MS, False)
    sent_ns = player.next_deadline_ns()
    player.take(sent_ns)
    assert player.next_deadline_ns() == sent_ns + 5 * MS + PATIENCE
    assert player.silent == set()


def test_awaited_state_is_matched_by_value():
    def waiting():
        return started(step(0, state(0, OPERATIONAL)), patience_ns=100 * MS)

    player = waiting()
    player.heard("can0", BOOTED, 10 * MS, False)
    player.heard("can0", STOPPED, 20 * MS, False)
    assert player.take(99 * MS) == []
    assert len(player.take(100 * MS)) == 1
    assert player.missed[0].instead == "last told: node 5 is stopped"
    player = waiting()
    player.take(100 * MS)
    assert player.missed[0].instead == "no report received"
    player = waiting()
    player.heard("can0", OPERATIONAL, 20 * MS, False)
    assert len(player.take(20 * MS)) == 1
    assert player.missed == []


class Never:
    """A value that equals none, and counts the comparisons."""

    compared = 0

    def __eq__(self, other):
        Never.compared += 1
        return False

    def __hash__(self):
        return hash(4)  # as that of a state


def test_reports_of_other_values_are_compared_once():
    """A wait in vain must not look at all earlier reports again, which would be quadratic."""
    awaited = [state(0, STOPPED)._replace(value=Never()) for _ in range(100)]
    player = started(*(step(0, one) for one in awaited), patience_ns=0)
    for number in range(100):
        player.heard("can0", (STOPPED, OPERATIONAL)[number % 2], 0, False)
    assert len(player.take(0)) == 100
    assert len(player.missed) == 100
    assert Never.compared <= 100


def test_two_equal_answers_are_awaited_separately():
    player = started(step(0, answer(0)), step(20, answer(12)))
    player.heard("can0", ANSWERED, 1 * MS, False)
    assert len(player.take(1 * MS)) == 1
    assert player.take(500 * MS) == []
    player.heard("can0", ANSWERED, 500 * MS, False)
    assert len(player.take(508 * MS)) == 1


def test_line_answer_is_awaited_by_unit():
    player = started(
        step(0, bus="rs485"), step(20, answer(12, "rs485"), bus="rs485"), lines=["rs485"]
    )
    player.take(3 * MS)
    assert player.pairs == [(1 * MS, 4 * MS)]
    player.answered("rs485", 6, 50 * MS)  # another unit
    assert player.take(60 * MS) == []
    player.answered("rs485", 5, 70 * MS)
    assert player.take(78 * MS - 1) == []
    assert len(player.take(78 * MS)) == 1


@pytest.mark.parametrize(
    ("speed", "due_ms"), [(1.0, [5, 105, 205, 305]), (2.0, [2.5, 52.5, 102.5])]
)
def test_heartbeat_continues_until_all_is_sent(speed, due_ms):
    beats = [step(5, is_free=True), step(105, is_free=True)]
    player = started(*beats, step(400, answer(390)), speed=speed)
    for due in due_ms:
        assert player.next_deadline_ns() == due * MS
        assert player.take(round(due * MS) - 1) == []
        assert player.take(round(due * MS)) == [("can0", beats[0].frame)]
    player.heard("can0", ANSWERED, 310 * MS, False)
    assert step(400).frame in [frame for _, frame in player.take(330 * MS)]
    assert (player.sent, player.next_deadline_ns()) == (1, None)
    assert player.take(10_000 * MS) == []


def test_single_heartbeat_is_sent_once():
    player = started(step(5, is_free=True), step(400, answer(390)))
    assert len(player.take(5 * MS)) == 1
    assert player.take(1_000 * MS) == []


def test_boot_up_before_a_reset_does_not_answer_it():
    """A drive that boots by itself boots again after the host's reset."""
    reset = HostStep(10 * MS, 11 * MS, "can0", classic(0, b"\x81\0"), "reset", [])
    player = started(reset, step(30, state(20, BOOTED)))
    player.heard("can0", BOOTED, 5 * MS, False)
    assert player.take(10 * MS) == [("can0", reset.frame)]
    assert player.take(40 * MS) == []
    player.heard("can0", BOOTED, 60 * MS, False)
    assert len(player.take(70 * MS)) == 1
    assert player.missed == []


def test_report_before_the_start_does_not_count():
    player = HostPlayer([step(0, state(0, OPERATIONAL))], Listener({}))
    player.heard("can0", BOOTED, 1 * MS, False)
    player.heard("can0", OPERATIONAL, 2 * MS, False)
    assert player.booted == {("can0", 5)}
    player.start(10 * MS)
    assert player.take(20 * MS) == []
    player.heard("can0", OPERATIONAL, 30 * MS, False)
    assert len(player.take(30 * MS)) == 1


RESET = classic(0, b"\x81\x00")
NODE_1_BOOTED = classic(0x701, b"\x00")


def test_ears_ignore_boot_up_before_own_reset():
    heard = []
    ears = ReceiveQueue(lambda *what: heard.append(what), RESET)
    told = [
        (NODE_1_BOOTED, 1, False),
        (RESET, 2, False),
        (RESET, 3, True),
        (NODE_1_BOOTED, 4, False),
    ]
    for one in told:  # a foreign reset does not count
        ears.heard(*one)
    assert heard == told[2:]


def test_ears_without_reset_hear_everything():
    heard = []
    ReceiveQueue(lambda *what: heard.append(what), None).heard(NODE_1_BOOTED, 1, False)
    assert heard == [(NODE_1_BOOTED, 1, False)]
