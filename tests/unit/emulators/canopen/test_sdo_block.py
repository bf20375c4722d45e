"""SDO block transfer, byte by byte (CiA 301, 7.2.4.3.9 to 7.2.4.3.16)."""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.canopen.sdo_server import BlockDownload, BlockUpload, block_crc
from tests.support.canopen.node_bench import Bench

NAME = b"motorhil bench"  # 1008h of the bench


def ask(bench, text):
    """Return all responses."""
    return bench.ask_all(text)


def test_crc_equals_catalogue_check_value():
    """CRC-16/XMODEM (polynomial 1021h, initial 0): its check value."""
    assert block_crc(b"123456789") == 0x31C3
    assert block_crc(b"") == 0


def test_name_is_uploaded_in_blocks_of_two_segments():
    bench = Bench().boot()
    name = bytes(bench.od.get(0x1008).upload())
    size = len(name)
    assert ask(bench, "A4 08 10 00 02 00 00 00") == [f"C6 08 10 00 {size:02X} 00 00 00"]
    first = ask(bench, "A3 00 00 00 00 00 00 00")
    assert [one[:2] for one in first] == ["01", "02"] if size > 14 else ["01", "82"]
    told = b"".join(bytes.fromhex(one)[1:] for one in first)
    assert told == name[:14].ljust(14, b"\0")


def upload(bench, block_size, lose=()):
    """Upload 1008h in blocks as a client that loses these frames (counted over the transfer)."""
    said = ask(bench, f"A4 08 10 00 {block_size:02X} 00 00 00")
    size = int.from_bytes(bytes.fromhex(said[0])[4:8], "little")
    frames = ask(bench, "A3 00 00 00 00 00 00 00")
    got, count = b"", 0
    while True:
        good, is_last = 0, False
        for one in map(bytes.fromhex, frames):
            count += 1
            if count in lose:
                continue
            if one[0] & 0x7F == good + 1:
                good += 1
                got += one[1:]
                is_last = bool(one[0] & 0x80)
        frames = ask(bench, f"A2 {good:02X} {block_size:02X} 00 00 00 00 00")
        if is_last:
            break
    (end,) = map(bytes.fromhex, frames)
    assert end[0] & 0xE3 == 0xC1
    data = got[: len(got) - (end[0] >> 2 & 7)]
    assert len(data) == size
    assert int.from_bytes(end[1:3], "little") == block_crc(data)
    assert ask(bench, "A1 00 00 00 00 00 00 00") == []
    return data


@pytest.mark.parametrize("block_size", [1, 2, 3, 127])
@pytest.mark.parametrize("lose", [(), (1,), (2,), (1, 2)])
def test_lost_segments_are_sent_again(block_size, lose):
    bench = Bench().boot()
    assert upload(bench, block_size, lose) == bytes(bench.od.get(0x1008).upload())
    assert bench.ask("40 18 10 01 00 00 00 00") == "43 18 10 01 04 00 00 00"


def test_short_value_below_threshold_is_uploaded_plainly():
    """Protocol switch threshold 4 bytes."""
    bench = Bench().boot()
    assert ask(bench, "A4 18 10 01 7F 04 00 00") == ["43 18 10 01 04 00 00 00"]
    assert ask(bench, "A4 18 10 01 7F 03 00 00") == ["C6 18 10 01 04 00 00 00"]


def download(bench, data, *, unused=None, crc=None, sized=True):
    """Download to 2001h and return the last response."""
    size = len(data) if sized else 0
    head = "C6" if sized else "C4"
    begun = ask(bench, f"{head} 01 20 00 {size.to_bytes(4, 'little').hex(' ')}")
    assert begun == ["A4 01 20 00 7F 00 00 00"]
    parts = [data[at : at + 7] for at in range(0, len(data), 7)]
    for number, part in enumerate(parts, 1):
        last = 0x80 if number == len(parts) else 0
        place = (number - 1) % 127 + 1  # a block has 127 segments
        said = ask(bench, bytes([place | last, *part.ljust(7, b"\0")]).hex(" "))
        assert said == ([f"A2 {place:02X} 7F 00 00 00 00 00"] if last or place == 127 else [])
    unused = -len(data) % 7 if unused is None else unused
    crc = block_crc(data) if crc is None else crc
    end = bytes([0xC1 | unused << 2, *crc.to_bytes(2, "little"), 0, 0, 0, 0, 0])
    (answer,) = ask(bench, end.hex(" "))
    return answer


