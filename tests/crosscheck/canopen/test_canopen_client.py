"""The client of canopen against our node: SDO, PDO, NMT, EMCY."""

import canopen
import pytest
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.canopen.object_dictionary import DataType, integer_range, is_integer
from tests.support.canopen.client_loop import Loop, raw_of
from tests.support.canopen.node_bench import MS, Bench, dictionary, put, put_pdo

# canopen has no number type for the two times
NUMBERS = [t for t in DataType if is_integer(t) and "TIME" not in t.name]
STATUSWORD, POSITION, CONTROLWORD, TARGET = 0x6041_0010, 0x6064_0020, 0x6040_0010, 0x607A_0020


@pytest.fixture
def loop() -> Loop:
    od = dictionary()
    put_pdo(od, 0x1400, (CONTROLWORD,), 255)
    put_pdo(od, 0x1800, (STATUSWORD,), 255)
    return Loop(Bench(od).boot())


def abort_of(action) -> int:
    with pytest.raises(canopen.SdoAbortedError) as caught:
        action()
    return caught.value.code


def test_client_reads_every_readable_object(loop):
    for ours in loop.bench.od:
        sdo = loop.remote.sdo
        if ours.access == "wo" or (ours.index == 0x1003 and ours.subindex):
            continue
        theirs = sdo[ours.index]
        if ours.subindex or len(loop.bench.od.subindices(ours.index)) > 1:
            theirs = theirs[ours.subindex]
        assert theirs.raw == raw_of(ours.value, ours.data_type), f"{ours.index:04X}"


@pytest.mark.parametrize("data_type", NUMBERS, ids=lambda data_type: data_type.name)
def test_numbers_of_every_type_make_round_trip(data_type):
    od = dictionary()
    put(od, 0x3000, 0, data_type)
    loop = Loop(Bench(od).boot())
    for value in integer_range(data_type):
        loop.remote.sdo[0x3000].raw = value
        assert od.get(0x3000).value == value
        assert loop.remote.sdo[0x3000].raw == value


@given(st.binary(max_size=300))
def test_domain_of_any_length_makes_round_trip(data):
    loop = Loop(Bench().boot())
    loop.remote.sdo.download(0x2001, 0, data, force_segment=True)
    assert loop.bench.od.get(0x2001).value == data
    assert loop.remote.sdo.upload(0x2001, 0) == data


@pytest.mark.parametrize("text", ["", "a", "abcd", "A long string"])
def test_strings_make_round_trip(loop, text):
    loop.remote.sdo[0x2000].raw = text
    assert loop.bench.od.get(0x2000).value == text.encode()
    assert loop.remote.sdo[0x2000].raw == text


def test_client_understands_aborts(loop):
    sdo = loop.remote.sdo
    assert abort_of(lambda: sdo.upload(0x1234, 0)) == 0x0602_0000
    assert abort_of(lambda: sdo.upload(0x1018, 9)) == 0x0609_0011
    assert abort_of(lambda: sdo.upload(0x2002, 0)) == 0x0601_0001
    assert abort_of(lambda: sdo.download(0x1018, 1, bytes(4))) == 0x0601_0002
    assert abort_of(lambda: sdo.download(0x1008, 0, b"longer than four")) == 0x0601_0002
    assert abort_of(lambda: sdo.download(0x6060, 0, b"\x0b")) == 0x0609_0031
    assert abort_of(lambda: sdo.download(0x6060, 0, b"\x01\x00")) == 0x0607_0012


@given(st.binary(min_size=1, max_size=2000))
@example(bytes(7 * 127))
@example(bytes(7 * 127 + 1))
@example(b"1234567")
def test_block_transfers_make_round_trip_with_crc(data):
    loop = Loop(Bench().boot())
    sdo = loop.remote.sdo
    with sdo.open(0x2001, 0, "wb", size=len(data), block_transfer=True) as stream:
        stream.write(data)
    assert loop.bench.od.get(0x2001).value == data
    with sdo.open(0x2001, 0, "rb", block_transfer=True) as stream:
        assert stream.read() == data
    assert sdo.upload(0x1018, 1) == bytes((4, 0, 0, 0))
    event(f"{min(len(data) // 889, 2)} full blocks")


def test_client_maps_tpdo_and_receives_it_at_sync(loop):
    tpdo = loop.remote.tpdo
    tpdo.read()
    assert [variable.index for variable in tpdo[1].map] == [0x6041]
    tpdo[1].clear()
    tpdo[1].add_variable(0x6064)
    tpdo[1].add_variable(0x6041)
    tpdo[1].trans_type = 1
    tpdo[1].inhibit_time = 50
    tpdo[1].event_timer = 0
    tpdo[1].enabled = True
    tpdo[1].save()
    loop.remote.nmt.state = "OPERATIONAL"
    loop.bench.od.get(0x6064).reader = lambda: -123456
    received = []
    tpdo[1].add_callback(lambda pdo: received.append([variable.raw for variable in pdo.map]))
    loop.send_message(0x080, b"")
    assert received == [[-123456, 0x0240]]
    loop.remote.tpdo.read()
    assert [variable.index for variable in tpdo[1].map] == [0x6064, 0x6041]
    assert (tpdo[1].trans_type, tpdo[1].inhibit_time, tpdo[1].enabled) == (1, 50, True)


def test_client_maps_rpdo_with_effect_at_sync(loop):
    rpdo = loop.remote.rpdo
    rpdo.read()
    rpdo[1].clear()
    rpdo[1].add_variable(0x6040)
    rpdo[1].add_variable(0x607A)
    rpdo[1].trans_type = 1
    rpdo[1].enabled = True
    rpdo[1].save()
    loop.remote.nmt.state = "OPERATIONAL"
    rpdo[1][0x6040].raw = 0x1F
    rpdo[1][0x607A].raw = -5
    rpdo[1].transmit()
    assert loop.bench.od.integer(0x607A, 0, 0) == 0
    loop.send_message(0x080, b"")
    assert loop.bench.od.integer(0x607A, 0, 0) == -5
    assert loop.bench.od.integer(0x6040, 0, 0) == 0x1F


def test_client_follows_nmt_state(loop):
    loop.remote.sdo[0x1017].raw = 10
    for state in ("PRE-OPERATIONAL", "OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        if state != "PRE-OPERATIONAL" or loop.remote.nmt.state != state:
            loop.remote.nmt.state = state
        loop.bench.wait(20 * MS)
        loop.deliver()
        assert loop.remote.nmt.state == state


def test_client_understands_emergencies(loop):
    bench = loop.bench
    bench.node.emergency(0x8611, 0x20, b"\x02", bench.now_ns)
    bench.drain()
    loop.deliver()
    (error,) = loop.remote.emcy.active
    assert (error.code, error.register, error.data) == (0x8611, 0x21, b"\x02\0\0\0\0")
    bench.node.emergency(0x0000, 0x00, b"", bench.now_ns)
    bench.drain()
    loop.deliver()
    assert loop.remote.emcy.active == []
