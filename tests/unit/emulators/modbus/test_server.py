"""Responses of the server, byte for byte.

Source of the transcripts: MODBUS Application Protocol Specification V1.1b3, the example of each
function in section 6; for exceptions its state diagrams.
"""

import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.modbus.registers import Access, BitBank, Kind, Register, RegisterBank
from motorhil.emulators.modbus.server import Diagnostics, Identification, ModbusServer

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILURE = 1, 2, 3, 4
OBJECTS = {0: "Company identification", 1: "Product code XX", 2: "V2.11"}


def bits(count: int, **values: int) -> BitBank:
    """Return bits from 0, some of them set from packed bytes: `at19=0x056BCD`."""
    bank = BitBank([f"bit{n}" for n in range(count)])
    for name, packed in values.items():
        first = int(name.removeprefix("at"))
        for place in range(packed.bit_length()):
            bank.values[first + place] = bool(packed >> place & 1)
    return bank


def registers(**values: int) -> RegisterBank:
    """Return registers 0..120h; `r107=0x022B` sets a value."""
    bank = RegisterBank([Register(n, f"r{n}") for n in range(0x121)])
    for name, value in values.items():
        bank[name] = value
    return bank


def server(**parts: object) -> ModbusServer:
    """Return a server with all functions of the specification."""
    return ModbusServer(
        holding=registers(r107=0x022B, r109=0x0064),
        inputs=registers(r8=0x000A),
        coils=bits(0x100, at19=0x056BCD),
        discretes=bits(0x100, at196=0x35DBAC),
        identification=Identification(OBJECTS),
        diagnostics=Diagnostics(),
        **parts,  # type: ignore[arg-type] -- keywords of the caller
    )


def ask(one: ModbusServer, request: str) -> str:
    return one.respond(bytes.fromhex(request)).hex(" ").upper()


@pytest.mark.parametrize(
    ("request_pdu", "response"),
    [
        ("01 0013 0013", "01 03 CD 6B 05"),
        ("02 00C4 0016", "02 03 AC DB 35"),
        ("03 006B 0003", "03 06 02 2B 00 00 00 64"),
        ("04 0008 0001", "04 02 00 0A"),
        ("05 00AC FF00", "05 00 AC FF 00"),
        ("06 0001 0003", "06 00 01 00 03"),
        ("08 0000 A537", "08 00 00 A5 37"),
        ("0F 0013 000A 02 CD01", "0F 00 13 00 0A"),
        ("10 0001 0002 04 000A 0102", "10 00 01 00 02"),
        ("16 0004 00F2 0025", "16 00 04 00 F2 00 25"),
    ],
)
def test_specification_examples_match(request_pdu, response):
    assert ask(server(), request_pdu) == response


def test_written_values_are_read_back():
    one = server()
    ask(one, "10 0001 0002 04 000A 0102")
    assert ask(one, "03 0001 0002") == "03 04 00 0A 01 02"
    ask(one, "0F 0013 000A 02 CD01")  # the first ten of twenty bits
    assert ask(one, "01 0013 000A") == "01 02 CD 01"
    ask(one, "05 00AC FF00")
    assert ask(one, "01 00AC 0001") == "01 01 01"
    ask(one, "05 00AC 0000")
    assert ask(one, "01 00AC 0001") == "01 01 00"


def test_mask_write_uses_and_or_of_standard():
    one = server()
    ask(one, "06 0004 0012")
    ask(one, "16 0004 00F2 0025")
    assert ask(one, "03 0004 0001") == "03 02 00 17"


def test_read_write_writes_before_reading():
    one = server()
    for address, value in enumerate((0x00FE, 0x0ACD, 0x0001, 0x0003, 0x000D, 0x00FF), 3):
        ask(one, f"06 {address:04X} {value:04X}")
    request = "17 0003 0006 000E 0003 06 00FF 00FF 00FF"
    assert ask(one, request) == "17 0C 00 FE 0A CD 00 01 00 03 00 0D 00 FF"
    assert ask(one, "17 0010 0001 0010 0001 02 1234") == "17 02 12 34"


