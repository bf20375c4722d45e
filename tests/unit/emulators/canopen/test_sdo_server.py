"""SDO transcripts: '>' is the client, '<' this server.

Transcripts marked "canopen" have the bytes of canopen's own test/test_sdo.py (commit 03cee341),
which took most of them from canopensolutions.com. The others follow CiA 301, 7.2.4.3.
"""

import pytest

from tests.support.canopen.node_bench import MS, Bench, abort_code, transcript


def test_expedited_upload():  # canopen
    transcript(
        Bench().boot(),
        """
        > 40 18 10 01 00 00 00 00
        < 43 18 10 01 04 00 00 00
        """,
    )


def test_expedited_upload_of_1_and_2_bytes_has_size():
    transcript(
        Bench().boot(),
        """
        > 40 18 10 00 00 00 00 00
        < 4F 18 10 00 01 00 00 00
        > 40 41 60 00 00 00 00 00
        < 4B 41 60 00 40 02 00 00
        """,
    )


def test_expedited_download():  # canopen
    bench = Bench().boot()
    transcript(
        bench,
        """
        > 2B 17 10 00 A0 0F 00 00
        < 60 17 10 00 00 00 00 00
        """,
    )
    assert bench.od.integer(0x1017, 0, 0) == 4000


def test_expedited_download_without_size_uses_object_length():
    bench = Bench().boot()
    transcript(
        bench,
        """
        > 22 17 10 00 A0 0F FF FF
        < 60 17 10 00 00 00 00 00
        """,
    )
    assert bench.od.integer(0x1017, 0, 0) == 4000


def test_expedited_download_without_size_to_a_string_is_of_four_bytes():
    bench = Bench().boot()
    bench.od.get(0x1008, 0).access = "rw"
    transcript(
        bench,
        """
        > 22 08 10 00 54 69 6E 79
        < 60 08 10 00 00 00 00 00
        > 40 08 10 00 00 00 00 00
        < 43 08 10 00 54 69 6E 79
        """,
    )


def test_segmented_upload():  # canopen
    transcript(
        Bench().boot(),
        """
        > 40 08 10 00 00 00 00 00
        < 41 08 10 00 1A 00 00 00
        > 60 00 00 00 00 00 00 00
        < 00 54 69 6E 79 20 4E 6F
        > 70 00 00 00 00 00 00 00
        < 10 64 65 20 2D 20 4D 65
        > 60 00 00 00 00 00 00 00
        < 00 67 61 20 44 6F 6D 61
        > 70 00 00 00 00 00 00 00
        < 15 69 6E 73 20 21 00 00
        """,
    )


def test_segmented_download():  # canopen, but the reserved bytes of a response are 0 (CiA 301)
    bench = Bench().boot()
    transcript(
        bench,
        """
        > 21 00 20 00 0D 00 00 00
        < 60 00 20 00 00 00 00 00
        > 00 41 20 6C 6F 6E 67 20
        < 20 00 00 00 00 00 00 00
        > 13 73 74 72 69 6E 67 00
        < 30 00 00 00 00 00 00 00
        """,
    )
    assert bench.od.get(0x2000).value == b"A long string"


def test_empty_segmented_download():  # canopen
    bench = Bench().boot()
    bench.od.get(0x2000).value = b"before"
    transcript(
        bench,
        """
        > 21 00 20 00 00 00 00 00
        < 60 00 20 00 00 00 00 00
        > 0F 00 00 00 00 00 00 00
        < 20 00 00 00 00 00 00 00
        """,
    )
    assert bench.od.get(0x2000).value == b""


def test_empty_segmented_upload_is_one_last_segment():
    transcript(
        Bench().boot(),
        """
        > 40 00 20 00 00 00 00 00
        < 41 00 20 00 00 00 00 00
        > 60 00 00 00 00 00 00 00
        < 0F 00 00 00 00 00 00 00
        > 70 00 00 00 00 00 00 00 -- it is over
        < 80 00 00 00 01 00 04 05
        """,
    )


@pytest.mark.parametrize("length", [1, 4])
def test_short_string_is_uploaded_expedited(length):
    bench = Bench().boot()
    bench.od.get(0x2000).value = b"abcd"[:length]
    response = bytes.fromhex(bench.ask("40 00 20 00 00 00 00 00"))
    assert response[0] == 0x43 | (4 - length) << 2
    assert response[4 : 4 + length] == b"abcd"[:length]


