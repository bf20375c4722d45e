"""EMCY (CiA 301, 7.2.7): the message, the error register 1001h and the history 1003h."""

from tests.emulators.canopen.bench_node import Bench


def report(bench: Bench, code: int, register: int, vendor: bytes = b"") -> list[str]:
    bench.node.emergency(code, register, vendor, bench.now_ns)
    bench.drain()
    return bench.frames()


def test_an_emergency_carries_code_register_and_vendor_bytes():
    # CiA 301, 7.2.7.3: bytes 0-1 code, 2 error register (1001h), 3-7 manufacturer-specific.
    # A Faulhaber drive sends 11 86 20 02 .. for a following error; the standard asks for bit 0 too.
    bench = Bench().boot()
    assert report(bench, 0x8611, 0x20, b"\x02") == ["082 11 86 21 02 00 00 00 00"]
    assert bench.od.integer(0x1001, 0, 0) == 0x21
    assert bench.ask("40 01 10 00 00 00 00 00") == "4F 01 10 00 21 00 00 00"


def test_an_error_reset_clears_the_register():
    bench = Bench().boot()
    report(bench, 0x8611, 0x20)
    assert report(bench, 0x0000, 0x00) == ["082 00 00 00 00 00 00 00 00"]
    assert bench.od.integer(0x1001, 0, 1) == 0


def test_vendor_bytes_beyond_five_are_cut():
    bench = Bench().boot()
    assert report(bench, 0xFF01, 0x80, bytes(range(1, 9))) == ["082 01 FF 81 01 02 03 04 05"]


def test_the_history_holds_the_newest_first_and_forgets_the_oldest():
    bench = Bench().boot()
    for code in (0x2310, 0x3210, 0x4310, 0x8611):
        report(bench, code, 0x01, b"\x34\x12")
    history = [bench.od.integer(0x1003, sub, 0) for sub in range(4)]
    assert history == [3, 0x1234_8611, 0x1234_4310, 0x1234_3210]


def test_an_error_reset_is_no_entry_of_the_history():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    report(bench, 0x0000, 0x00)
    assert bench.od.integer(0x1003, 0, 0) == 1


def test_an_empty_place_of_the_history_is_no_data():
    bench = Bench().boot()
    assert bench.ask("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"
    report(bench, 0x2310, 0x02)
    assert bench.ask("40 03 10 01 00 00 00 00") == "43 03 10 01 10 23 00 00"
    assert bench.ask("40 03 10 02 00 00 00 00") == "80 03 10 02 24 00 00 08"


def test_writing_zero_clears_the_history_and_nothing_else_may_be_written():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    assert bench.download(0x1003, 0, 1, 1) == "0609 0030"
    assert bench.download(0x1003, 0, 0, 1) == ""
    assert bench.ask("40 03 10 00 00 00 00 00") == "4F 03 10 00 00 00 00 00"
    assert bench.ask("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"


def test_an_emcy_identifier_is_changed_only_by_way_of_invalid():
    bench = Bench().boot()
    assert bench.download(0x1014, 0, 0x0000_0099, 4) == "0609 0030"  # exists: bit 31 first
    assert bench.download(0x1014, 0, 0x8000_0082, 4) == ""
    assert report(bench, 0x2310, 0x02) == []  # it does not exist now
    assert bench.download(0x1014, 0, 0x0000_0601, 4) == "0609 0030"  # SDO's own
    assert bench.download(0x1014, 0, 0x2000_0099, 4) == "0609 0030"  # 29-bit
    assert bench.download(0x1014, 0, 0x0000_0099, 4) == ""
    assert report(bench, 0x2310, 0x02) == ["099 10 23 03 00 00 00 00 00"]


def test_an_error_while_stopped_is_not_sent_but_kept():
    bench = Bench().boot()
    bench.tell(0x000, b"\x02\x00")
    assert report(bench, 0x2310, 0x02) == []
    bench.tell(0x000, b"\x80\x00")
    assert bench.frames() == []
    assert bench.od.integer(0x1001, 0, 0) == 0x03
    assert bench.od.integer(0x1003, 1, 0) == 0x2310


def test_reset_node_forgets_errors_reset_communication_keeps_the_device_s():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    bench.tell(0x000, b"\x82\x00")
    assert bench.od.integer(0x1001, 0, 0) == 0x03
    bench.wait(50_000_000)
    bench.tell(0x000, b"\x81\x00")
    assert bench.od.integer(0x1001, 0, 1) == 0
