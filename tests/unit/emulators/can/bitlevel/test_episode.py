"""Episodes of several stations, compared with the standard."""

from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.can.bitlevel.episode import (
    Disturbance,
    Effect,
    Episode,
    EventKind,
    Station,
    run_episode,
)
from motorhil.emulators.can.frame import pack
from tests.support.can import frame_bits as wire

FRAME = wire.Fields(0x123, False, False, 2, b"\x55\xaa")
BITS = wire.on_the_wire(FRAME)
SENDER = Station(0, (FRAME.can_frame(),))


def told(episode: Episode, *kinds: EventKind) -> list[tuple[int, int, EventKind]]:
    """Return (bit, port, kind) of the events of these kinds."""
    return [(event.bit, event.port, event.kind) for event in episode.events if event.kind in kinds]


def counters(episode: Episode) -> list[tuple[int, int]]:
    return [(outcome.tec, outcome.rec) for outcome in episode.outcomes]


@given(wire.fields(), st.integers(1, 9), st.integers(0, 200))
def test_undisturbed_frame_is_exact_and_accepted_by_all(frame, others, rec):
    receivers = [Station(port, rec=rec) for port in range(1, others + 1)]
    episode = run_episode([Station(0, (frame.can_frame(),), tec=1), *receivers])
    last = len(wire.on_the_wire(frame)) - 1
    assert episode.bits == last + 1 + wire.INTERMISSION
    assert told(episode, EventKind.ACCEPTED, EventKind.SENT) == [
        *[(last - 1, port, EventKind.ACCEPTED) for port in range(1, others + 1)],
        (last, 0, EventKind.SENT),
    ]
    assert {event.frame for event in episode.events if event.kind is not EventKind.STATE} == {
        frame.can_frame()
    }
    received = 127 if rec > 127 else max(rec - 1, 0)
    assert counters(episode) == [(0, 0)] + [(0, received)] * others
    # ACK delimiter, end of frame, intermission
    assert (episode.recessive_runs, episode.recessive_bits) == (1, 0)


def test_lone_node_repeats_for_ever_and_stays_passive():
    station = SENDER
    for attempt in range(40):
        episode = run_episode([station])
        ack_slot = len(BITS) - 9
        (error,) = told(episode, EventKind.ERROR)
        assert error == (ack_slot, 0, EventKind.ERROR)
        (outcome,) = episode.outcomes
        assert outcome.tec == min(8 * (attempt + 1), 128)
        assert outcome.frames == station.frames
        assert outcome.suspended == (8 if outcome.tec == 128 else 0)
        assert episode.bits == ack_slot + 1 + 6 + 8 + 3
        station = Station(0, outcome.frames, tec=outcome.tec)


def test_error_seen_by_all_costs_flag_delimiter_intermission():
    episode = run_episode([SENDER, Station(1), Station(2)], [Disturbance(30)])
    first = min(bit for bit, _, _ in told(episode, EventKind.ERROR))
    assert first == 30  # at least a bit error at the sender
    assert 30 + 1 + 6 + 8 + 3 <= episode.bits <= 30 + 1 + 6 + 6 + 8 + 3
    assert not told(episode, EventKind.SENT, EventKind.ACCEPTED)
    assert counters(episode)[0] == (8, 0)


def test_receiver_error_in_last_but_one_bit_duplicates_frame():
    last = len(BITS) - 1
    stations = [SENDER, Station(1), Station(2)]
    episode = run_episode(stations, [Disturbance(last - 1, ports=0b010)])
    assert told(episode, EventKind.ACCEPTED, EventKind.SENT, EventKind.FAILED) == [
        (last - 1, 2, EventKind.ACCEPTED),
        (last, 0, EventKind.FAILED),
    ]
    again = run_episode([Station(0, episode.outcomes[0].frames), Station(1), Station(2)])
    assert [port for _, port, _ in told(again, EventKind.ACCEPTED)] == [1, 2]


def test_short_to_dominant_stalls_nodes_that_are_not_bus_off():
    short = [Disturbance(20, Effect.DOMINANT, None)]
    episode = run_episode([SENDER, Station(1)], short)
    assert [outcome.off_at is not None for outcome in episode.outcomes] == [True, False]
    assert episode.outcomes[1].stalled
    after = run_episode([Station(1, rec=episode.outcomes[1].rec, stalled=True)])
    assert after.bits == 8 + 3