@pytest.mark.parametrize("length", [5, 6, 7, 8, 13, 14, 15, 889])
def test_segments_carry_every_length(length):
    bench = Bench().boot()
    data = bytes(position & 0xFF for position in range(length))
    bench.ask("21 01 20 00" + length.to_bytes(4, "little").hex())
    toggle = 0
    for start in range(0, length, 7):
        part = data[start : start + 7]
        is_last = start + 7 >= length
        command = toggle | (7 - len(part)) << 1 | is_last
        assert (
            bench.ask((bytes((command,)) + part.ljust(7, b"\0")).hex())[:2] == f"{0x20 | toggle:X}"
        )
        toggle ^= 0x10
    assert bench.od.get(0x2001).value == data

    assert bench.ask("40 01 20 00 00 00 00 00")[:2] == "41"
    received = b""
    toggle = 0
    while len(received) < length:
        response = bytes.fromhex(bench.ask(f"{0x60 | toggle:02X} 00 00 00 00 00 00 00"))
        assert response[0] & 0x10 == toggle
        received += response[1 : 8 - (response[0] >> 1 & 7)]
        assert bool(response[0] & 1) == (len(received) == length)
        toggle ^= 0x10
    assert received == data


@pytest.mark.parametrize(
    ("request_bytes", "code"),
    [
        ("40 34 12 00 00 00 00 00", "0602 0000"),  # upload: no such object
        ("40 18 10 07 00 00 00 00", "0609 0011"),  # upload: no such sub-index
        ("40 02 20 00 00 00 00 00", "0601 0001"),  # upload of a write-only object
        ("2F 34 12 00 00 00 00 00", "0602 0000"),  # download: no such object
        ("2F 18 10 07 00 00 00 00", "0609 0011"),
        ("23 18 10 01 00 00 00 00", "0601 0002"),  # download to ro
        ("21 08 10 00 01 00 00 00", "0601 0002"),  # download to const, segmented
        ("21 34 12 00 01 00 00 00", "0602 0000"),
        ("2F 17 10 00 00 00 00 00", "0607 0013"),  # one byte for an UNSIGNED16
        ("23 17 10 00 00 00 00 00", "0607 0012"),  # four bytes for an UNSIGNED16
        ("21 17 10 00 03 00 00 00", "0607 0012"),
        ("21 17 10 00 01 00 00 00", "0607 0013"),
        ("21 01 20 00 01 00 10 00", "0504 0005"),  # one byte more than the memory limit
        ("2F 60 60 00 0B 00 00 00", "0609 0031"),  # 6060h is -4..10
        ("2F 60 60 00 FB 00 00 00", "0609 0032"),
        ("C6 08 10 00 1E 00 00 00", "0601 0002"),  # block download to const
        ("C6 17 10 00 03 00 00 00", "0607 0012"),
        ("C6 01 20 00 01 00 10 00", "0504 0005"),
        ("C1 00 00 00 00 00 00 00", "0504 0001"),  # the end of a block download without a transfer
        ("A4 34 12 00 7F 00 00 00", "0602 0000"),  # block upload: no such object
        ("A4 08 10 00 00 00 00 00", "0504 0002"),  # in blocks of 0
        ("A4 08 10 00 80 00 00 00", "0504 0002"),  # in blocks of 128
        ("A3 00 00 00 00 00 00 00", "0504 0001"),  # the start without an initiate
        ("A2 00 00 00 00 00 00 00", "0504 0001"),
        ("E0 08 10 00 00 00 00 00", "0504 0001"),  # no command specifier at all
        ("60 00 00 00 00 00 00 00", "0504 0001"),  # a segment without a transfer
        ("00 41 20 6C 6F 6E 67 20", "0504 0001"),
    ],
)
def test_wrong_access_is_aborted_with_code(request_bytes, code):
    bench = Bench().boot()
    response = bench.ask(request_bytes)
    assert abort_code(response) == code
    specifier = int(request_bytes[:2], 16) >> 5
    mux = "00 00 00" if specifier in (0, 3, 7) else request_bytes[3:11]
    assert response[3:11] == mux
    assert bench.ask("40 18 10 01 00 00 00 00") == "43 18 10 01 04 00 00 00"  # and still works


def test_range_limits_are_accepted():
    bench = Bench().boot()
    assert bench.download(0x6060, 0, -4, 1) == ""
    assert bench.download(0x6060, 0, 10, 1) == ""


def test_writer_refusal_keeps_value():
    bench = Bench().boot()
    asked = []
    variable = bench.od.get(0x607A)
    variable.value = 7

    def writer(value: int) -> int:
        asked.append((value, variable.value))
        return 0x0800_0022

    variable.writer = writer
    assert bench.download(0x607A, 0, -5, 4) == "0800 0022"
    assert (asked, variable.value) == ([(-5, 7)], 7)
    assert "write" not in bench.host.names()


