"""The drawn order of parties that could continue at one instant."""

from random import Random

from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.harness.virtual_time.runtime import VirtualRuntime


def order_of(seed, parties=4):
    """Return the order in which parties with equal deadlines take their turns."""
    runtime = VirtualRuntime(EventQueue())
    if seed is not None:
        runtime.interleave(Random(seed).randrange)
    turns = []

    def party(name):
        for _ in range(3):
            runtime.run_for(0.01)
            turns.append(name)

    spawned = [
        runtime.spawn(str(number), lambda number=number: party(number)) for number in range(parties)
    ]
    for one in spawned:
        assert one.join()
    runtime.close()
    return tuple(turns)


def test_without_a_draw_the_one_that_waits_longest_is_first():
    assert order_of(None) == (0, 1, 2, 3) * 3


def test_one_seed_gives_one_order():
    assert order_of(5) == order_of(5)


def test_seeds_reach_many_orders_and_each_party_has_all_its_turns():
    orders = {order_of(seed) for seed in range(40)}
    assert len(orders) > 30
    assert all(sorted(one) == sorted((0, 1, 2, 3) * 3) for one in orders)


def test_a_runtime_knows_whether_parties_ever_took_turns():
    alone = VirtualRuntime(EventQueue())
    alone.run_for(0.01)
    assert not alone.had_parties()
    two = VirtualRuntime(EventQueue())
    two.spawn("second", lambda: two.run_for(0.01)).join()
    assert two.had_parties()
