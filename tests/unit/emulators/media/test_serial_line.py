"""Times of the serial line, as fractions of a second; silences; collisions.

Source: MODBUS over Serial Line V1.02, section 2.5.1.1: t1.5 and t3.5 are multiples of the character
time up to 19,200 bit/s, fixed (750 us, 1.750 ms) above.
"""

from fractions import Fraction

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultPlan, SerialFaultRule
from motorhil.emulators.media.serial_line import CHARACTERS, FRAME, SENT, SPOILED, SerialLine

MS = 1_000_000
REQUEST = bytes.fromhex("1103006B00037687")


def line(*rules: SerialFaultRule, baud: int = 9600) -> SerialLine:
    plan = SerialFaultPlan(rules, lambda: 0.5) if rules else None
    one = SerialLine("rs485", baud, "E", 1, plan)
    one.attach("host")
    one.attach("drive")
    return one


def play(one: SerialLine, *sends: tuple[int, int, bytes]) -> list[tuple[int, int, bytes, int]]:
    """Return (time, kind, data, port) of all effects of (time, port, data), until silence."""
    told = []
    queue = sorted(sends, key=lambda send: send[0])
    while True:
        due_ns = one.next_deadline_ns()
        if queue and (due_ns is None or queue[0][0] < due_ns):
            time_ns, port, data = queue.pop(0)
            one.submit(port, data, time_ns)
        elif due_ns is None:
            return told
        else:
            told += [(due_ns, kind, data, port) for kind, data, port, _ in one.expire(due_ns)]


def of_kind(told: list[tuple[int, int, bytes, int]], *kinds: int) -> list[tuple[int, bytes]]:
    return [(time_ns, data) for time_ns, kind, data, _ in told if kind in kinds]


@pytest.mark.parametrize(
    ("baud", "parity", "stop_bits", "bits"),
    [(9600, "E", 1, 11), (19_200, "N", 1, 10), (115_200, "N", 2, 11), (115_200, "E", 2, 12)],
)
def test_characters_take_their_bits(baud, parity, stop_bits, bits):
    one = SerialLine("rs485", baud, parity, stop_bits)
    one.attach("host")
    told = play(one, (5, 0, REQUEST))
    exact_ns = Fraction(8 * bits * 10**9, baud)
    assert [kind for _, kind, _, _ in told] == [CHARACTERS, SENT, FRAME]
    assert abs(told[0][0] - 5 - exact_ns) < 1
    silence_ns = 1_750_000 if baud > 19_200 else Fraction(35 * bits * 10**9, 10 * baud)
    assert abs(told[2][0] - told[0][0] - silence_ns) <= 1


def test_silence_ends_frame():
    one = line()
    char_ns = one.duration_ns(1)
    first_end = one.duration_ns(8)
    told = play(one, (0, 0, REQUEST), (first_end + one.t35_ns, 0, REQUEST))
    assert len(of_kind(told, FRAME)) == 2
    glued = play(line(), (0, 0, REQUEST), (first_end + char_ns, 0, REQUEST))
    assert [data for _, data in of_kind(glued, FRAME)] == [REQUEST + REQUEST]


@pytest.mark.parametrize(("gap", "kind"), [(0, FRAME), (1, SPOILED)])
def test_pause_longer_than_t15_spoils_frame(gap, kind):
    one = line()
    told = play(one, (0, 0, REQUEST[:3]), (one.duration_ns(3) + one.t15_ns + gap, 0, REQUEST[3:]))
    assert [(k, data) for _, k, data, _ in told if k in (FRAME, SPOILED)] == [(kind, REQUEST)]
    assert one.spoiled == gap


def test_simultaneous_senders_are_garbled_and_reported():
    one = line()
    told = play(one, (0, 0, b"\x0f\xf0"), (one.duration_ns(1), 1, b"\x3c\x11"))
    assert one.collisions == 1
    assert of_kind(told, FRAME) == []
    assert [data for _, data in of_kind(told, SPOILED)] == [b"\x0f\x30\x11"]
    assert sorted(port for _, kind, _, port in told if kind == SENT) == [0, 1]


def test_busy_sender_queues_next_characters():
    one = line()
    told = play(one, (0, 0, b"\x01\x02"), (1, 0, b"\x03"))
    assert [data for _, data in of_kind(told, FRAME)] == [b"\x01\x02\x03"]
    assert one.collisions == 0


LOSE = SerialFaultRule("lose", SerialFaultKind.LOSE, sender="drive", limit=1)
LATE = SerialFaultRule("late", SerialFaultKind.DELAY, delay_ns=50 * MS)
BAD = SerialFaultRule("bad", SerialFaultKind.CORRUPT, flip=b"\x00\x01")
SHORT = SerialFaultRule("short", SerialFaultKind.TRUNCATE, after=3)
PAUSE = SerialFaultRule("pause", SerialFaultKind.PAUSE, after=3, delay_ns=2 * MS)
AGAIN = SerialFaultRule("again", SerialFaultKind.REPEAT, delay_ns=50 * MS)
NOISE = SerialFaultRule("noise", SerialFaultKind.NOISE, noise=b"\xff\x00")


