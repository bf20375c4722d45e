"""SDO on the wire: canopen's client, and unusual requests.

Aborts and their codes: CiA 301, 7.2.4.3.17 (table 22). Transfers: 7.2.4.3.
"""

import pytest

from tests.crosscheck.conftest import aborted
from tests.support.canopen.drive_wire import MS, US, Wire

NAME = b"motorhil CiA 402 drive"


def place(answer: str) -> str:
    """Return index and sub-index of a response, in their wire format."""
    return answer[6:12]


def test_canopen_reads_identity_and_segmented_name(connected):
    _, _, node = connected
    assert node.sdo[0x1000].raw == 0x0002_0192  # 402, servo drive
    assert node.sdo[0x1018][2].raw == 0x402
    assert node.sdo[0x1008].raw == NAME.decode()
    assert node.sdo[0x1009].raw == "emulated"


def test_canopen_writes_number_in_segments_and_reads_it_back(connected):
    wire, _, node = connected
    count = len(wire.log)
    node.sdo.download(0x607A, 0, (-123456).to_bytes(4, "little", signed=True), force_segment=True)
    assert [text for _, _, text in wire.log[count:]] == [
        "605#217A600004000000",
        "585#607A600000000000",
        "605#07C01DFEFF000000",  # toggle 0, three bytes unused, last
        "585#2000000000000000",
    ]
    assert node.sdo[0x607A].raw == -123456


def test_segmented_upload_is_exact_byte_by_byte(wire):
    answers = [wire.ask("605#4008100000000000")]
    for toggle in (0x60, 0x70, 0x60, 0x70):
        answers.append(wire.ask(f"605#{toggle:02X}00000000000000"))
    assert answers[0] == "585#4108100016000000"  # 22 bytes follow
    data = b"".join(bytes.fromhex(text[6:]) for text in answers[1:])
    assert data == NAME.ljust(28, b"\0")
    assert [text[4:6] for text in answers[1:]] == ["00", "10", "00", "1D"]  # 6 unused, last


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("605#4000200000000000", 0x0602_0000),  # no such object
        ("605#4018100900000000", 0x0609_0011),  # no such sub-index
        ("605#2F00100001000000", 0x0601_0002),  # read-only
        ("605#2B41600001000000", 0x0601_0002),
        ("605#2F18100004000000", 0x0601_0002),  # const
        ("605#2F00200000000000", 0x0602_0000),
        ("605#2B7A600001000000", 0x0607_0013),  # two bytes for INTEGER32
        ("605#2340600006000000", 0x0607_0012),  # four for UNSIGNED16
        ("605#2F60600002000000", 0x0609_0030),  # a mode that is not in 6502h
        ("605#2F29100103000000", 0x0609_0031),  # above the high limit
        ("605#2306100032000000", 0x0609_0032),  # below the low limit
        ("605#2B86600001000000", 0x0609_0030),  # only the linear profile exists
        ("605#2B5A600009000000", 0x0609_0030),  # the standard does not define this option
        ("605#2B5D600000000000", 0x0609_0030),
        ("605#2F03100001000000", 0x0609_0030),  # the history takes only 0
        ("605#4003100100000000", 0x0800_0024),  # no error so far
        ("605#2F00160001000000", 0x0601_0000),  # a PDO that exists keeps its mapping
        ("605#2F021400FB000000", 0x0601_0002),  # sub-index 0 of 1402h is not a transmission type
        ("605#2F021402FB000000", 0x0609_0030),  # 251 is reserved
        ("605#23001401E1010000", 0x0609_0030),  # another identifier while it exists
        ("605#2305100080000020", 0x0609_0030),  # 29 bits: it has base frames only
        ("605#A018100100000000", 0x0504_0002),  # block upload in blocks of 0
        ("605#C218100104000000", 0x0601_0002),  # block download to a read-only object
        ("605#E000000000000000", 0x0504_0001),  # no command specifier at all
        ("605#6000000000000000", 0x0504_0001),  # a segment without a transfer
        ("605#0000000000000000", 0x0504_0001),
        ("605#2118100104000000", 0x0601_0002),  # segmented to a read-only object
        ("605#2140600003000000", 0x0607_0012),  # segmented, announcing too much
    ],
)
def test_wrong_access_is_aborted_with_standard_code(wire, request_, code):
    answer = wire.ask(request_)
    assert answer[4:6] == "80"
    assert int.from_bytes(bytes.fromhex(answer[12:]), "little") == code
    if request_[4:6] not in ("60", "00", "E0"):  # these name no object
        assert place(answer) == place(request_)
    assert wire.ask("605#4000100000000000") == "585#4300100092010200"  # and the server still works


@pytest.mark.parametrize("first", ["605#4008100000000000", "605#2108100016000000"])
def test_repeated_toggle_bit_aborts_transfer(wire, first):
    if first.startswith("605#21"):
        first = "605#217A600004000000"
        segment = "605#17C01DFEFF000000"
    else:
        segment = "605#7000000000000000"
    wire.ask(first)
    answer = wire.ask(segment)
    assert answer == f"585#80{place(first)}00000305"
    assert wire.ask(segment)[12:] == "01000405"  # there is no transfer any more


def test_client_abort_ends_transfer_without_response(wire):
    wire.ask("605#4008100000000000")
    assert wire.ask("605#8008100000000405") == ""
    assert wire.ask("605#6000000000000000")[12:] == "01000405"


def test_second_initiate_replaces_first(wire):
    wire.ask("605#4008100000000000")
    assert wire.ask("605#4000100000000000") == "585#4300100092010200"
    assert wire.ask("605#6000000000000000")[12:] == "01000405"


def test_wrong_number_of_segments_is_aborted(wire):
    wire.ask("605#217A600004000000")
    assert wire.ask("605#0001020304050607")[12:] == "12000706"
    wire.ask("605#217A600004000000")
    assert wire.ask("605#0B01000000000000")[12:] == "13000706"  # two bytes, and last
    assert wire.read(0x607A) == 0


@pytest.mark.parametrize("text", ["605#40001000000000", "605#", "605#R8", "606#4000100000000000"])
def test_foreign_frame_gets_no_response(wire, text):
    count = len(wire.log)
    wire.tell(text)
    wire.run(10 * MS)
    assert wire.since(count) == []


def test_response_comes_one_ms_and_one_frame_after_request(wire):
    wire.ask("605#4041600000000000")
    (request, _, _), (answer, _, text) = wire.log[-2:]
    assert text == "585#4B41600050020000"
    assert 1 * MS + 108 * US <= answer - request <= 1 * MS + 132 * US  # 8 bytes: 111..135 bits


def test_response_delay_comes_from_rig():
    wire = Wire({"node_id": 5, "timing": {"sdo_reply_s": 0.007}}).boot()
    wire.ask("605#4041600000000000")
    assert 7 * MS < wire.log[-1][0] - wire.log[-2][0] < 7.2 * MS


def test_canopen_sees_same_codes(connected):
    _, _, node = connected
    assert aborted(lambda: node.sdo.upload(0x2000, 0)) == 0x0602_0000
    assert aborted(lambda: node.sdo.download(0x1000, 0, b"\0\0\0\0")) == 0x0601_0002
    assert aborted(lambda: node.sdo.download(0x6040, 0, b"\0")) == 0x0607_0013
    with pytest.raises(Exception, match="0x06020000"):
        node.sdo.open(0x2000, block_transfer=True).read()


def test_canopen_reads_name_in_blocks(connected):
    _, _, node = connected
    plain = node.sdo.upload(0x1008, 0)
    assert len(plain) > 7
    assert node.sdo.open(0x1008, block_transfer=True).read() == plain
