"""Recessive bits counted by a bus-off or integrating node; by hand.

A bit takes 1 us.
"""

from dataclasses import replace

import pytest

from motorhil.emulators.can.bitlevel.episode import Outcome
from motorhil.emulators.can.bus.port import NEVER_NS, RECOVERY_RUNS, RUN_BITS, Presence, Role
from motorhil.emulators.can.controller_config import CanNode
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule

BIT = 1000
ALL_RUNS_NS = 128 * 11 * BIT  # ISO 11898-1: 128 occurrences of 11 recessive bits
ENDED = Outcome(0, (), 0, 0, 0, 0, False, None, 0, 0)


def off(recovery_ns, off_ns=5_000):
    node = Presence(0, "left", CanNode(recovery_ns=recovery_ns))
    node.leave(off_ns)
    return node


def test_bus_off_node_recovers_after_128_runs():
    assert off(0).due_ns(BIT) == 5_000 + ALL_RUNS_NS
    assert off(70_000).due_ns(BIT) == 75_000 + ALL_RUNS_NS
    assert off(None).due_ns(BIT) == NEVER_NS


@pytest.mark.parametrize(("since_ns", "counts_from_ns"), [(10_000, 75_000), (90_000, 90_000)])
def test_recovery_delay_lasts_on_other_wire(since_ns, counts_from_ns):
    node = off(70_000)
    node.integrate(since_ns)
    assert (node.role, node.runs_left) == (Role.OFF, RECOVERY_RUNS)
    assert node.due_ns(BIT) == counts_from_ns + ALL_RUNS_NS


@pytest.mark.parametrize(("heard_bits", "runs"), [(0, 0), (10, 0), (11, 1), (21, 1), (22, 2)])
def test_start_of_frame_keeps_complete_runs(heard_bits, runs):
    node = off(0)
    node.dominant_from(5_000 + heard_bits * BIT, BIT)
    assert node.runs_left == RECOVERY_RUNS - runs


def test_episode_adds_runs_since_bus_off():
    node = Presence(0, "left", CanNode())
    node.end(replace(ENDED, off_at=20, recessive_runs=3, recessive_bits=4), 90_000, 21_000, BIT)
    assert node.due_ns(BIT) == 86_000 + 125 * 11 * BIT


@pytest.mark.parametrize(("recovery_ns", "counts_from_ns"), [(30_000, 86_000), (80_000, 101_000)])
def test_runs_before_recovery_delay_do_not_count(recovery_ns, counts_from_ns):
    node = Presence(0, "left", CanNode(recovery_ns=recovery_ns))
    node.end(replace(ENDED, off_at=20, recessive_runs=3, recessive_bits=4), 90_000, 21_000, BIT)
    assert node.due_ns(BIT) == counts_from_ns + ALL_RUNS_NS


def test_integrating_node_keeps_remaining_bits():
    node = Presence(0, "left", CanNode())
    node.end(replace(ENDED, integrating=4), 90_000, 0, BIT)
    assert node.due_ns(BIT) == 94_000
    assert node.station(()).integrating == RUN_BITS


def test_stalled_node_stays_stalled_in_next_episode():
    node = Presence(0, "left", CanNode())
    node.end(replace(ENDED, stalled=True), 90_000, 0, BIT)
    assert node.station(()).stalled
    node.integrate(95_000)  # another wire
    assert not node.station(()).stalled


def test_babble_has_eight_bytes_at_most():
    words = {"identifier": 0x10, "sender": "left"}
    for size in (0, 8):
        FaultRule("idiot", FaultKind.BABBLE, data=bytes(size), **words)
    with pytest.raises(ValueError, match="8 bytes at most"):
        FaultRule("idiot", FaultKind.BABBLE, data=bytes(9), **words)
