"""Drives whose dictionaries are those of real vendors: they start, enable and move.

For the objects missing in each file see data/eds/INDEX.md. All access is by SDO, which every file
allows.
"""

from pathlib import Path

import pytest

from motorhil.emulators.controller import SettingError
from tests.support.cia402.bench import ENABLE, MS, Bench

pytestmark = pytest.mark.data

# file: (modes that 6502h then names, increments per position unit, inc/s per velocity unit)
TURN = 2000  # encoder increments of the default motor
FILES = {
    "maxon_epos2_50_5.eds": ({"pp", "pv", "hm", "csp"}, 1.0, TURN / 60),  # 608Ch: rpm
    "nanotec_C5-E-2-09.eds": (
        {"pp", "pv", "tq", "hm", "csp"},
        *(TURN / 3600, TURN / 60),  # 60A8h, 60A9h
    ),
    "technosoft_ipos.eds": ({"pp", "pv", "hm"}, 1.0, 1.0),
    "roboteq_v80.eds": ({"pp", "pv", "tq", "csp"}, 1.0, 1.0),
    "elmo_gold_cob.dcf": ({"pp", "pv", "tq", "hm", "csp"}, 1.0, 1.0),
    "schunk_prl_erb_0_63.dcf": ({"pp"}, 1.0, 1.0),
}
MODES = {"pp": 1, "pv": 3, "tq": 4, "hm": 6, "csp": 8}


def vendor_bench(shared: Path, file: str, **settings: object) -> Bench:
    return Bench(folder=shared / "data" / "eds", eds=file, **settings)


def enable(bench: Bench) -> None:
    bench.boot()
    assert bench.hex_since(0)[0] == "705#00"
    for word in (0x06, 0x07, 0x0F):
        bench.set(0x6040, 0, word, 2)
    bench.run(ENABLE)
    assert bench.statusword() & 0x6F == 0x27


def switch(bench: Bench, mode: str) -> None:
    bench.set(0x6060, 0, MODES[mode], 1)
    assert bench.read(0x6061) == MODES[mode]
    bench.run(20 * MS)


@pytest.mark.parametrize("file", FILES)
def test_drive_enables_and_moves_in_every_mode_it_names(shared, file):
    modes, position_unit, velocity_unit = FILES[file]
    bench = vendor_bench(shared, file)
    enable(bench)
    if bench.drive.od.has_index(0x6502):
        named = bench.read(0x6502, signed=False)
        assert {name for name, mode in MODES.items() if named >> (mode - 1) & 1} == modes
        assert named & 0xFFFF & ~0x3ED == 0  # no mode without behaviour is named

    switch(bench, "pp")
    target = round(20_000 / position_unit)
    bench.set(0x607A, 0, target, 4)
    bench.set(0x6081, 0, round(50_000 / velocity_unit), 4)
    bench.set(0x6040, 0, 0x1F, 2)
    assert bench.statusword() & 0x1400 == 0x1000
    bench.set(0x6040, 0, 0x0F, 2)
    bench.run_while(lambda: not bench.statusword() & 0x0400, 10_000 * MS)
    assert bench.truth("demand_inc") == 20_000
    assert bench.read(0x6062) == target
    assert bench.read(0x6064) == pytest.approx(target, abs=100 / position_unit)

    if "pv" in modes:
        switch(bench, "pv")
        wanted = round(30_000 / velocity_unit)
        bench.set(0x60FF, 0, wanted, 4)
        bench.run(2500 * MS)
        assert bench.read(0x606B) == pytest.approx(wanted, abs=1)
        assert bench.read(0x606C) == pytest.approx(wanted, abs=3_000 / velocity_unit)
        bench.set(0x60FF, 0, 0, 4)
        bench.run(2500 * MS)
    if "tq" in modes:
        switch(bench, "tq")
        bench.set(0x6071, 0, 80, 2)
        bench.run_while(lambda: not bench.statusword() & 0x0400)  # 6087h differs
        assert bench.read(0x6077) == pytest.approx(80, abs=8)
        assert bench.truth("velocity_rad_s") > 0.0
        bench.set(0x6071, 0, 0, 2)
        bench.run(10_000 * MS)  # friction brakes it, more or less
        switch(bench, "pp")
        bench.run(5_000 * MS)
        assert bench.truth("velocity_rad_s") == pytest.approx(0.0, abs=1e-3)
    if "csp" in modes:
        switch(bench, "csp")
        start = bench.read(0x6062)
        step = round(20 / position_unit)
        for cycle in range(1, 51):
            bench.set(0x607A, 0, start + cycle * step, 4)
            bench.run(4 * MS)
        bench.run(100 * MS)
        assert bench.read(0x6062) == start + 50 * step
        assert bench.statusword() & 0x1000
    if "hm" in modes:
        switch(bench, "hm")
        bench.run(200 * MS)
        bench.set(0x6098, 0, 35, 1)
        bench.set(0x607C, 0, 0, 4)
        bench.set(0x6040, 0, 0x1F, 2)
        bench.run(5 * MS)
        assert bench.statusword() & 0x3400 == 0x1400
        assert bench.read(0x6064) == pytest.approx(0, abs=50)  # the drive still holds its position
    bench.set(0x6040, 0, 0x00, 2)
    assert bench.statusword() & 0x4F == 0x40