def test_same_identifier_with_different_data_collides():
    rival = Station(1, (pack(0x123, b"\x55\xab"),))
    episode = run_episode([SENDER, rival, Station(2)])
    assert not told(episode, EventKind.SENT, EventKind.ACCEPTED, EventKind.LOST)
    assert [port for _, port, _ in told(episode, EventKind.FAILED)] == [1, 0]
    assert [tec for tec, _ in counters(episode)] == [8, 8, 0]


def test_equal_frames_of_two_senders_are_sent_as_one():
    episode = run_episode([SENDER, Station(1, SENDER.frames), Station(2)])
    assert told(episode, EventKind.SENT, EventKind.ACCEPTED) == [
        (len(BITS) - 2, 2, EventKind.ACCEPTED),
        (len(BITS) - 1, 0, EventKind.SENT),
        (len(BITS) - 1, 1, EventKind.SENT),
    ]
    assert episode.bits == len(BITS) + 3


def test_short_of_ten_seconds_costs_as_little_as_brief_one():
    ten_million = [Disturbance(0, Effect.DOMINANT, 10_000_000)]
    episode = run_episode([Station(0), Station(1, rec=3), Station(2, integrating=11)], ten_million)
    assert episode.bits == 10_000_000 + 8 + 3
    assert counters(episode) == [(0, 255), (0, 255), (0, 0)]
    assert not any(outcome.stalled for outcome in episode.outcomes)
    assert (episode.recessive_runs, episode.recessive_bits) == (1, 0)


def test_stalled_receiver_does_not_block_others():
    stations = [Station(0, SENDER.frames, one_shot=True), Station(1), Station(2)]
    deaf = Disturbance(0, Effect.DOMINANT, None, 0b100)
    first = run_episode(stations, [deaf])
    assert not told(first, EventKind.SENT)  # its active error flags destroy the frame
    rec = first.outcomes[2].rec
    assert rec > 128
    again = run_episode([SENDER, Station(1), Station(2, rec=rec, stalled=True)], [deaf])
    assert [port for _, port, _ in told(again, EventKind.SENT, EventKind.ACCEPTED)] == [1, 0]
    assert again.bits == len(BITS) + 3


def test_deaf_receiver_is_not_waited_for():
    brief = 20_000
    both = [Disturbance(0, Effect.DOMINANT, brief, port) for port in (0b01, 0b10)]
    episode = run_episode([Station(0), Station(1)], both)
    assert episode.bits < 1000
    assert [outcome.stalled for outcome in episode.outcomes] == [True, True]
    short = Disturbance(0, Effect.DOMINANT, brief)
    numb = Disturbance(0, Effect.RECESSIVE, brief, 0b01)
    episode = run_episode([Station(0), Station(1)], [short, numb])
    assert episode.bits < 1000
    assert [outcome.stalled for outcome in episode.outcomes] == [False, True]


def test_stalled_node_is_simulated_separately():
    stations = [Station(1, rec=255), Station(0, rec=255, stalled=True)]
    assert run_episode(stations).bits == 8 + 3


def test_32nd_consecutive_failure_is_bus_off():
    station = SENDER
    for failure in range(1, 33):
        episode = run_episode([station, Station(1)], [Disturbance(25, Effect.FLIP, 1, 0b01)])
        outcome = episode.outcomes[0]
        assert outcome.tec == 8 * failure
        assert (outcome.off_at == 25) is (failure == 32)
        station = Station(0, outcome.frames, tec=min(outcome.tec, 255))
    assert episode.outcomes[0].recessive_runs == 1  # the delimiter, the intermission


def test_short_to_recessive_makes_only_senders_bus_off():
    station = SENDER
    short = [Disturbance(0, Effect.RECESSIVE, None)]
    attempts = 0
    while True:
        episode = run_episode([station, Station(1)], short)
        attempts += 1
        assert counters(episode)[1] == (0, 0)  # it hears nothing
        if episode.outcomes[0].off_at is not None:
            break
        station = Station(0, SENDER.frames, tec=episode.outcomes[0].tec)
    # The first start of frame and its flag, restarted at each bit, make it passive. Each further
    # start of frame counts eight.
    assert attempts == 1 + 15


def test_equal_and_unequal_stations_give_same_result():
    equal = run_episode([SENDER, *[Station(port) for port in range(1, 10)]], [Disturbance(40)])
    unequal = run_episode(
        [SENDER, *[Station(port, rec=port) for port in range(1, 10)]], [Disturbance(40)]
    )
    assert told(equal, *EventKind) == told(unequal, *EventKind)
    assert [rec - port for port, (_, rec) in enumerate(counters(unequal))] == [
        rec for _, rec in counters(equal)
    ]
