"""Ownership of motors reconstructed from messages alone."""

import pytest

from motorhil.harness.recording.recorder import Recorder
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import MOTOR_LOCK, LockAction
from motorhil.traces.semantics.ownership import Ended, LockEvent, ownership_of, read_ownership

SECOND = 1_000_000_000
A = LockAction


def told(time_s, action, owner="", token=0, motor="pan", **facts):
    return LockEvent(motor, round(time_s * SECOND), action, owner, token=token, **facts)


def spans(events, motor="pan"):
    """Return (owner, from [s], to [s], end) of each tenure."""
    record = ownership_of(events)
    assert record.contradictions == ()
    return [
        (
            one.owner,
            one.from_ns / SECOND,
            None if one.to_ns is None else one.to_ns / SECOND,
            one.ended,
        )
        for one in record.tenures.get(motor, ())
    ]


def test_tenure_lasts_from_taken_to_released():
    events = [
        told(1.0, A.TAKEN, "mast", 5, waited_s=0.25),
        told(2.0, A.RELEASED, "mast", 5),
        told(3.5, A.TAKEN, "drive", 6),
    ]
    assert spans(events) == [
        ("mast", 1.0, 2.0, Ended.RELEASED),
        ("drive", 3.5, None, Ended.NOT_YET),
    ]
    assert ownership_of(events).tenures["pan"][0].waited_s == 0.25


def test_owner_at_a_handover_is_exact_to_the_nanosecond():
    record = ownership_of(
        [
            told(1.0, A.TAKEN, "mast", 5),
            told(2.0, A.RELEASED, "mast", 5),
            told(2.0, A.TAKEN, "drive", 6),
            told(3.0, A.RELEASED, "drive", 6),
        ]
    )
    whose = [
        getattr(record.owner_at("pan", second * SECOND + more_ns), "owner", None)
        for second in (1, 2, 3)
        for more_ns in (-1, 0)
    ]
    assert whose == [None, "mast", "mast", "drive", "drive", None]
    assert record.owner_at("tilt", SECOND) is None


@pytest.mark.parametrize(
    ("action", "ended"), [(A.BROKEN, Ended.DIED), (A.TAKEN_OVER, Ended.TAKEN_OVER)]
)
@pytest.mark.parametrize("twice", [False, True])
def test_end_of_a_tenure_follows_from_the_next_taking(action, ended, twice):
    events = [told(1.0, A.TAKEN, "mast", 5), told(4.0, action, "drive", 6)]
    if twice:  # two messages, in either order
        events = [*events, told(4.0, A.TAKEN, "drive", 6)]
        other = [events[0], events[2], events[1]]
        assert spans(other) == spans(events)
    assert spans(events) == [("mast", 1.0, 4.0, ended), ("drive", 4.0, None, Ended.NOT_YET)]


def test_lost_tenure_ends_at_the_takeover_not_at_its_notice():
    events = [
        told(1.0, A.TAKEN, "mast", 5),
        told(2.0, A.TAKEN_OVER, "drive", 6),
        told(9.0, A.LOST, "mast", 5),
        told(9.5, A.RELEASED, "mast", 5),
    ]
    assert spans(events)[0] == ("mast", 1.0, 2.0, Ended.TAKEN_OVER)
    assert ownership_of(events).tenures["pan"][0].noticed_ns == 9 * SECOND
    assert spans(events[:1] + events[2:]) == [("mast", 1.0, 9.0, Ended.TAKEN_OVER)]


def test_crossed_messages_are_ordered_by_token():
    events = [
        told(1.0, A.TAKEN, "mast", 5),
        told(2.0, A.TAKEN, "drive", 6),
        told(2.001, A.RELEASED, "mast", 5),
        told(3.0, A.RELEASED, "drive", 6),
    ]
    assert spans(events) == [
        ("mast", 1.0, 2.0, Ended.RELEASED),
        ("drive", 2.0, 3.0, Ended.RELEASED),
    ]
    assert ownership_of(events).tenures["pan"][0].crossed_ns == 1_000_000


def test_messages_crossed_over_handovers_do_not_contradict():
    """Each of several busy programs on a hub sends in its own order."""
    events = [
        told(1.0, A.TAKEN, "mast", 5, pid=1),
        told(2.0, A.TAKEN, "arm", 7, pid=3),
        told(2.001, A.TAKEN, "drive", 6, pid=2),
        told(2.002, A.RELEASED, "drive", 6, pid=2),
        told(2.003, A.RELEASED, "mast", 5, pid=1),
        told(3.0, A.RELEASED, "arm", 7, pid=3),
    ]
    assert spans(events) == [
        ("mast", 1.0, 2.0, Ended.RELEASED),
        ("drive", 2.0, 2.0, Ended.RELEASED),
        ("arm", 2.0, 3.0, Ended.RELEASED),
    ]
    record = ownership_of(events)
    assert [one.crossed_ns for one in record.tenures["pan"]] == [3_000_000, 2_000_000, 0]
    assert record.events == tuple(events)


