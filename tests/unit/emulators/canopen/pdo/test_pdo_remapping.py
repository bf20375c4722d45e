"""Changing PDOs by SDO: the standard's procedure and refusals (CiA 301, 7.5.2.35-38).

The standard names 0604 0041h and 0604 0042h. Deviations from the procedure are refused with 0601
0000h, an invalid COB-ID or type with 0609 0030h, as in CANopenNode (301/CO_PDO.c), a slave that
passes the CiA conformance test.
"""

import pytest

from tests.support.canopen.node_bench import Bench, dictionary, put_pdo

STATUSWORD, POSITION, CONTROLWORD, TARGET = 0x6041_0010, 0x6064_0020, 0x6040_0010, 0x607A_0020
INVALID = 0x8000_0000


def bench_with_both() -> Bench:
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255)
    put_pdo(od, 0x1800, (STATUSWORD,), 1)
    return Bench(od).operate()


def test_standard_procedure_remaps_tpdo():
    bench = bench_with_both()
    for index, subindex, value, size in (
        (0x1800, 1, INVALID | 0x182, 4),
        (0x1A00, 0, 0, 1),
        (0x1A00, 1, POSITION, 4),
        (0x1A00, 2, STATUSWORD, 4),
        (0x1A00, 0, 2, 1),
        (0x1800, 1, 0x0000_0182, 4),
    ):
        assert bench.download(index, subindex, value, size) == ""
    bench.od.get(0x6064).value = 5
    bench.tell(0x080)
    assert bench.frames() == ["182 05 00 00 00 40 02"]


def test_rpdo_is_remapped_with_new_identifier_and_type():
    bench = bench_with_both()
    for index, subindex, value, size in (
        (0x1400, 1, INVALID | 0x202, 4),
        (0x1600, 0, 0, 1),
        (0x1600, 1, TARGET, 4),
        (0x1600, 0, 1, 1),
        (0x1400, 2, 1, 1),
        (0x1400, 1, 0x0000_0333, 4),
    ):
        assert bench.download(index, subindex, value, size) == ""
    bench.tell(0x202, "0F 00 00 00")
    bench.tell(0x333, "09 00 00 00")
    assert bench.od.integer(0x607A, 0, 0) == 0
    bench.tell(0x080)
    assert bench.od.integer(0x607A, 0, 0) == 9
    assert bench.od.integer(0x6040, 0, 0) == 0


@pytest.mark.parametrize(("subindex", "value", "size"), [(0, 0, 1), (1, POSITION, 4)])
def test_mapping_of_valid_pdo_is_locked(subindex, value, size):
    bench = bench_with_both()
    assert bench.download(0x1A00, subindex, value, size) == "0601 0000"
    assert bench.download(0x1600, subindex, value, size) == "0601 0000"
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02"]


def test_entries_of_enabled_mapping_are_locked():
    bench = bench_with_both()
    assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
    assert bench.download(0x1A00, 1, POSITION, 4) == "0601 0000"


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (0x1234_0010, "0602 0000"),  # no such object
        (0x1018_0720, "0609 0011"),  # no such sub-index
        (0x1018_0120, "0604 0041"),  # not mappable
        (0x6040_0008, "0604 0041"),  # not the length of the object
        (0x6041_0010, "0604 0041"),  # read-only, into an RPDO
        (0x0006_0008, "0602 0000"),  # dummy of a wrong length
        (0x0006_0010, ""),  # a dummy
        (0x2002_0008, ""),  # write-only
        (0x2004_0018, ""),  # 24 bits
        (0x2003_0001, ""),  # one bit
        (0, ""),  # an unused entry
    ],
)
def test_rpdo_mapping_accepts_writable_objects_only(entry, code):
    bench = bench_with_both()
    assert bench.download(0x1400, 1, INVALID | 0x202, 4) == ""
    assert bench.download(0x1600, 0, 0, 1) == ""
    assert bench.download(0x1600, 1, entry, 4) == code


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (0x2002_0008, "0604 0041"),  # write-only
        (0x6040_0010, "0604 0041"),  # rww: written by RPDO, not read by TPDO (CiA 306)
        (0x0006_0010, "0602 0000"),  # dummies are for RPDOs
        (0x1001_0008, ""),
        (0x6064_0020, ""),
    ],
)
def test_tpdo_mapping_accepts_readable_objects_only(entry, code):
    bench = bench_with_both()
    assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
    assert bench.download(0x1A00, 0, 0, 1) == ""
    assert bench.download(0x1A00, 1, entry, 4) == code