def test_repeated_toggle_bit_aborts_transfer():
    transcript(
        Bench().boot(),
        """
        > 40 08 10 00 00 00 00 00
        < 41 08 10 00 1A 00 00 00
        > 60 00 00 00 00 00 00 00
        < 00 54 69 6E 79 20 4E 6F
        > 60 00 00 00 00 00 00 00
        < 80 08 10 00 00 00 03 05
        > 70 00 00 00 00 00 00 00
        < 80 00 00 00 01 00 04 05
        > 21 00 20 00 0D 00 00 00
        < 60 00 20 00 00 00 00 00
        > 10 41 20 6C 6F 6E 67 20
        < 80 00 20 00 00 00 03 05
        """,
    )


def test_client_abort_ends_transfer_without_response():
    bench = Bench().boot()
    assert bench.ask("21 00 20 00 0D 00 00 00") == "60 00 20 00 00 00 00 00"
    assert bench.ask("80 00 20 00 00 00 00 08") == ""
    assert abort_code(bench.ask("00 41 20 6C 6F 6E 67 20")) == "0504 0001"
    assert bench.od.get(0x2000).value == b""


def test_new_request_replaces_unfinished_transfer():
    transcript(
        Bench().boot(),
        """
        > 40 08 10 00 00 00 00 00
        < 41 08 10 00 1A 00 00 00
        > 40 18 10 01 00 00 00 00
        < 43 18 10 01 04 00 00 00
        > 60 00 00 00 00 00 00 00
        < 80 00 00 00 01 00 04 05
        """,
    )


@pytest.mark.parametrize(
    ("announced", "command", "code"),
    [(8, "07", "0607 0013"), (3, "07", "0607 0012")],  # one segment with 4 bytes
)
def test_download_of_unannounced_length_is_aborted(announced, command, code):
    bench = Bench().boot()
    bench.ask(f"21 00 20 00 {announced:02X} 00 00 00")
    assert abort_code(bench.ask(f"{command} 61 62 63 64 00 00 00")) == code
    assert bench.od.get(0x2000).value == b""


def test_number_may_be_downloaded_in_segments():
    bench = Bench().boot()
    transcript(
        bench,
        """
        > 20 17 10 00 00 00 00 00 -- size not indicated
        < 60 17 10 00 00 00 00 00
        > 0B E8 03 00 00 00 00 00
        < 20 00 00 00 00 00 00 00
        """,
    )
    assert bench.od.integer(0x1017, 0, 0) == 1000
    bench.ask("20 17 10 00 00 00 00 00")
    assert abort_code(bench.ask("09 E8 03 00 00 00 00 00")) == "0607 0012"  # three bytes


def test_response_leaves_one_reply_time_after_request():
    bench = Bench().boot()
    bench.tell(0x602, "40 18 10 01 00 00 00 00")
    assert bench.node.next_deadline_ns() == 301 * MS
    bench.run(300 * MS + 400_000)
    bench.tell(0x602, "40 18 10 00 00 00 00 00")
    bench.run(301 * MS - 1)
    assert bench.heard() == []
    bench.run(302 * MS)
    assert bench.heard() == [
        (301 * MS, "582 43 18 10 01 04 00 00 00"),
        (301 * MS + 400_000, "582 4F 18 10 00 01 00 00 00"),
    ]
    assert bench.node.next_deadline_ns() is None


@pytest.mark.parametrize("command", [0x02, 0x82])
def test_response_is_dropped_when_node_stops(command):
    bench = Bench().boot()
    bench.tell(0x602, "40 18 10 01 00 00 00 00")
    bench.tell(0x000, bytes((command, 0)))
    bench.wait(500 * MS)  # boots
    bench.tell(0x000, bytes((0x80, 0)))
    assert all(one.startswith("702") for one in bench.frames())
    bench.tell(0x602, "40 18 10 00 00 00 00 00")
    bench.wait(10 * MS)
    assert bench.frames() == ["582 4F 18 10 00 01 00 00 00"]


def test_zero_reply_time_responds_at_once():
    bench = Bench(sdo_reply_ns=0).boot()
    bench.tell(0x602, "40 18 10 01 00 00 00 00")
    assert bench.frames() == ["582 43 18 10 01 04 00 00 00"]


@pytest.mark.parametrize("length", [0, 4, 7])
def test_request_shorter_than_8_bytes_is_ignored(length):
    bench = Bench().boot()
    bench.tell(0x602, bytes.fromhex("4018100100000000")[:length])
    bench.wait(10 * MS)
    assert bench.frames() == []


def test_reader_value_is_of_request_time():
    bench = Bench().boot()
    bench.od.get(0x6064).reader = lambda: -2
    assert bench.ask("40 64 60 00 00 00 00 00") == "43 64 60 00 FE FF FF FF"
    assert bench.host.calls == [("read", 300 * MS)]


def test_reader_value_wider_than_object_is_cut():
    bench = Bench().boot()
    bench.od.get(0x6064).reader = lambda: (1 << 31) + 5  # a position that has wrapped
    assert bench.ask("40 64 60 00 00 00 00 00") == "43 64 60 00 05 00 00 80"