@pytest.mark.parametrize(
    ("request_pdu", "code"),
    [
        ("01 0000 0000", ILLEGAL_VALUE),
        ("01 0000 07D1", ILLEGAL_VALUE),  # 2001
        ("01 00FF 0002", ILLEGAL_ADDRESS),
        ("03 0000 0000", ILLEGAL_VALUE),
        ("03 0000 007E", ILLEGAL_VALUE),  # 126: pymodbus' server says 01
        ("03 0120 0002", ILLEGAL_ADDRESS),
        ("03 FFFF 0002", ILLEGAL_ADDRESS),
        ("05 00AC 1234", ILLEGAL_VALUE),  # pymodbus' server accepts it
        ("05 00AC FF01", ILLEGAL_VALUE),
        ("05 0100 FF00", ILLEGAL_ADDRESS),
        ("06 0121 0000", ILLEGAL_ADDRESS),
        ("0F 0000 0000 00", ILLEGAL_VALUE),
        ("0F 0000 0009 01 FF", ILLEGAL_VALUE),  # nine coils are two bytes
        ("10 0000 0000 00", ILLEGAL_VALUE),
        ("10 0000 0002 04 0001", ILLEGAL_VALUE),  # a register is missing
        ("10 0000 0002 02 0001 0002", ILLEGAL_VALUE),  # the count of bytes is wrong
        ("10 0120 0002 04 0001 0002", ILLEGAL_ADDRESS),
        ("16 0121 0000 0000", ILLEGAL_ADDRESS),
        ("17 0000 0000 0000 0001 02 0001", ILLEGAL_VALUE),
        ("17 0000 007E 0000 0001 02 0001", ILLEGAL_VALUE),
        ("08 0001 1234", ILLEGAL_VALUE),
        ("08 0003 0000", ILLEGAL_FUNCTION),  # unknown sub-function
        ("11 00", ILLEGAL_VALUE),
        ("2B 0D 01 00", ILLEGAL_FUNCTION),  # unknown MEI type
        ("2B 0E 05 00", ILLEGAL_VALUE),
        ("2B 0E 04 77", ILLEGAL_ADDRESS),
        ("07", ILLEGAL_FUNCTION),
        ("63 0000 0001", ILLEGAL_FUNCTION),
        ("03 0000", ILLEGAL_VALUE),
        ("03 0000 0001 00", ILLEGAL_VALUE),
    ],
)
def test_invalid_request_gets_exception(request_pdu, code):
    function = int(request_pdu[:2], 16)
    assert ask(server(), request_pdu) == f"{function | 0x80:02X} {code:02X}"


def test_checks_are_function_then_value_then_address():
    only_holding = ModbusServer(holding=registers())
    assert ask(only_holding, "01 FFFF 0000") == "81 01"
    assert ask(only_holding, "03 FFFF 0000") == "83 03"
    assert ask(only_holding, "03 FFFF 0001") == "83 02"
    assert only_holding.functions() == [0x03, 0x06, 0x10, 0x16, 0x17]


@pytest.mark.parametrize("write_address", ["0010", "0121"])
@pytest.mark.parametrize("read_address", ["0010", "0121"])
def test_read_write_checks_both_ranges_before_writing(read_address, write_address):
    one = server()
    answer = ask(one, f"17 {read_address} 0001 {write_address} 0001 02 BEEF")
    well = read_address == write_address == "0010"
    assert answer == ("17 02 BE EF" if well else "97 02")
    assert ask(one, "03 0010 0001") == ("03 02 BE EF" if well else "03 02 00 00")


def test_device_identification_is_streamed():
    first = "2B 0E 01 81 00 00 03 00 16 " + b"Company identification".hex(" ").upper()
    rest = " 01 0F " + b"Product code XX".hex(" ").upper() + " 02 05 " + b"V2.11".hex(" ").upper()
    assert ask(server(), "2B 0E 01 00") == first + rest
    assert ask(server(), "2B 0E 04 02") == "2B 0E 04 81 00 00 01 02 05 56 32 2E 31 31"


