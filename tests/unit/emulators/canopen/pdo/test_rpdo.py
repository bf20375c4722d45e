"""RPDOs: time of the writes, and wrong lengths (CiA 301, 7.2.2)."""

from types import SimpleNamespace

import pytest

from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.pdo_mapping import is_dummy
from tests.support.canopen.node_bench import MS, Bench, dictionary, put_pdo

CONTROLWORD, TARGET = 0x6040_0010, 0x607A_0020


def bench_with(entries: tuple[int, ...], transmission_type: int) -> Bench:
    od = dictionary()
    put_pdo(od, 0x1400, entries, transmission_type)
    return Bench(od).operate()


def values(od: ObjectDictionary, *places: int) -> list[int]:
    return [od.integer(place, 0, 99) for place in places]


@pytest.mark.parametrize("transmission_type", [254, 255])
def test_event_driven_rpdo_is_written_at_once(transmission_type):
    bench = bench_with((CONTROLWORD, TARGET), transmission_type)
    bench.tell(0x202, "1F 00 FE FF FF FF")
    assert values(bench.od, 0x6040, 0x607A) == [0x1F, -2]
    assert bench.host.calls == [("write", bench.now_ns)]


@pytest.mark.parametrize("transmission_type", [0, 1, 240])
def test_synchronous_rpdo_is_written_at_next_sync(transmission_type):
    bench = bench_with((CONTROLWORD, TARGET), transmission_type)
    bench.tell(0x202, "1F 00 E8 03 00 00")
    assert values(bench.od, 0x6040, 0x607A) == [0, 0]
    assert bench.host.calls == []
    bench.wait(3 * MS)
    bench.tell(0x080)
    assert values(bench.od, 0x6040, 0x607A) == [0x1F, 1000]
    assert bench.host.calls == [("write", bench.now_ns), ("sync", bench.now_ns)]
    bench.tell(0x080)  # written once only
    assert bench.host.names() == ["write", "sync", "sync"]


def test_last_rpdo_before_sync_is_written():
    bench = bench_with((TARGET,), 1)
    bench.tell(0x202, "01 00 00 00")
    bench.tell(0x202, "02 00 00 00")
    bench.tell(0x080)
    assert values(bench.od, 0x607A) == [2]


def test_rpdos_of_sync_are_written_before_device_call():
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 1)
    put_pdo(od, 0x1401, (TARGET,), 1)
    bench = Bench(od).operate()
    order: list[int] = []
    for index in (0x6040, 0x607A):
        od.get(index).writer = lambda value: order.append(value) or 0
    bench.tell(0x302, "05 00 00 00")
    bench.tell(0x202, "0F 00")
    bench.tell(0x080)
    assert order == [0x0F, 5]  # in the order of their numbers, not of their arrival
    assert bench.host.names() == ["write", "sync"]


def test_latched_rpdo_is_dropped_on_leaving_operational():
    bench = bench_with((TARGET,), 1)
    bench.tell(0x202, "01 00 00 00")
    bench.tell(0x000, b"\x80\x00")
    bench.tell(0x000, b"\x01\x00")
    bench.tell(0x080)
    assert values(bench.od, 0x607A) == [0]


def test_value_out_of_range_skips_only_its_object():
    bench = bench_with((0x6060_0008, CONTROLWORD), 255)
    bench.tell(0x202, "0B 0F 00")
    assert values(bench.od, 0x6060, 0x6040) == [0, 0x0F]
    bench.tell(0x202, "FC 0E 00")
    assert values(bench.od, 0x6060, 0x6040) == [-4, 0x0E]


def test_short_rpdo_is_ignored_with_one_emcy_8210h():
    bench = bench_with((CONTROLWORD, TARGET), 255)
    for _ in range(3):
        bench.tell(0x202, "1F 00 E8 03 00")
    assert values(bench.od, 0x6040, 0x607A) == [0, 0]
    # 8210h, register generic + communication; RPDO 1, 5 bytes received, 6 mapped
    assert bench.frames() == ["082 10 82 11 01 05 06 00 00"]
    bench.tell(0x202, "1F 00 E8 03 00 00")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00"]
    assert values(bench.od, 0x6040, 0x607A) == [0x1F, 1000]


def test_short_rpdo_keeps_latched_one():
    bench = bench_with((TARGET,), 1)
    bench.tell(0x202, "07 00 00 00")
    bench.tell(0x202, "08 00 00")
    bench.tell(0x080)
    assert values(bench.od, 0x607A) == [7]


