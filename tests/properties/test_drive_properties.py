"""Observing a drive changes nothing; at rest it uses no time (its states: test_fsa_machine)."""

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.cia402.bench import MS, NODE, Bench
from tests.support.repetition import examples

WORDS = st.sampled_from(
    [0x00, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x5F, 0x010F, 0x80, 0x8F, 0x021F]
)
ACTIONS = st.one_of(
    st.tuples(st.just("word"), WORDS | st.integers(0, 0xFFFF)),
    st.tuples(st.just("mode"), st.sampled_from([0, 1, 3, 4, 6, 8])),
    st.tuples(st.just("target"), st.integers(-20_000, 20_000)),
    st.tuples(st.just("velocity"), st.integers(-60_000, 60_000)),
    st.tuples(st.just("torque"), st.integers(-1_200, 1_200)),
    st.tuples(st.just("position gain"), st.sampled_from([5_000, 66_667, 4_000_000_000])),
    st.tuples(st.just("quick stop code"), st.sampled_from([0, 1, 2, 5, 6])),
    st.tuples(st.just("wait"), st.sampled_from([0.3, 1, 20, 77, 300])),
    st.tuples(st.just("sync"), st.just(0)),
    st.tuples(st.just("fault"), st.sampled_from([0x2310, 0x8611, 0xFF01])),
    st.tuples(st.just("power"), st.sampled_from([0, 1])),
    st.tuples(st.just("load"), st.sampled_from([0.0, 5.0, 40.0])),
    st.tuples(st.just("nmt"), st.sampled_from([0x01, 0x01, 0x02, 0x80, 0x81, 0x82])),
    st.tuples(st.just("abort code"), st.sampled_from([0, 1, 2, 3])),
    st.tuples(st.just("heartbeat"), st.just(0)),  # once received, lost 50 ms later
)
ENABLED = [("word", 0x06), ("word", 0x0F), ("wait", 20)]
STARTS = st.sampled_from(
    [
        [],
        ENABLED,
        [*ENABLED, ("target", 9_000), ("word", 0x1F), ("wait", 77)],
        [("mode", 3), ("velocity", 40_000), *ENABLED, ("wait", 77)],
        [("mode", 4), ("torque", 400), *ENABLED, ("wait", 77)],
        [*ENABLED, ("word", 0x02)],
    ]
)
RUNS = st.builds(lambda start, rest: [*start, *rest], STARTS, st.lists(ACTIONS, max_size=25))


def new_bench() -> Bench:
    bench = Bench(
        objects={"1402h:2": 1, "1800h:3": 0, "6066h": 3, "1016h:1": 127 << 16 | 50, "1029h:1": 1},
        timing={"boot_up_s": 0.01},
        plant={"preset": "wheel_60w", "load_inertia_kg_m2": 0.0},
    )
    bench.run_until(10 * MS)
    bench.nmt(0x01)
    return bench


def act(bench: Bench, what: str, value: float) -> None:
    if what == "word":
        bench.controlword(int(value))
    elif what == "mode":
        bench.send(
            0x300 + NODE, struct.pack("<Hb", bench.drive.od.integer(0x6040, 0, 0), int(value))
        )
    elif what == "target":
        word = bench.drive.od.integer(0x6040, 0, 0)
        bench.send(0x400 + NODE, struct.pack("<Hi", word, int(value)))
    elif what == "velocity":
        word = bench.drive.od.integer(0x6040, 0, 0)
        bench.send(0x500 + NODE, struct.pack("<Hi", word, int(value)))
    elif what in ("torque", "position gain"):
        bench.drive.od.get(*((0x6071, 0) if what == "torque" else (0x60FB, 1))).write(int(value))
        bench.drive.on_write(bench.now)
        bench._drain()
    elif what == "quick stop code":
        bench.drive.od.get(0x605A).write(int(value))
    elif what == "abort code":
        bench.drive.od.get(0x6007).write(int(value))
    elif what == "heartbeat":
        bench.send(0x77F, b"\x05")
    elif what == "wait":
        bench.run(round(value * MS))
    elif what == "sync":
        bench.sync()
    elif what == "nmt":
        bench.nmt(int(value))
    else:
        name = "load_torque_n_m" if what == "load" else what
        bench.drive.stimulate(name, value, bench.now)
        bench._drain()


@given(
    RUNS, st.lists(st.integers(0, 30), min_size=1, max_size=40), st.randoms(use_true_random=False)
)
@settings(max_examples=examples(20))
def test_observing_changes_nothing(run, looks, dice):
    plain, watched = new_bench(), new_bench()
    for number, (what, value) in enumerate(run):
        act(plain, what, value)
        if what == "wait":
            end = watched.now + round(value * MS)
            for _ in range(looks[number % len(looks)]):
                watched.run_until(watched.now + dice.randrange(end - watched.now + 1))
                watched.drive.snapshot(watched.now)
                watched.drive.next_deadline_ns()
                watched.drive.identifiers()
                watched.drive.take_events()
            watched.run_until(end)
        else:
            act(watched, what, value)
    assert plain.sent == watched.sent
    assert plain.drive.snapshot(plain.now) == watched.drive.snapshot(watched.now)


def test_drive_at_rest_has_no_deadline():
    bench = new_bench()
    assert bench.drive.next_deadline_ns() is None
    bench.enable(mode=1)
    bench.run(500 * MS)
    assert bench.drive.next_deadline_ns() is None
    bench.set(0x1017, 0, 100, 2)
    first = bench.drive.next_deadline_ns()
    assert first is not None
    count = len(bench.sent)
    bench.run(1000 * MS)
    assert bench.hex_since(count) == ["705#05"] * 10  # heartbeats only


def test_coasting_motor_costs_nothing_until_observed():
    bench = new_bench()
    bench.enable(mode=3)
    bench.send(0x505, struct.pack("<Hi", 0x0F, 50_000))
    bench.run(300 * MS)
    bench.controlword(0x00)
    assert bench.drive.next_deadline_ns() is None
    bench.run(3_600_000 * MS)
    assert bench.truth("velocity_rad_s") == 0.0


@pytest.mark.parametrize("heartbeat_ms", [0, 1000])
def test_statusword_is_sent_at_the_exact_tick(heartbeat_ms):
    """Check that target reached is due at a tick, not at a poll or another wake-up of the node."""
    bench = new_bench()
    bench.set(0x1017, 0, heartbeat_ms, 2)
    bench.enable(mode=1)
    bench.run(50 * MS + 300_000)  # off the tick grid
    offered_at = bench.now
    bench.send(0x405, struct.pack("<Hi", 0x1F, 5_000))
    bench.sync()
    bench.run(3000 * MS)
    assert bench.last(0x185) == bytes.fromhex("3716")
    acknowledged_at, reached_at = bench.times(0x185)[-2:]
    assert acknowledged_at == offered_at
    assert reached_at % MS == 0
    assert reached_at < offered_at + 300 * MS