def test_long_identification_stream_has_continuation():
    one = ModbusServer(identification=Identification({**OBJECTS, 3: "u" * 200, 4: "p" * 100}))
    first = one.respond(bytes.fromhex("2B0E0200"))
    assert len(first) <= 253
    assert first[4:6].hex() == "ff03"  # more follows, from object 3
    second = one.respond(bytes.fromhex("2B0E02") + first[5:6])
    assert second[4:6].hex() == "ff04"
    third = one.respond(bytes.fromhex("2B0E02") + second[5:6])
    assert third[4:6].hex() == "0000"
    assert (first[6], second[6], third[6]) == (3, 1, 1)


def test_server_id_has_run_indicator():
    one = server()
    assert ask(one, "11") == "11 02 01 FF"
    one.run_indicator = False
    assert ask(one, "11") == "11 02 01 00"


def test_serial_counters_count_messages():
    one = server()
    assert one.diagnostics is not None
    one.diagnostics.bus_messages = 0x10005  # they wrap around
    ask(one, "63")
    one.broadcast(bytes.fromhex("06 0001 0007"))
    assert ask(one, "08 000B 0000") == "08 00 0B 00 05"
    assert ask(one, "08 000D 0000") == "08 00 0D 00 01"
    assert ask(one, "08 000F 0000") == "08 00 0F 00 01"
    assert ask(one, "08 000E 0000") == "08 00 0E 00 06"  # including this one
    ask(one, "08 000A 0000")
    assert ask(one, "08 000B 0000") == "08 00 0B 00 00"


def test_listen_only_unit_is_silent_until_restart():
    one = server()
    assert ask(one, "08 0004 0000") == ""
    assert ask(one, "06 0001 0007") == ""
    one.broadcast(bytes.fromhex("06 0002 0007"))
    assert ask(one, "08 0001 0000") == ""  # the restart itself has no response either
    assert ask(one, "03 0001 0002") == "03 04 00 00 00 00"


def test_broadcasts_write_without_response():
    one = server()
    one.broadcast(bytes.fromhex("10 0001 0001 02 000A"))
    one.broadcast(bytes.fromhex("03 0001 0001"))
    one.broadcast(bytes.fromhex("17 0003 0001 0003 0001 02 0001"))  # reads: not broadcast
    one.broadcast(b"")
    assert ask(one, "03 0001 0003") == "03 06 00 0A 00 00 00 00"


REQUESTS = st.one_of(
    st.binary(max_size=20),
    st.builds(
        lambda code, body: bytes((code,)) + body,
        st.sampled_from([1, 2, 3, 4, 5, 6, 8, 0x0F, 0x10, 0x11, 0x16, 0x17, 0x2B]),
        st.binary(max_size=16),
    ),
    st.builds(
        lambda code, address, count: bytes((code,)) + address.to_bytes(2) + count.to_bytes(2),
        st.sampled_from([1, 2, 3, 4, 5, 6]),
        st.integers(0, 0xFFFF) | st.integers(0, 0x130),
        st.integers(0, 0xFFFF) | st.integers(0, 130),
    ),
)


@given(st.lists(REQUESTS, max_size=8))
def test_random_request_gets_valid_response(requests):
    one = server()
    for request in requests:
        answer = one.respond(request)
        assert len(answer) <= 253
        if not answer:
            event("no answer")
            listens = one.diagnostics is not None and one.diagnostics.listens_only
            assert not request or listens or request[:1] == b"\x08"
        elif answer[0] & 0x80:
            event(f"exception {answer[1]}")
            assert answer[0] == request[0] | 0x80
            assert answer[1] in (1, 2, 3)
            assert len(answer) == 2
        else:
            event("answered")
            assert answer[0] == request[0]


def wide() -> RegisterBank:
    return RegisterBank(
        [
            Register(0x10, "position", Kind.I32, "inc", low=-1000, high=70000),
            Register(0x12, "speed", Kind.I16, "rpm", Access.READ),
            Register(0x13, "key", Kind.U16, "", Access.WRITE),
        ]
    )


def test_32_bit_register_is_upper_half_first_and_signed():
    bank = wide()
    one = ModbusServer(holding=bank)
    assert ask(one, "10 0010 0002 04 0001 0002") == "10 00 10 00 02"
    assert bank["position"] == 65538
    ask(one, "10 0010 0002 04 FFFF FFFE")
    assert bank["position"] == -2
    assert ask(one, "10 0010 0002 04 FFFF 0000") == "90 03"  # -65536 is below its limit
    assert ask(one, "03 0010 0002") == "03 04 FF FF FF FE"


