"""EMCY (CiA 301, 7.2.7): message, error register 1001h, history 1003h."""

import pytest

from motorhil.emulators.canopen.nmt import NmtState
from tests.support.canopen.node_bench import (
    MS,
    UNSIGNED8,
    UNSIGNED16,
    Bench,
    dictionary,
    put,
    put_pdo,
)


def report(bench: Bench, code: int, register: int, vendor: bytes = b"") -> list[str]:
    bench.node.emergency(code, register, vendor, bench.now_ns)
    bench.drain()
    return bench.frames()


def test_emergency_carries_code_register_and_vendor_bytes():
    # CiA 301, 7.2.7.3: bytes 0-1 code, 2 error register (1001h), 3-7 manufacturer-specific. A
    # Faulhaber drive sends 11 86 20 02 .. for a following error; the standard requires bit 0 as
    # well.
    bench = Bench().boot()
    assert report(bench, 0x8611, 0x20, b"\x02") == ["082 11 86 21 02 00 00 00 00"]
    assert bench.od.integer(0x1001, 0, 0) == 0x21
    assert bench.ask("40 01 10 00 00 00 00 00") == "4F 01 10 00 21 00 00 00"


def test_error_reset_clears_register():
    bench = Bench().boot()
    report(bench, 0x8611, 0x20)
    assert report(bench, 0x0000, 0x00) == ["082 00 00 00 00 00 00 00 00"]
    assert bench.od.integer(0x1001, 0, 1) == 0


def test_vendor_bytes_beyond_five_are_cut():
    bench = Bench().boot()
    assert report(bench, 0xFF01, 0x80, bytes(range(1, 9))) == ["082 01 FF 81 01 02 03 04 05"]


def test_history_is_newest_first_and_drops_oldest():
    bench = Bench().boot()
    for code in (0x2310, 0x3210, 0x4310, 0x8611):
        report(bench, code, 0x01, b"\x34\x12")
    history = [bench.od.integer(0x1003, sub, 0) for sub in range(4)]
    assert history == [3, 0x1234_8611, 0x1234_4310, 0x1234_3210]


def test_error_reset_is_not_in_history():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    report(bench, 0x0000, 0x00)
    assert bench.od.integer(0x1003, 0, 0) == 1


