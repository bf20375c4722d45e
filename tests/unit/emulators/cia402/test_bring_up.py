"""Bring-up on the wire: bytes and times, expected from CiA 301 and CiA 402-2.

CiA 301 defines the frames, CiA 402-2 the words (drives.md: statuswords 4F/40, 6F/21, 6F/23, 6F/27;
here with voltage 10h and remote 200h).
"""

import pytest

from motorhil.emulators.cia402.state_machine import PdsState
from tests.support.cia402.bench import BOOT_UP, ENABLE, MS, Bench


def test_bring_up_sequence_matches_the_transcript():
    bench = Bench()
    bench.boot()
    assert bench.hex_since(0) == ["705#00"]  # boot-up
    count = len(bench.sent)
    bench.nmt(0x01)
    assert bench.hex_since(count) == ["185#5002", "285#500201"]  # switch on disabled, pp
    for word, status in ((0x06, "3102"), (0x07, "3302")):
        bench.run(10 * MS)
        count = len(bench.sent)
        bench.controlword(word)
        assert bench.hex_since(count) == [f"185#{status}", f"285#{status}01"]
    bench.run(10 * MS)
    count = len(bench.sent)
    bench.controlword(0x0F)
    assert bench.hex_since(count) == []  # the power stage needs time
    bench.run(ENABLE)
    assert bench.hex_since(count) == ["185#3702", "285#370201"]
    bench.run(10 * MS)
    assert bench.hex_since(count + 2) == [
        "185#3706",
        "285#370601",
    ]  # the motor stands at its target


def test_boot_up_takes_the_configured_time():
    bench = Bench(timing={"boot_up_s": 0.25})
    bench.run_until(250 * MS - 1)
    assert bench.sent == []
    assert bench.truth("state") == PdsState.NOT_READY_TO_SWITCH_ON
    bench.run_until(250 * MS)
    assert bench.sent == [(250 * MS, 0x705, b"\x00")]
    assert bench.truth("state") == PdsState.SWITCH_ON_DISABLED


def test_enabling_takes_exactly_the_configured_time():
    bench = Bench()
    bench.operational()
    bench.controlword(0x06)
    bench.controlword(0x07)
    bench.run(10 * MS)
    asked = bench.now
    bench.controlword(0x0F)
    assert bench.drive.next_deadline_ns() == asked + ENABLE
    bench.run_until(asked + ENABLE - 1)
    assert bench.truth("state") == PdsState.SWITCHED_ON
    bench.run_until(asked + ENABLE)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED
    assert bench.times(0x185)[-1] == asked + ENABLE


def test_repeated_enable_command_does_not_extend_enabling():
    bench = Bench()
    bench.operational()
    for word in (0x06, 0x07, 0x0F):
        bench.controlword(word)
    bench.run(ENABLE // 2)
    bench.controlword(0x0F)
    bench.run(ENABLE // 2)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x06, PdsState.READY_TO_SWITCH_ON),
        (0x07, PdsState.SWITCHED_ON),
        (0x00, PdsState.SWITCH_ON_DISABLED),
        (0x02, PdsState.SWITCH_ON_DISABLED),
    ],
)
def test_another_command_during_enabling_cancels_it(word, state):
    bench = Bench()
    bench.operational()
    for before in (0x06, 0x07, 0x0F):
        bench.controlword(before)
    bench.run(ENABLE - 1)
    bench.controlword(word)
    assert bench.truth("state") == state
    bench.run(10 * ENABLE)
    assert bench.truth("state") == state


def test_enable_word_runs_transitions_3_and_4():
    bench = Bench()
    bench.operational()
    bench.controlword(0x06)
    bench.controlword(0x0F)
    assert bench.truth("state") == PdsState.SWITCHED_ON
    bench.run(ENABLE)
    assert bench.truth("state") == PdsState.OPERATION_ENABLED


def test_controlword_by_sdo_works_in_pre_operational():
    bench = Bench()
    bench.boot()
    for word in (0x06, 0x07, 0x0F):
        bench.set(0x6040, 0, word, 2)
    bench.run(ENABLE)
    assert bench.statusword() & 0x6F == 0x27
    assert bench.read(0x6040) == 0x0F


def test_reset_node_switches_power_off_and_boots_again():
    bench = Bench()
    bench.enable()
    bench.set(0x6081, 0, 1234, 4)
    bench.set(0x6060, 0, 3, 1)
    bench.set(0x60FF, 0, 9_999, 4)
    bench.nmt(0x81)
    assert bench.truth("state") == PdsState.NOT_READY_TO_SWITCH_ON
    reset_at = bench.now
    bench.run(BOOT_UP)
    assert bench.sent[-1] == (reset_at + BOOT_UP, 0x705, b"\x00")
    assert bench.truth("state") == PdsState.SWITCH_ON_DISABLED
    assert bench.read(0x6081) == 40960  # 60xxh have their power-on values again
    assert bench.read(0x6061) == 1
    bench.nmt(0x01)
    bench.enable(mode=3)
    bench.run(200 * MS)
    assert bench.read(0x606B) == 0


def test_pending_controlword_takes_effect_after_quick_stop():
    """Check that the word is a level: a shutdown sent during a quick stop applies at its end."""
    bench = Bench()
    bench.enable(mode=3)
    bench.set(0x60FF, 0, 50_000, 4)
    bench.run(300 * MS)
    bench.controlword(0x02)
    bench.run(2 * MS)
    bench.controlword(0x06)
    assert bench.truth("state") == PdsState.QUICK_STOP_ACTIVE
    bench.run(500 * MS)
    assert bench.truth("state") == PdsState.READY_TO_SWITCH_ON


def test_objects_read_as_the_standard_names_them():
    bench = Bench()
    bench.boot()
    assert bench.read(0x1000) == 0x00020192
    assert bench.read(0x6502) == 0x3ED  # pp, pv, tq, hm, ip, csp, csv, cst
    assert bench.read(0x6061) == 1
    assert bench.read(0x603F) == 0
    assert bench.read(0x6064) == 0
    assert bench.read(0x608F, 1) == 2000
    assert (bench.read(0x6091, 1), bench.read(0x6091, 2)) == (66, 1)
    assert (bench.read(0x6092, 1), bench.read(0x6092, 2)) == (132_000, 1)


def test_modes_not_supported_are_rejected():
    bench = Bench()
    bench.boot()
    for mode in (2, 11, -1, 5, 127):
        assert bench.write(0x6060, 0, mode, 1) == 0x0609_0030  # invalid value (CiA 301)
    assert bench.read(0x6061) == 1


def test_supported_modes_are_those_of_the_rig():
    bench = Bench(supported_modes=["pp", "hm"])
    bench.boot()
    assert bench.read(0x6502) == 0x21
    assert bench.write(0x6060, 0, 3, 1) == 0x0609_0030
    assert bench.write(0x6060, 0, 6, 1) == 0