def test_32_bit_register_is_consistent_in_one_request_only():
    bank = wide()
    values = iter((0x0001FFFF, 0x00020000, 0x00020000))
    bank.on_read("position", lambda: next(values))
    one = ModbusServer(holding=bank)
    assert ask(one, "03 0010 0002") == "03 04 00 01 FF FF"
    assert ask(one, "03 0010 0001") == "03 02 00 02"
    assert ask(one, "03 0011 0001") == "03 02 00 00"


def test_half_of_32_bit_register_may_be_written():
    bank = wide()
    one = ModbusServer(holding=bank)
    ask(one, "06 0011 0005")
    assert bank["position"] == 5
    ask(one, "06 0010 0001")
    assert bank["position"] == 65541


def test_register_access_follows_its_row():
    one = ModbusServer(holding=wide())
    assert ask(one, "06 0012 0000") == "86 02"  # read-only
    assert ask(one, "03 0013 0001") == "83 02"  # write-only
    assert ask(one, "10 0011 0002 04 0005 0005") == "90 02"
    assert ask(one, "03 0011 0001") == "03 02 00 00"  # and none of it was written


def test_values_are_checked_before_first_is_stored():
    bank = RegisterBank([Register(0, "a", high=10), Register(1, "b", high=10)])
    one = ModbusServer(holding=bank)
    assert ask(one, "10 0000 0002 04 0005 000B") == "90 03"
    assert (bank["a"], bank["b"]) == (0, 0)


def test_writers_are_called_in_order_and_may_refuse():
    bank = RegisterBank([Register(0, "a"), Register(1, "b"), Register(2, "c")])
    told: list[tuple[str, int]] = []

    def writer(name: str, code: int):
        def write(value: int) -> int:
            told.append((name, value))
            return code

        return write

    bank.on_write("a", writer("a", 0))
    bank.on_write("b", writer("b", FAILURE))
    bank.on_write("c", writer("c", 0))
    assert ask(ModbusServer(holding=bank), "10 0000 0003 06 0001 0002 0003") == "90 04"
    assert told == [("a", 1), ("b", 2)]
    assert (bank["a"], bank["b"], bank["c"]) == (1, 0, 0)


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        ([Register(0, "a"), Register(0, "b")], "b and a: both at address 0000h"),
        ([Register(0, "a", Kind.U32), Register(1, "b")], "b and a: both at address 0001h"),
        ([Register(0, "a"), Register(1, "a")], "register a: name already used"),
        ([Register(0xFFFF, "a", Kind.U32)], "address 10000h"),
        ([Register(0, "a", Kind.I16, default=40000)], "i16 holds -32768 to 32767"),
    ],
)
def test_invalid_table_is_refused(rows, problem):
    with pytest.raises(ValueError, match=problem):
        RegisterBank(rows)


def of_size(code: int, count: int) -> bytes:
    """Return a request for `count` items at 0 that is otherwise valid."""
    head = bytes((code, 0, 0)) + count.to_bytes(2, "big")
    if code in (0x01, 0x03):
        return head
    if code == 0x17:
        head = bytes((code, 0, 0, 0, 1, 0, 0)) + count.to_bytes(2, "big")
    size = (count + 7) // 8 if code == 0x0F else 2 * count
    return head + bytes((size,)) + bytes(size)


@pytest.mark.parametrize(
    ("code", "most"), [(0x01, 2000), (0x03, 125), (0x0F, 1968), (0x10, 123), (0x17, 121)]
)
def test_maximum_count_is_accepted_and_one_more_refused(code, most):
    one = ModbusServer(holding=registers(), coils=bits(2048))
    assert one.respond(of_size(code, most))[0] == code
    assert one.respond(of_size(code, most + 1)) == bytes((code | 0x80, ILLEGAL_VALUE))


def test_identification_from_unknown_object_starts_at_first():
    one = server()
    assert ask(one, "2B 0E 01 77") == ask(one, "2B 0E 01 00")
    assert ask(one, "2B 0E 01 01").startswith("2B 0E 01 81 00 00 02 01 0F")