def test_long_rpdo_uses_mapped_bytes_with_emcy_8220h():
    bench = bench_with((CONTROLWORD,), 255)
    bench.tell(0x202, "0F 00 AA BB CC DD EE FF")
    assert values(bench.od, 0x6040) == [0x0F]
    # As a Roboteq drive reports it (node 12): 8220h, 1001h = 11h; ours adds RPDO and lengths
    assert bench.frames() == ["082 20 82 11 01 08 02 00 00"]
    bench.tell(0x202, "0F")  # now too short: replaced by another error
    assert bench.frames() == ["082 10 82 11 01 01 02 00 00"]
    bench.tell(0x202, "0F 00")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00"]


@pytest.mark.pure("compiled cores take no stand-in")
@pytest.mark.parametrize(("bits", "is_one"), [(0, False), (1, True), (2, False)])
def test_dummy_of_a_boolean_has_one_bit(bits, is_one):
    od = SimpleNamespace(dummies=(1,))
    assert is_dummy(0x0001_0000 | bits, od) is is_one


def test_dummy_skips_its_bytes():
    bench = bench_with((0x0006_0010, TARGET), 255)  # CiA 301: 0006h is UNSIGNED16
    bench.tell(0x202, "AA BB 05 00 00 00")
    assert values(bench.od, 0x607A) == [5]


def test_bits_24_bit_integers_and_reals_are_unpacked():
    entries = (0x2003_0001, 0x2004_0018, 0x2005_0020)
    bench = bench_with(entries, 255)
    # by hand: bit 0 = 1; bits 1..24 = -2 (FFFFFEh); bits 25..56 = 1.5 (3FC00000h)
    payload = 1 | 0xFF_FFFE << 1 | 0x3FC0_0000 << 25
    bench.tell(0x202, payload.to_bytes(8, "little"))
    assert values(bench.od, 0x2003, 0x2004) == [1, -2]
    assert bench.od.get(0x2005).value == 1.5


def test_rpdo_with_invalid_cob_id_does_not_exist():
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255, cob_id=0x8000_0202)
    bench = Bench(od).operate()
    assert 0x202 not in bench.node.identifiers()
    bench.tell(0x202, "0F 00")
    assert values(od, 0x6040) == [0]


def test_two_rpdos_may_share_identifier():
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255, cob_id=0x333)
    put_pdo(od, 0x1401, (0x0006_0010, TARGET), 255, cob_id=0x333)
    bench = Bench(od).operate()
    bench.tell(0x333, "0F 00 05 00 00 00")
    assert values(od, 0x6040, 0x607A) == [0x0F, 5]


def test_missing_cob_id_uses_predefined_identifier():
    od = dictionary()
    for number in range(5):
        put_pdo(od, 0x1400 + number, (CONTROLWORD,))
    bench = Bench(od).boot()
    # CiA 301, predefined connection set: 200h, 300h, 400h, 500h + node-ID; a fifth has none
    assert list(bench.node.identifiers())[2:6] == [0x202, 0x302, 0x402, 0x502]
    assert bench.ask("40 00 14 01 00 00 00 00") == "43 00 14 01 02 02 00 00"
    assert bench.ask("40 04 14 01 00 00 00 00") == "43 04 14 01 00 00 00 80"


def test_invalid_mapping_entry_is_reported_and_skipped():
    od = dictionary()
    put_pdo(od, 0x1400, (0x5555_0010, CONTROLWORD))
    bench = Bench(od)
    events = bench.node.take_events()
    assert [level for level, _ in events] == ["warning"]
    assert events[0][1].startswith("RPDO 1 maps 55550010h, which cannot be (06020000h)")
    bench.operate()
    bench.tell(0x202, "AA BB 0F 00")
    assert values(od, 0x6040) == [0x0F]


def test_vendor_mapping_of_other_length_holds_lower_bits():
    # as Elmo maps UNSIGNED64 2012h in 32 bits, and Roboteq INTEGER16 2100h in 32 bits
    bench = bench_with((0x2006_0020, 0x6060_0010), 255)
    bench.tell(0x202, "FF FF FF FF FC FF")
    assert values(bench.od, 0x2006, 0x6060) == [0xFFFF_FFFF, -4]
    for index, subindex, value, size in (
        (0x1400, 1, 0x8000_0202, 4),
        (0x1600, 0, 0, 1),
        (0x1600, 1, 0x2006_0020, 4),  # the device's own mapping may be written again
        (0x1600, 0, 2, 1),
    ):
        assert bench.download(index, subindex, value, size) == ""
    assert bench.download(0x1600, 0, 0, 1) == ""
    assert bench.download(0x1600, 1, 0x2006_0010, 4) == "0604 0041"  # not its own entry
