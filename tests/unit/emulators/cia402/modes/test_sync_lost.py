"""A cyclic mode without SYNC: a fault, if 60C2h gives the period.

CiA 402 names no error code for it; FF64h is Kollmorgen's ("Sync not received", ip/csp/csv/cst).
"""

import struct

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import MS, NODE, Bench

LIGHT = {"preset": "wheel_60w", "load_inertia_kg_m2": 0.0}
CYCLIC = (8, 9, 10)


def running(mode: int, cycles: int = 5, **settings: object) -> Bench:
    settings.setdefault("cyclic", {"sync_lost_periods": 4})
    bench = Bench(objects={"60C2h:1": 10, **settings.pop("objects", {})}, plant=LIGHT, **settings)
    bench.enable(mode)
    for _ in range(cycles):
        bench.sync()
        bench.run(10 * MS)
    return bench


def emergencies(bench: Bench) -> list[bytes]:
    return [data for _, can_id, data in bench.sent if can_id == 0x80 + NODE]


@pytest.mark.parametrize("mode", CYCLIC)
def test_four_periods_without_sync_are_a_fault(mode):
    bench = running(mode)
    bench.run(30 * MS - 1)  # 10 ms of silence have passed already
    assert bench.truth("state") == PdsState.OPERATION_ENABLED
    bench.run(1)
    assert bench.truth("state") in (PdsState.FAULT_REACTION_ACTIVE, PdsState.FAULT)
    assert emergencies(bench)[-1] == struct.pack("<HB5x", 0xFF64, 0x81)
    bench.run(50 * MS)
    assert bench.read(0x603F, signed=False) == 0xFF64
    bench.controlword(0x80)
    bench.run(1 * MS)
    assert bench.truth("state") == PdsState.SWITCH_ON_DISABLED
    bench.enable()
    bench.run(1000 * MS)  # it waits for SYNC only once one has come
    assert bench.truth("state") == PdsState.OPERATION_ENABLED


@pytest.mark.parametrize("mode", [1, 3, 4, 6])
def test_missing_sync_has_no_effect_in_other_modes(mode):
    bench = running(mode)
    bench.run(1000 * MS)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED


def test_missing_sync_needs_a_period_and_the_setting():
    for bench in (
        running(8, objects={"60C2h:1": 0}),
        running(8, cyclic={}),
        running(8, cycles=0),
    ):
        bench.run(1000 * MS)
        assert bench.truth("state") == PdsState.OPERATION_ENABLED


def test_rig_sets_number_of_periods_and_error_code():
    bench = running(9, cyclic={"sync_lost_periods": 2, "sync_lost_code": 0x8700})
    bench.run(10 * MS - 1)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED
    bench.run(1)
    assert emergencies(bench)[-1] == struct.pack("<HB5x", 0x8700, 0x21)


def test_605eh_sets_the_reaction_to_missing_sync():
    for option, coasts in ((0, True), (2, False)):
        bench = running(9, objects={"605Eh": option, "60FFh": 40_000})
        bench.run(31 * MS)
        assert (bench.truth("state") == PdsState.FAULT) is coasts
        bench.run(2 * MS)
        assert (abs(bench.truth("current_a")) < 1e-6) is coasts
        bench.run(2000 * MS)
        assert bench.truth("state") == PdsState.FAULT


def test_late_sync_within_the_time_is_accepted():
    bench = running(8)
    for _ in range(5):
        bench.run(29 * MS)
        bench.sync()
        bench.run(10 * MS)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED


@pytest.mark.parametrize("mode", CYCLIC)
@pytest.mark.parametrize("word", [0x02, 0x0B, 0x07, 0x06])  # quick stop, with 605Ah; 605Ch; 605Bh
def test_missing_sync_ends_no_stop_and_no_disabling(mode, word):
    """The mode is at work in OPERATION ENABLED only; elsewhere its deadline means nothing."""
    bench = running(mode, objects={"60FFh": 40_000, "605Ah": 6, "605Ch": 1, "605Bh": 1})
    bench.controlword(word)
    for _ in range(100):
        bench.run(10 * MS)
    assert bench.truth("state") not in (PdsState.FAULT_REACTION_ACTIVE, PdsState.FAULT)
    assert bench.truth("velocity_rad_s") == 0.0