def test_nine_bytes_and_nine_entries_are_refused():
    bench = bench_with_both()
    assert bench.download(0x1400, 1, INVALID | 0x202, 4) == ""
    assert bench.download(0x1600, 0, 0, 1) == ""
    for subindex, entry in enumerate((0x2006_0040, 0x2002_0008), start=1):
        assert bench.download(0x1600, subindex, entry, 4) == ""
    assert bench.download(0x1600, 0, 2, 1) == "0604 0042"
    assert bench.download(0x1600, 0, 9, 1) == "0604 0042"
    assert bench.download(0x1600, 0, 1, 1) == ""
    assert bench.download(0x1600, 9, 0, 4) == "0609 0011"


def test_enabling_unwritten_entries_is_refused():
    bench = bench_with_both()
    assert bench.download(0x1400, 1, INVALID | 0x202, 4) == ""
    assert bench.download(0x1600, 0, 0, 1) == ""
    assert bench.download(0x1600, 1, CONTROLWORD, 4) == ""
    assert bench.download(0x1600, 0, 2, 1) == "0602 0000"  # entry 2 maps nothing


def test_fixed_mapping_is_read_only():
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255)
    od.get(0x1600, 1).access = "const"
    od.get(0x1600, 0).access = "ro"
    bench = Bench(od).operate()
    assert bench.download(0x1400, 1, INVALID | 0x202, 4) == ""
    assert bench.download(0x1600, 0, 0, 1) == "0601 0002"
    assert bench.download(0x1600, 1, TARGET, 4) == "0601 0002"


@pytest.mark.parametrize(
    "cob_id",
    [
        0x0000_0183,  # another identifier while the PDO exists
        0x2000_0182,  # 29-bit
        0x0000_0000,  # NMT
        0x0000_0601,  # SDO
        0x0000_0701,  # error control
    ],
)
def test_invalid_cob_id_is_refused(cob_id):
    bench = bench_with_both()
    assert bench.download(0x1800, 1, cob_id, 4) == "0609 0030"
    if cob_id != 0x183:
        assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
        assert bench.download(0x1800, 1, cob_id, 4) == "0609 0030"


def test_same_cob_id_is_accepted():
    bench = bench_with_both()
    assert bench.download(0x1800, 1, 0x4000_0182, 4) == ""  # no remote requests: unchanged


@pytest.mark.parametrize(
    ("transmission_type", "tpdo", "rpdo"),
    [
        *((kind, "", "") for kind in (0, 1, 240, 254, 255)),
        *((kind, "0609 0030", "0609 0030") for kind in (241, 251)),  # reserved
        *((kind, "", "0609 0030") for kind in (252, 253)),  # on request: only for TPDOs
    ],
)
def test_reserved_transmission_type_is_refused(transmission_type, tpdo, rpdo):
    bench = bench_with_both()
    assert bench.download(0x1800, 2, transmission_type, 1) == tpdo
    assert bench.download(0x1400, 2, transmission_type, 1) == rpdo


def test_inhibit_time_of_valid_tpdo_is_locked():
    bench = bench_with_both()
    assert bench.download(0x1800, 3, 50, 2) == "0609 0030"
    assert bench.download(0x1800, 3, 0, 2) == ""  # unchanged
    assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
    assert bench.download(0x1800, 3, 50, 2) == ""


def test_tpdo_made_valid_in_operational_is_sent():
    od = dictionary()
    put_pdo(od, 0x1800, (STATUSWORD,), 255, cob_id=INVALID | 0x182)
    bench = Bench(od).operate()
    assert bench.download(0x1800, 1, 0x182, 4) == ""
    assert bench.frames() == ["182 40 02"]


def test_reset_communication_restores_power_on_mapping():
    bench = bench_with_both()
    assert bench.download(0x1800, 1, INVALID | 0x182, 4) == ""
    bench.tell(0x000, b"\x82\x00")
    bench.wait(50_000_000)
    bench.tell(0x000, b"\x01\x00")
    bench.frames()
    bench.tell(0x080)
    assert bench.frames() == ["182 40 02"]


def test_mapping_without_stated_count_counts_its_entries():
    # As 1601h in Elmo's DCF: an entry with a DefaultValue, sub-index 0 without.
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255)
    od.get(0x1600, 0).has_default = False
    od.get(0x1600, 0).value = od.get(0x1600, 0).default = 0
    bench = Bench(od).operate()
    bench.tell(0x202, "0F 00")
    assert od.integer(0x6040, 0, 0) == 0x0F
    assert bench.ask("40 00 16 00 00 00 00 00") == "4F 00 16 00 01 00 00 00"