def test_missing_release_ends_the_tenure_as_untold():
    events = [told(1.0, A.TAKEN, "mast", 5), told(2.0, A.TAKEN, "drive", 6)]
    assert spans(events)[0] == ("mast", 1.0, 2.0, Ended.UNTOLD)


def test_tokens_of_silent_owners_are_counted():
    tokens = (5, 6, 9)
    record = ownership_of([told(float(token), A.TAKEN, "mast", token) for token in tokens])
    assert [one.skipped for one in record.tenures["pan"]] == [0, 0, 2]


def test_waiting_and_refusal_are_not_tenures():
    events = [
        told(1.0, A.TAKEN, "mast", 5),
        told(1.1, A.WAITING, "drive", holder="mast"),
        told(1.2, A.REFUSED, "arm", holder="mast"),
        told(1.3, A.TAKEN, "drive", 1, motor="tilt"),
        told(1.4, A.RELEASED, "drive", 1, motor="tilt"),
        told(1.5, A.UNKNOWN, "later version", 9),
    ]
    assert spans(events) == [("mast", 1.0, None, Ended.NOT_YET)]
    assert spans(events, "tilt") == [("drive", 1.3, 1.4, Ended.RELEASED)]
    assert ownership_of(events).events == tuple(events)


@pytest.mark.parametrize("token", [4, 5])
def test_repeated_or_decreasing_token_is_a_contradiction(token):
    events = [told(1.0, A.TAKEN, "mast", 5), told(2.0, A.TAKEN, "drive", token)]
    (line,) = ownership_of(events).contradictions
    assert line == (
        f"pan: at 2.000000 s drive has it under token {token}; mast had it under 5 already"
    )


def test_release_by_another_process_is_ignored():
    events = [told(1.0, A.TAKEN, "mast", 5, pid=1), told(2.0, A.RELEASED, "mast", 5, pid=2)]
    assert spans(events) == [("mast", 1.0, None, Ended.NOT_YET)]


def test_one_program_in_two_processes_is_two_owners():
    events = [told(1.0, A.TAKEN, "mast", 5, pid=1), told(2.0, A.TAKEN, "mast", 5, pid=2)]
    assert len(ownership_of(events).contradictions) == 1


def test_polled_tenure_starts_earlier_but_never_overlaps():
    events = [
        told(1.0, A.TAKEN, "mast", 5, held_s=0.25, looked=True),
        told(2.0, A.RELEASED, "mast", 5, looked=True),
        told(2.5, A.TAKEN, "drive", 6, held_s=0.75, looked=True),
        told(3.0, A.TAKEN, "mast", 8, held_s=0.125, looked=True),
    ]
    assert spans(events) == [
        ("mast", 0.75, 2.0, Ended.RELEASED),
        ("drive", 2.0, 2.875, Ended.UNTOLD),
        ("mast", 2.875, None, Ended.NOT_YET),
    ]


def test_motors_without_tokens_follow_message_order():
    events = [
        told(1.0, A.TAKEN, "mast"),
        told(1.0, A.RELEASED, "mast"),
        told(1.0, A.TAKEN, "drive"),
        told(2.0, A.RELEASED, "drive"),
    ]
    assert [span[0] for span in spans(events)] == ["mast", "drive"]


def test_tenure_as_text_is_a_sentence():
    record = ownership_of(
        [
            told(1.0, A.TAKEN, "mast", 5, pid=7, program="mast.py", purpose="panorama"),
            told(4.0, A.BROKEN, "drive", 6),
        ]
    )
    assert [str(tenure) for tenure in record.tenures["pan"]] == [
        "pan: 1.000 s to 4.000 s: mast (pid 7, mast.py) for panorama, which died with it",
        "pan: 4.000 s to ...: drive, which had it when the record ended",
    ]


def test_events_are_read_back_from_a_recording(tmp_path):
    path = tmp_path / "run.mcap"
    recorder = Recorder(TraceWriter(path), {})
    values = {
        "action": A.TAKEN.value,
        "owner": "mast",
        "waited_s": 0.5,
        "token": 1_795_298_400_005,
        "pid": 7,
        "program": "mast.py",
        "purpose": "panorama",
        "sender": "mast.py[7]",
    }
    recorder.message(SECOND, "/motor/pan/lock", MOTOR_LOCK, values)
    recorder.event(SECOND, "info", "mast", "not a lock")
    recorder.message(SECOND, "/motor/pan/lock", MOTOR_LOCK, {"action": 99, "token": 1})
    recorder.close()
    taken, later = read_ownership(path).events
    facts = {key: value for key, value in values.items() if key != "action"}
    assert taken == LockEvent("pan", SECOND, A.TAKEN, **facts)
    assert later == LockEvent("pan", SECOND, A.UNKNOWN, token=1)


def test_invalid_recording_raises_trace_error(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no")
    with pytest.raises(TraceError):
        read_ownership(tmp_path / "x.mcap")