@pytest.mark.parametrize(
    ("rule", "frames"),
    [
        (LATE, [(50 * MS, FRAME, REQUEST)]),
        (BAD, [(0, FRAME, bytes.fromhex("1102006B00037687"))]),
        (SHORT, [(0, FRAME, REQUEST[:3])]),
        (PAUSE, [(0, SPOILED, REQUEST)]),
        (AGAIN, [(0, FRAME, REQUEST), (50 * MS, FRAME, REQUEST)]),
        (NOISE, [(0, FRAME, b"\xff\x00" + REQUEST)]),
    ],
    ids=lambda value: value.name if isinstance(value, SerialFaultRule) else "",
)
def test_fault_changes_frame_as_specified(rule, frames):
    one = line(rule)
    plan = SerialFaultPlan((), lambda: 0.5)
    assert plan.fired() == {}
    told = [entry for entry in play(one, (0, 1, REQUEST)) if entry[1] in (FRAME, SPOILED)]
    assert [(kind, data) for _, kind, data, _ in told] == [(k, data) for _, k, data in frames]
    for (time_ns, _, data, _), (begins_ns, _, _) in zip(told, frames, strict=True):
        pause_ns = 2 * MS if rule is PAUSE else 0
        assert time_ns == begins_ns + one.duration_ns(len(data)) + pause_ns + one.t35_ns


def test_lost_frame_is_sent_but_not_heard():
    one = line(LOSE)
    told = play(one, (0, 1, REQUEST), (100 * MS, 1, REQUEST), (200 * MS, 0, REQUEST))
    assert next(time_ns for time_ns, kind, _, _ in told if kind == SENT) == one.duration_ns(8)
    assert [port for _, kind, _, port in told if kind == FRAME] == [1, 0]


def test_delayed_frame_does_not_delay_later_ones():
    one = line(SerialFaultRule("late", SerialFaultKind.DELAY, delay_ns=50 * MS, limit=1))
    told = of_kind(play(one, (0, 1, b"\x01\x02"), (20 * MS, 1, b"\x03\x04")), FRAME)
    assert [data for _, data in told] == [b"\x03\x04", b"\x01\x02"]


SENDS = st.lists(
    st.tuples(st.integers(0, 40 * MS), st.integers(0, 1), st.binary(min_size=1, max_size=6)),
    max_size=6,
)


@given(SENDS, st.sampled_from([9600, 115_200]))
def test_characters_are_causal_and_end_in_frames(sends, baud):
    one = line(baud=baud)
    told = play(one, *sends)
    times = [time_ns for time_ns, _, _, _ in told]
    assert times == sorted(times)
    heard = b"".join(data for _, data in of_kind(told, CHARACTERS))
    frames = b"".join(data for _, data in of_kind(told, FRAME, SPOILED))
    assert heard == frames
    if one.collisions:
        event("collision")
        assert of_kind(told, SPOILED)
    elif sends:
        event("in turns")
        assert sorted(heard) == sorted(b"".join(data for _, _, data in sends))
    assert one.next_deadline_ns() is None


@pytest.mark.parametrize(
    "facts",
    [
        {"probability": 2.0},
        {"from_ns": 5, "until_ns": 5},
        {"limit": 0},
        {"delay_ns": 5},
        {"kind": SerialFaultKind.DELAY},
        {"kind": SerialFaultKind.TRUNCATE},
        {"flip": b"\x01"},
        {"kind": SerialFaultKind.NOISE},
    ],
)
def test_invalid_rule_is_refused_by_name(facts):
    with pytest.raises(ValueError, match="fault odd"):
        SerialFaultRule(**{"name": "odd", "kind": SerialFaultKind.LOSE, **facts})


@pytest.mark.parametrize(
    ("baud", "parity", "stop_bits"), [(0, "E", 1), (9600, "M", 1), (9600, "E", 3)]
)
def test_invalid_line_is_refused(baud, parity, stop_bits):
    with pytest.raises(ValueError, match="serial line rs485: "):
        SerialLine("rs485", baud, parity, stop_bits)


# ---- without silences: protocols that delimit their packets themselves ----


def test_line_without_silences_delivers_characters_only():
    one = SerialLine("ttl", 1_000_000, "N", 1, silences=False)
    left, right = one.attach("left"), one.attach("right")
    one.submit(left, b"abc", 0)
    one.submit(right, b"de", 5_000_000)
    assert one.expire(10_000_000_000) == [
        (CHARACTERS, b"abc", left, 0),
        (SENT, b"", left, 30_000),
        (CHARACTERS, b"de", right, 5_000_000),
        (SENT, b"", right, 5_020_000),
    ]
    assert (one.t15_ns, one.t35_ns, one.frames) == (0, 0, 0)
    assert one.next_deadline_ns() is None


def test_bursts_without_a_pause_stay_apart_by_sender():
    one = SerialLine("ttl", 1_000_000, "N", 1, silences=False)
    left, right = one.attach("left"), one.attach("right")
    one.submit(left, b"abc", 0)
    one.submit(right, b"de", 30_000)
    heard = [data for kind, data, _, _ in one.expire(1_000_000) if kind == CHARACTERS]
    assert heard == [b"abc", b"de"]
    assert one.collisions == 0