@pytest.mark.parametrize("sized", [True, False])
@pytest.mark.parametrize("data", [b"1", b"1234567", b"12345678", bytes(range(100)), bytes(900)])
def test_block_download_is_accepted(data, sized):
    bench = Bench().boot()
    assert download(bench, data, sized=sized) == "A1 00 00 00 00 00 00 00"
    assert bench.od.get(0x2001).value == data


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"crc": 0x1234}, "0504 0004"),
        ({"unused": 5, "crc": block_crc(b"12345678901"[:9])}, "0607 0013"),
        ({"unused": 2, "crc": block_crc(b"12345678901\0")}, "0607 0012"),
    ],
)
def test_block_download_with_wrong_data_is_aborted(wrong, code):
    bench = Bench().boot()
    before = bench.od.get(0x2001).value
    answer = bytes.fromhex(download(bench, b"12345678901", **wrong))
    assert answer[0] == 0x80
    assert answer[4:8] == bytes.fromhex(code)[::-1]
    assert bench.od.get(0x2001).value == before


@pytest.mark.parametrize("number", [0x00, 0x80])
def test_segment_number_0_aborts_and_80h_ends_transfer(number):
    """80h is an abort of the client; number 0 is invalid: 0504 0003h."""
    bench = Bench().boot()
    ask(bench, "C6 01 20 00 0A 00 00 00")
    said = ask(bench, f"{number:02X} 00 00 00 00 00 00 00")
    assert said == ([] if number else ["80 01 20 00 03 00 04 05"])
    assert bench.ask("40 18 10 01 00 00 00 00") == "43 18 10 01 04 00 00 00"


def test_excess_data_are_refused_on_arrival():
    bench = Bench().boot()
    ask(bench, "C6 01 20 00 03 00 00 00")
    assert ask(bench, "01 31 32 33 34 35 36 37") == []
    assert ask(bench, "02 31 32 33 34 35 36 37") == ["80 01 20 00 12 00 07 06"]


@given(st.binary(max_size=3000), st.lists(st.integers(0, 600), max_size=20), st.integers(1, 127))
def test_lost_frames_keep_data_complete_and_ordered(data, lost, block_size):
    """Our sender and receiver, and a line that loses frames."""
    incoming = BlockDownload(len(data), True, 1 << 20)
    incoming.block_size = block_size
    outgoing = BlockUpload(data, block_size, True)
    count = repeated = 0
    while not outgoing.is_over():
        good = None
        for head, part in outgoing.block():
            count += 1
            is_end = head & 0x80 or head == block_size
            if count in lost and not is_end:  # the other side waits for the last frame of a block
                repeated += 1
                continue
            good = incoming.segment(head, part.ljust(7, b"\0"))
        assert good is not None
        assert outgoing.confirm(good, block_size) is None
    assert incoming.end(*outgoing.end()) == data
    event(f"lost {min(repeated, 3)}")


START, CONFIRM, END = (
    "A3 00 00 00 00 00 00 00",
    "A2 01 7F 00 00 00 00 00",
    "A1 00 00 00 00 00 00 00",
)


@pytest.mark.parametrize(
    "steps", ["C", "E", "SS", "SE", "SCC", "SCS"], ids=lambda steps: f"initiate-{steps}"
)
def test_block_upload_steps_must_be_in_order(steps):
    """Initiate, start, confirm, end: in another order they are invalid commands (0504 0001h).

    CANopenNode's server (301/CO_SDOserver.c), compiled and given the same requests, aborts as well.
    """
    bench = Bench().boot()
    assert ask(bench, "A4 18 10 01 7F 00 00 00") == ["C6 18 10 01 04 00 00 00"]
    *right, wrong = ({"S": START, "C": CONFIRM, "E": END}[step] for step in steps)
    for request in right:
        (answer,) = ask(bench, request)
        assert not answer.startswith("80")
    assert ask(bench, wrong) == ["80 18 10 01 01 00 04 05"]
    assert ask(bench, START) == ["80 00 00 00 01 00 04 05"]  # no transfer in progress


def test_missing_object_precedes_invalid_block_size():
    """As in CANopenNode's server: the object is checked before the block size."""
    bench = Bench().boot()
    assert ask(bench, "A0 00 5F 00 00 00 00 00") == ["80 00 5F 00 00 00 02 06"]
    assert ask(bench, "A0 18 10 09 80 00 00 00") == ["80 18 10 09 11 00 09 06"]
    assert ask(bench, "A0 08 10 00 00 00 00 00") == ["80 08 10 00 02 00 04 05"]
    assert ask(bench, "A0 08 10 00 80 00 00 00") == ["80 08 10 00 02 00 04 05"]
