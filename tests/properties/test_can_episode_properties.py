"""Properties of every episode under random disturbances."""

from dataclasses import replace

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.bitlevel.controller import CanStation
from motorhil.emulators.can.bitlevel.episode import (
    Disturbance,
    Effect,
    EventKind,
    Station,
    run_episode,
)
from motorhil.emulators.can.error_confinement import Confinement
from tests.support.can import frame_bits as wire

SHORT = wire.Fields(0x0F0, False, False, 1, b"\x00")
RIVALS = [
    SHORT,
    wire.Fields(0x0F0, False, False, 1, b"\x01"),
    wire.Fields(0x7FF, True, True, 0, b""),
]
COUNTERS = st.sampled_from([0, 0, 0, 1, 95, 96, 119, 120, 127, 128, 200, 247, 248, 255])
LAST = len(wire.on_the_wire(SHORT)) - 1


@st.composite
def disturbances(draw: st.DrawFn, ports: int) -> Disturbance:
    """Draw disturbances in and after a frame, of some bits, on the wire or at some ports."""
    mask = draw(st.sampled_from([-1, *range(1, 1 << ports)]))
    first = draw(st.integers(0, LAST + 30))
    return Disturbance(
        first, draw(st.sampled_from(Effect)), draw(st.sampled_from([1, 1, 1, 2, 6, 14, 20])), mask
    )


@st.composite
def cases(draw: st.DrawFn) -> tuple[list[Station], list[Disturbance]]:
    count = draw(st.integers(1, 4))
    stations = [
        Station(
            port,
            tuple(
                frame.can_frame()
                for frame in draw(st.lists(st.sampled_from(RIVALS), min_size=not port, max_size=2))
            ),
            draw(COUNTERS),
            draw(COUNTERS),
            one_shot=draw(st.booleans()),
            leaves_at=draw(st.sampled_from([None, None, None, 30, 73, 90])),
            suspended=draw(st.sampled_from([0, 0, 0, 0, 3])),
            integrating=draw(st.sampled_from([0, 0, 0, 0, 11])),
        )
        for port in range(count)
    ]
    return stations, draw(st.lists(disturbances(count), max_size=3))


def legal(before: tuple[int, int], after: tuple[int, int]) -> bool:
    """Return whether at most one rule leads from these counters to those."""
    tec, rec = before
    received = min(127, max(rec - 1, 0))
    return after in [
        before,
        (tec, min(255, rec + 1)),  # a
        (tec, min(255, rec + 8)),  # b, e, f
        (tec + 8, rec),  # c, d, f
        (max(tec - 1, 0), rec),  # g
        (tec, received),  # h
    ]


def level_for(level: int, bit: int, port: int, struck: list[Disturbance]) -> int:
    for one in struck:
        if one.ports >> port & 1 and one.bits and one.first <= bit < one.first + one.bits:
            level = {Effect.FLIP: 1 - level, Effect.DOMINANT: 0, Effect.RECESSIVE: 1}[one.effect]
    return level


def one_by_one(
    stations: list[Station], struck: list[Disturbance], bits: int
) -> list[tuple[int, int, int, bytes]]:
    """Return (bit, port, kind, frame) of all events, with a separate controller per station."""
    nodes = [
        CanStation(list(one.frames), Confinement(one.tec, one.rec), one.one_shot)
        for one in stations
    ]
    for one, node in zip(stations, nodes, strict=True):
        if one.integrating:
            node.begin_integrating(one.integrating)
        else:
            node.begin_idle(one.suspended)
    for bit in range(bits):
        there = [
            (one.port, node)
            for one, node in zip(stations, nodes, strict=True)
            if one.leaves_at is None or bit < one.leaves_at
        ]
        level = min((node.drives for _, node in there), default=1)
        for port, node in there:
            before = (node.confinement.tec, node.confinement.rec)
            node.hear(level_for(level, bit, port, struck), bit)
            assert legal(before, (node.confinement.tec, node.confinement.rec))
    notes = [
        (bit, one.port, kind, frame)
        for one, node in zip(stations, nodes, strict=True)
        for bit, kind, frame in node.journal.notes
    ]
    return sorted(notes, key=lambda note: note[:2])


@given(cases())
def test_counters_change_by_one_rule_at_a_time(case):
    stations, struck = case
    episode = run_episode(stations, struck)
    expected = one_by_one(stations, struck, episode.bits)
    assert [(e.bit, e.port, e.kind.value, e.frame) for e in episode.events] == expected
    for outcome in episode.outcomes:
        assert (outcome.off_at is not None) is (outcome.tec > 255)
        assert 0 <= outcome.tec <= 263
        assert 0 <= outcome.rec <= 255
        assert (
            not outcome.stalled
            or outcome.rec == 255
            or stations[outcome.port].leaves_at is not None
        )
        event("bus-off" if outcome.off_at is not None else "on")
        event("stalled" if outcome.stalled else "not stalled")
    for kind in {e.kind for e in episode.events}:
        event(kind.name)