def test_empty_history_entry_is_no_data():
    bench = Bench().boot()
    assert bench.ask("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"
    report(bench, 0x2310, 0x02)
    assert bench.ask("40 03 10 01 00 00 00 00") == "43 03 10 01 10 23 00 00"
    assert bench.ask("40 03 10 02 00 00 00 00") == "80 03 10 02 24 00 00 08"


def test_history_count_accepts_only_zero_which_clears_it():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    assert bench.download(0x1003, 0, 1, 1) == "0609 0030"
    assert bench.download(0x1003, 0, 0, 1) == ""
    assert bench.ask("40 03 10 00 00 00 00 00") == "4F 03 10 00 00 00 00 00"
    assert bench.ask("40 03 10 01 00 00 00 00") == "80 03 10 01 24 00 00 08"


def test_emcy_cob_id_changes_only_when_invalid():
    bench = Bench().boot()
    assert bench.download(0x1014, 0, 0x0000_0099, 4) == "0609 0030"  # exists: bit 31 first
    assert bench.download(0x1014, 0, 0x8000_0082, 4) == ""
    assert report(bench, 0x2310, 0x02) == []  # it does not exist now
    assert bench.download(0x1014, 0, 0x0000_0601, 4) == "0609 0030"  # the identifier of an SDO
    assert bench.download(0x1014, 0, 0x2000_0099, 4) == "0609 0030"  # 29-bit
    assert bench.download(0x1014, 0, 0x0000_0099, 4) == ""
    assert report(bench, 0x2310, 0x02) == ["099 10 23 03 00 00 00 00 00"]


def test_error_while_stopped_is_kept_not_sent():
    bench = Bench().boot()
    bench.tell(0x000, b"\x02\x00")
    assert report(bench, 0x2310, 0x02) == []
    bench.tell(0x000, b"\x80\x00")
    assert bench.frames() == []
    assert bench.od.integer(0x1001, 0, 0) == 0x03
    assert bench.od.integer(0x1003, 1, 0) == 0x2310


def test_reset_node_forgets_device_errors_unlike_communication():
    bench = Bench().boot()
    report(bench, 0x2310, 0x02)
    bench.tell(0x000, b"\x82\x00")
    assert bench.od.integer(0x1001, 0, 0) == 0x03
    bench.wait(50_000_000)
    bench.tell(0x000, b"\x81\x00")
    assert bench.od.integer(0x1001, 0, 1) == 0


# --- inhibit time (1015h, in 100 us)


def inhibited(units: int) -> Bench:
    od = dictionary()
    put(od, 0x1015, 0, UNSIGNED16, units)
    return Bench(od).boot()


def errors(bench: Bench, *codes: int) -> None:
    for code in codes:
        bench.node.emergency(code, 0x20, b"", bench.now_ns)
    bench.drain()


def test_inhibit_time_separates_emcys_without_loss():
    bench = inhibited(100)  # 10 ms
    errors(bench, 0x8611, 0x7300, 0x3210)
    began_at = bench.now_ns
    bench.wait(100 * MS)
    assert [(at - began_at, text[:9]) for at, text in bench.heard()] == [
        (0, "082 11 86"),
        (10 * MS, "082 00 73"),
        (20 * MS, "082 10 32"),
    ]
    errors(bench, 0x8611)  # long after: sent at once
    assert bench.frames() == ["082 11 86 21 00 00 00 00 00"]
    bench.wait(10 * MS)
    errors(bench, 0x8611)  # exactly at its end: sent at once
    assert len(bench.frames()) == 1
    errors(bench, 0x8611)
    bench.wait(10 * MS - 1)
    assert bench.frames() == []
    bench.wait(1)
    assert len(bench.frames()) == 1


def test_waiting_emcys_are_discarded_on_stop():
    bench = inhibited(100)
    errors(bench, 0x8611, 0x7300)
    bench.tell(0x000, b"\x02\x00")
    bench.frames()
    bench.wait(100 * MS)
    assert bench.frames() == []
    assert bench.node.next_deadline_ns() is None


def test_waiting_emcys_are_sent_when_inhibit_time_is_cleared():
    bench = inhibited(100)
    errors(bench, 0x8611, 0x7300, 0x3210)
    bench.frames()
    bench.tell(0x602, "2B 15 10 00 00 00 00 00")
    errors(bench, 0x1001)  # at the same instant
    bench.wait(2 * MS)
    told = [text[4:9] for text in bench.frames() if text.startswith("082")]
    assert told == ["00 73", "10 32", "01 10"]
    assert bench.node.next_deadline_ns() is None


def test_waiting_emcy_is_due_now_if_new_inhibit_time_is_over():
    bench = inhibited(1000)  # 100 ms
    errors(bench, 0x8611, 0x7300)
    bench.wait(50 * MS)
    bench.frames()
    bench.tell(0x602, "2B 15 10 00 64 00 00 00")  # 10 ms
    assert bench.node.next_deadline_ns() == bench.now_ns  # and not 40 ms ago
    bench.wait(0)
    assert [text[:9] for text in bench.frames() if text.startswith("082")] == ["082 00 73"]


def test_waiting_emcys_use_new_inhibit_time():
    bench = inhibited(1000)  # 100 ms
    errors(bench, 0x8611, 0x7300)
    bench.frames()
    bench.tell(0x602, "2B 15 10 00 64 00 00 00")  # 10 ms
    bench.wait(10 * MS)
    assert [text[:9] for text in bench.frames() if text.startswith("082")] == ["082 00 73"]


def test_too_many_waiting_emcys_drop_oldest_with_event():
    bench = inhibited(10)
    errors(bench, *range(0x1001, 0x1023))  # 34: one leaves, 33 would wait
    bench.wait(100 * MS)
    codes = [int(text[7:9] + text[4:6], 16) for text in bench.frames()]
    assert codes == [0x1001, *range(0x1003, 0x1023)]
    assert [level for level, _ in bench.node.take_events()] == ["warning"]


# --- effect of an error on the NMT state (1029h)


@pytest.mark.parametrize(
    ("reaction", "state"),
    [
        (None, NmtState.OPERATIONAL),  # no 1029h:2
        (0, NmtState.PRE_OPERATIONAL),
        (1, NmtState.OPERATIONAL),
        (2, NmtState.STOPPED),
    ],
)
def test_1029h_2_sets_nmt_state_after_device_error(reaction, state):
    od = dictionary()
    if reaction is not None:
        put(od, 0x1029, 2, UNSIGNED8, reaction)
    bench = Bench(od).operate()
    errors(bench, 0x8611)
    bench.wait(0)
    assert bench.frames() == ["082 11 86 21 00 00 00 00 00"]  # sent before the state changes
    assert bench.node.state == state


def test_1029h_2_ignores_communication_errors_and_repairs():
    od = dictionary()
    put(od, 0x1029, 2, UNSIGNED8, 2)
    bench = Bench(od).operate()
    errors(bench, 0x8130, 0x8210, 0x0000)
    bench.wait(0)
    assert bench.node.state == NmtState.OPERATIONAL


def test_1001h_change_triggers_mapping_tpdo():
    od = dictionary()
    put_pdo(od, 0x1400, (0x6040_0010,), 255)
    put_pdo(od, 0x1800, (0x1001_0008,), 255)
    bench = Bench(od).operate()
    bench.tell(0x202, "0F")  # too short
    assert bench.frames() == ["082 10 82 11 01 01 02 00 00", "182 11"]
    bench.tell(0x202, "0F 00")
    assert bench.frames() == ["082 00 00 00 00 00 00 00 00", "182 00"]