@pytest.mark.parametrize("file", FILES)
def test_quick_stop_and_faults_work_with_every_file(shared, file):
    _, position_unit, velocity_unit = FILES[file]
    bench = vendor_bench(shared, file)
    enable(bench)
    switch(bench, "pp")
    bench.set(0x607A, 0, round(1_000_000 / position_unit), 4)
    bench.set(0x6081, 0, round(10_000 / velocity_unit), 4)
    bench.set(0x6040, 0, 0x1F, 2)
    bench.run(1000 * MS)
    assert bench.truth("demand_inc") > 1000
    bench.set(0x6040, 0, 0x02, 2)
    bench.run(2000 * MS)
    assert bench.statusword() & 0x4F == 0x40  # 605Ah = 2 where it is absent
    stood_at = bench.truth("position_inc")
    bench.run(1000 * MS)
    assert bench.truth("position_inc") == pytest.approx(stood_at, abs=50)

    bench.drive.stimulate("fault", 0x2310, bench.now)
    bench._drain()
    assert bench.last(0x085)[:3] == bytes.fromhex("102303")  # EMCY: 085h without 1014h
    assert bench.statusword() & 0x4F == 0x08
    if bench.drive.od.has_index(0x603F):
        assert bench.read(0x603F, signed=False) == 0x2310
    bench.set(0x6040, 0, 0x80, 2)
    assert bench.statusword() & 0x4F == 0x40


ABSENT = {  # INDEX.md, "What the drives' files lack"
    "schunk_prl_erb_0_63.dcf": (0x60FF, 0x6084, 0x605A, 0x603F, 0x608F),
    "technosoft_ipos.eds": (0x6084, 0x603F),
    "maxon_epos2_50_5.eds": (0x605A, 0x603F, 0x608F),
    "roboteq_v80.eds": (0x605A, 0x603F, 0x1005, 0x1014, 0x608F),
    "elmo_gold_cob.dcf": (0x1005,),
}


@pytest.mark.parametrize("file", ABSENT)
def test_objects_missing_in_a_file_do_not_exist(shared, file):
    bench = vendor_bench(shared, file)
    bench.boot()
    for index in ABSENT[file]:
        assert bench.write(index, 0, 0, 4) == 0x0602_0000  # object does not exist (CiA 301)
        reply = bench._sdo(bytes((0x40, index & 0xFF, index >> 8, 0, 0, 0, 0, 0)))
        assert reply.hex() == f"80{index & 0xFF:02x}{index >> 8:02x}0000000206"


def test_values_come_from_the_file_parametervalue_first(shared):
    bench = vendor_bench(shared, "schunk_prl_erb_0_63.dcf")
    bench.boot()
    assert bench.read(0x60C2, 1) == 50
    assert bench.read(0x1017) == 100
    bench = vendor_bench(shared, "maxon_epos2_50_5.eds")
    bench.boot()
    assert bench.read(0x60C2, 2) == -3  # 0xFD
    assert bench.read(0x60C0) == -1  # 0xFFFF
    assert bench.read(0x6065) == 2000


def test_rig_overrides_the_file_and_adds_missing_values(shared):
    bench = vendor_bench(
        shared,
        "schunk_prl_erb_0_63.dcf",
        objects={"6065h": 77, "605Ah": 6, "6083h": 50_000, "1017h": 0},
        units={"velocity_unit_inc_s": 10.0},
    )
    enable(bench)
    assert bench.read(0x6065) == 77
    assert bench.read(0x6083) == 50_000
    bench.set(0x6040, 0, 0x02, 2)
    bench.run(1000 * MS)
    assert bench.statusword() & 0x6F == 0x07  # stays: 605Ah has the hidden value 6


def test_motion_can_be_streamed_by_remapping(shared):
    """Remap RPDO 4 by the usual procedure: Roboteq maps 607Ah into none of its RPDOs."""
    bench = vendor_bench(shared, "roboteq_v80.eds", objects={"6065h": 0xFFFF_FFFF})
    enable(bench)
    bench.set(0x1403, 1, 0x8000_0505, 4)
    bench.set(0x1603, 0, 0, 1)
    bench.set(0x1603, 1, 0x6040_0010, 4)
    bench.set(0x1603, 2, 0x607A_0020, 4)
    bench.set(0x1603, 0, 2, 1)
    bench.set(0x1403, 2, 1, 1)
    bench.set(0x1403, 1, 0x0000_0505, 4)
    bench.set(0x60C2, 1, 4, 1)
    switch(bench, "csp")
    bench.nmt(0x01)
    for cycle in range(1, 26):
        bench.send(0x505, (0x0F).to_bytes(2, "little") + (cycle * 40).to_bytes(4, "little"))
        bench.sync()
        bench.run(4 * MS)
    bench.run(5 * MS)
    assert bench.truth("demand_inc") == 1000


def test_modes_of_the_file_not_emulated_are_reported(shared):
    bench = vendor_bench(shared, "roboteq_v80.eds")
    assert ("info", "6502h of roboteq_v80.eds also names vl: not emulated") in (bench.events)


def test_file_in_windows_1252_is_read_with_a_warning(shared):
    bench = vendor_bench(shared, "BAD_faulhaber_mcbl_51V.eds")
    assert any(
        level == "warning" and "BAD_faulhaber_mcbl_51V.eds:52" in text
        for level, text in bench.events
    )
    enable(bench)


def test_unresolved_merge_is_rejected_with_its_line(shared):
    with pytest.raises(SettingError, match=r"^eds: .*BAD_epos2_master.dcf:235: unresolved merge"):
        vendor_bench(shared, "BAD_epos2_master.dcf")