@given(cases(), st.integers(0, 120), st.data())
def test_later_disturbance_does_not_change_the_past(case, now, data):
    stations, struck = case
    struck = [one for one in struck if one.first < now]
    more = [
        replace(one, first=one.first + now)
        for one in data.draw(st.lists(disturbances(len(stations)), max_size=2))
    ]
    leaver = data.draw(st.integers(0, len(stations) - 1))
    stations[leaver] = replace(stations[leaver], leaves_at=None)
    others = list(stations)
    others[leaver] = replace(stations[leaver], leaves_at=now + data.draw(st.integers(0, 9)))
    until = min(now, run_episode(stations, struck).bits)
    before = [e for e in run_episode(stations, struck).events if e.bit < until]
    after = [e for e in run_episode(others, struck + more).events if e.bit < until]
    assert before == after
    event("something" if before else "nothing")


@given(
    st.integers(0, LAST + 3) | st.integers(LAST - 2, LAST + 3),
    st.integers(1, 0b111),
    st.integers(0, 119),
)
def test_flip_at_receivers_is_consistent_except_last_but_one(bit, who, rec):
    """All nodes refuse the frame, and it is sent again; or all accept it."""
    stations = [Station(0, (SHORT.can_frame(),)), *[Station(p, rec=rec) for p in (1, 2, 3)]]
    episode = run_episode(stations, [Disturbance(bit, ports=who << 1)])
    got = [e.port for e in episode.events if e.kind is EventKind.ACCEPTED]
    sent = [e for e in episode.events if e.kind is EventKind.SENT]
    noticed = {e.port for e in episode.events if e.kind is EventKind.ERROR}
    if bit < LAST - 1:
        assert (got, sent) == ([], [])
        assert noticed == {0, 1, 2, 3}
        event("nobody's")
    elif bit == LAST - 1:
        assert got == [port for port in (1, 2, 3) if not who >> port - 1 & 1]
        assert sent == []  # it will be sent again: some hear it twice
        event("inconsistent" if got else "nobody's")
    else:
        assert got == [1, 2, 3]
        assert len(sent) == 1
        event("everybody's")
    failed = [e for e in episode.events if e.kind is EventKind.FAILED]
    assert len(sent) + len(failed) == 1
    assert episode.outcomes[0].frames == (() if sent else stations[0].frames)


def test_sender_dying_before_repetition_causes_omission():
    """Rufino et al.: the last but one bit, and then a crash; no node detects it."""
    stations = [Station(0, (SHORT.can_frame(),), leaves_at=LAST + 1), Station(1), Station(2)]
    episode = run_episode(stations, [Disturbance(LAST - 1, ports=0b010)])
    assert [e.port for e in episode.events if e.kind is EventKind.ACCEPTED] == [2]
    assert episode.bits > LAST + 6


@pytest.mark.parametrize("silent_from", range(1, LAST + 1))
def test_silent_sender_is_detected_until_frame_is_valid(silent_from):
    stations = [Station(0, (SHORT.can_frame(),), leaves_at=silent_from), Station(1), Station(2)]
    episode = run_episode(stations)
    got = [e.port for e in episode.events if e.kind is EventKind.ACCEPTED]
    # After the CRC the rest of the frame is recessive, or the acknowledgement of others.
    tail = wire.on_the_wire(SHORT).rstrip("1")
    if silent_from >= len(tail):
        assert got == [1, 2]
    else:
        assert got == []
        assert all(outcome.rec for outcome in episode.outcomes[1:])


@given(cases())
def test_nodes_agree_soon_after_last_disturbance(case):
    """Bound: each failure of a sender counts 8, except at a passive sender without ACK.

    After that failure the others have 25 recessive bits to agree in. With n nodes no frame is
    therefore tried more than 32 n + 32 times. (The worst of 30,000 drawn took 769 bits.)
    """
    stations, struck = case
    episode = run_episode(stations, struck)
    quiet_from = max(
        (one.first + (one.bits or 0) for one in struck if one.first <= episode.bits), default=0
    )
    leaving = max((one.leaves_at or 0 for one in stations), default=0)
    tail = episode.bits - max(quiet_from, leaving, LAST)
    assert episode.is_over
    attempts = sum(max(1, len(one.frames)) for one in stations) * (32 * len(stations) + 32)
    assert tail <= attempts * (LAST + 60)
    event(f"{tail // 200 * 200} bits or more" if tail > 0 else "at once")


@given(cases(), st.integers(1, 400))
def test_partial_episode_is_beginning_of_whole(case, until_bit):
    stations, struck = case
    whole = run_episode(stations, struck)
    part = run_episode(stations, struck, until_bit=until_bit)
    assert part.is_over is (part.bits == whole.bits)
    assert part.bits == whole.bits or part.bits >= until_bit
    assert list(part.events) == [e for e in whole.events if e.bit < part.bits]
    if part.is_over:
        assert part == whole
    event("all of it" if part.is_over else "a part")


@given(st.sampled_from(Effect), st.integers(0, 60), st.integers(-1, 7), st.integers(0, 3))
def test_endless_disturbance_ends_with_stalled_nodes(effect, first, ports, senders):
    """A short, or a deaf receiver: nodes that cannot continue are stalled or off."""
    stations = [Station(p, (SHORT.can_frame(),) if p < senders else ()) for p in range(3)]
    episode = run_episode(stations, [Disturbance(first, effect, None, ports)])
    assert episode.bits < 5000
    event(f"{sum(outcome.stalled for outcome in episode.outcomes)} stalled")
