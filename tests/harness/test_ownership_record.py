"""Who had a motor when, told from messages alone."""

import pytest

from harness.ownership_record import Ended, LockEvent, ownership_of, read_ownership
from harness.recorder import Recorder
from traces.errors import TraceError
from traces.schema import MOTOR_LOCK, LockAction
from traces.writer import TraceWriter

SECOND = 1_000_000_000
A = LockAction


def told(time_s, action, owner="", token=0, motor="pan", **facts):
    return LockEvent(motor, round(time_s * SECOND), action, owner, token=token, **facts)


def spans(events, motor="pan"):
    """(owner, from [s], to [s], how it ended) of each tenure."""
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


def test_a_tenure_lasts_from_taking_to_giving_back():
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


def test_whose_the_motor_is_at_a_handover_is_told_to_the_nanosecond():
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
def test_how_the_one_before_ended_is_told_by_the_next_one(action, ended, twice):
    events = [told(1.0, A.TAKEN, "mast", 5), told(4.0, action, "drive", 6)]
    if twice:  # in whichever order it is told in two messages
        events = [*events, told(4.0, A.TAKEN, "drive", 6)]
        other = [events[0], events[2], events[1]]
        assert spans(other) == spans(events)
    assert spans(events) == [("mast", 1.0, 4.0, ended), ("drive", 4.0, None, Ended.NOT_YET)]


def test_one_who_lost_it_had_it_until_the_next_one_took_it_however_late_he_noticed():
    events = [
        told(1.0, A.TAKEN, "mast", 5),
        told(2.0, A.TAKEN_OVER, "drive", 6),
        told(9.0, A.LOST, "mast", 5),
        told(9.5, A.RELEASED, "mast", 5),
    ]
    assert spans(events)[0] == ("mast", 1.0, 2.0, Ended.TAKEN_OVER)
    assert ownership_of(events).tenures["pan"][0].noticed_ns == 9 * SECOND
    assert spans(events[:1] + events[2:]) == [("mast", 1.0, 9.0, Ended.TAKEN_OVER)]


def test_messages_that_crossed_are_put_in_order_by_their_tokens():
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


def test_messages_that_crossed_by_several_handovers_are_no_contradiction():
    """As heard on a hub with five busy programs: each of them tells in its own order."""
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


def test_one_who_never_told_that_he_gave_it_back_is_told_apart():
    events = [told(1.0, A.TAKEN, "mast", 5), told(2.0, A.TAKEN, "drive", 6)]
    assert spans(events)[0] == ("mast", 1.0, 2.0, Ended.UNTOLD)


def test_tokens_of_owners_who_told_nothing_are_counted():
    tokens = (5, 6, 9)
    record = ownership_of([told(float(token), A.TAKEN, "mast", token) for token in tokens])
    assert [one.skipped for one in record.tenures["pan"]] == [0, 0, 2]


def test_waiting_and_being_refused_are_no_tenures_and_motors_are_kept_apart():
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
def test_two_owners_under_one_token_or_a_token_that_falls_contradict(token):
    events = [told(1.0, A.TAKEN, "mast", 5), told(2.0, A.TAKEN, "drive", token)]
    (line,) = ownership_of(events).contradictions
    assert line == (
        f"pan: at 2.000000 s drive has it under token {token}; mast had it under 5 already"
    )


def test_nobody_gives_back_what_another_process_has():
    events = [told(1.0, A.TAKEN, "mast", 5, pid=1), told(2.0, A.RELEASED, "mast", 5, pid=2)]
    assert spans(events) == [("mast", 1.0, None, Ended.NOT_YET)]


def test_one_program_of_two_processes_is_two_owners():
    events = [told(1.0, A.TAKEN, "mast", 5, pid=1), told(2.0, A.TAKEN, "mast", 5, pid=2)]
    assert len(ownership_of(events).contradictions) == 1


def test_what_was_seen_from_outside_began_earlier_but_not_before_what_was_seen_before():
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


def test_motors_without_tokens_are_had_in_the_order_told():
    events = [
        told(1.0, A.TAKEN, "mast"),
        told(1.0, A.RELEASED, "mast"),
        told(1.0, A.TAKEN, "drive"),
        told(2.0, A.RELEASED, "drive"),
    ]
    assert [span[0] for span in spans(events)] == ["mast", "drive"]


def test_a_tenure_reads_as_a_sentence():
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


def test_all_of_it_is_read_back_from_a_recording(tmp_path):
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


def test_what_is_no_recording_is_told(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"no")
    with pytest.raises(TraceError):
        read_ownership(tmp_path / "x.mcap")
