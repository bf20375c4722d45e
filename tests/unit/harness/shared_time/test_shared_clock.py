"""Programs that share a clock make what parties of one process make."""

import threading
from random import Random

import pytest

from motorhil.emulators.can.frame import pack as pack_frame
from motorhil.harness.shared_time.shared_clock import SharedClock
from tests.support.programs.clock_sharers import (
    guest,
    in_one_process,
    new_world,
    shared_clock,
    steps,
    with_shared_clock,
)

SEEDS = 40
MORE = 1_000


def programs_of(seed):
    random = Random(seed)
    return {name: steps(random) for name in ("one", "two", "three")[: random.randint(2, 3)]}


def require_equal(seed, path):
    programs = programs_of(seed)
    frames, logs = in_one_process(programs)
    names = list(programs)
    Random(seed).shuffle(names)  # the order of connecting does not matter
    assert with_shared_clock(programs, path, names) == (frames, logs), f"seed {seed}"
    return frames, logs


def test_programs_with_shared_clock_make_frames_of_parties(tmp_path):
    met = set()
    count = 0
    for seed in range(SEEDS):
        frames, logs = require_equal(seed, tmp_path / f"{seed}")
        count += len(frames)
        met |= {
            kind if isinstance(kind, str) else "frame" for log in logs.values() for *_, kind in log
        }
    assert count > 10 * SEEDS
    assert met >= {"wait", "sleep", "send", "receive", "every", "spawn", "poll", "frame"}


def test_port_closed_while_its_frame_is_delivered_hears_nothing(tmp_path):
    world, runtime, _ = new_world()
    clock = shared_clock(world, runtime, tmp_path / "clock", [], {"one": 60.0})
    heard = []

    def body(own_runtime, own_world):
        ports = []

        def first(*told):
            heard.append("first")
            ports[1].close()

        for hear in (first, lambda *told: heard.append("second")):
            ports.append(own_world.add_host("can0", "host", hear))
        own_world.add_host("can0", "host", lambda *told: None).send(pack_frame(1, b""))
        own_runtime.run_for(0.01)

    thread = threading.Thread(target=guest, args=(tmp_path / "clock", "one", body))
    thread.start()
    clock.await_programs(["one"], lambda name: True)
    runtime.wait_for_parties(clock.are_gone)
    thread.join()
    clock.close()
    runtime.close()
    assert (heard, clock.left) == (["first"], {"one": ""})


@pytest.mark.nightly
def test_1000_seeds_make_frames_of_parties(tmp_path):
    for seed in range(SEEDS, SEEDS + MORE):
        require_equal(seed, tmp_path / f"{seed}")


def test_comparison_detects_another_order_of_programs(tmp_path, monkeypatch):
    """Planted: the clock takes the programs in another order than the rig's."""
    programs = {name: [("send", 0.0, number)] for number, name in enumerate(("one", "two"))}
    swapped = dict(reversed(programs.items()))
    assert in_one_process(programs)[0] != in_one_process(swapped)[0]
    await_programs = SharedClock.await_programs
    monkeypatch.setattr(
        SharedClock,
        "await_programs",
        lambda clock, names, is_alive: await_programs(clock, names[::-1], is_alive),
    )
    assert with_shared_clock(programs, tmp_path / "clock") != in_one_process(programs)
