"""Oracle of error states against the states of the simulated medium."""

import random

from motorhil.emulators.can.bitlevel.episode import (
    Disturbance,
    Effect,
    EventKind,
    Station,
    run_episode,
)
from motorhil.emulators.can.frame import pack
from motorhil.harness.oracles.base import Verdict
from motorhil.harness.oracles.judge import judge
from motorhil.traces.can_frame import ERR, classic
from motorhil.traces.decoding.can_errors import ControllerState, bus_error
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.schema import Direction

NODES = 3
RESTARTED = classic(ERR | 0x300, bytes(8))
EPISODES = 1500


def struck(dice):
    """Return a disturbance for half of the frames, at some nodes or all."""
    if dice.random() < 0.5:
        return []
    ports = dice.choice([-1, *range(1, 1 << NODES)])
    return [Disturbance(dice.randrange(60), dice.choice(list(Effect)), dice.choice([1, 6]), ports)]


def run(dice):
    """Record a bus where random nodes send and many frames fail."""
    frames, now_ns = [], 0
    stations = {port: Station(port) for port in range(NODES)}
    off = {}
    for _ in range(EPISODES):
        for port, rounds in list(off.items()):
            off[port] = rounds - 1
            if not off[port]:
                del off[port]
                frames.append(Frame(now_ns, "can0", RESTARTED, Direction.RECEIVED, f"n{port}"))
                stations[port] = Station(port)
        sender = dice.choice(list(stations))
        own = stations[sender]
        stations[sender] = Station(sender, (pack(0x100 + sender, b"\x55"),), own.tec, own.rec)
        episode = run_episode([stations[port] for port in sorted(stations)], struck(dice))
        for event in episode.events:
            if event.kind in (EventKind.SENT, EventKind.ERROR, EventKind.STATE):
                at_ns = now_ns + event.bit * 1000
                who = f"n{event.port}"
                frames.append(Frame(at_ns, "can0", event.frame, Direction.RECEIVED, who))
        for one in episode.outcomes:
            if one.off_at is not None:
                del stations[one.port]
                off[one.port] = 10
            else:
                stations[one.port] = Station(one.port, (), one.tec, one.rec)
        now_ns += (episode.bits + 1) * 1000
        if not stations:
            break
    return sorted(frames, key=lambda frame: frame.time_ns)


def test_states_of_the_medium_are_legal_and_all_reached(tmp_path):
    met = set()
    for seed in (1, 2):
        frames = run(random.Random(seed))
        path = tmp_path / f"{seed}.mcap"
        record_frames(path, frames, {"run": {}})
        (finding,) = judge(path, only=["error-states"])
        assert (finding.verdict, finding.first) == (Verdict.HELD, None)
        assert finding.looked > 20
        for frame in frames:
            if int.from_bytes(frame.frame[:4], "little") & ERR:
                told = bus_error(frame.frame)
                met.add((told.state, told.way))
    assert {state for state, _ in met} >= set(ControllerState)
    assert {way for state, way in met if state is ControllerState.WARNING} >= {
        "by sending",
        "by receiving",
    }
