"""The emulated moteus against the frames of its documentation, and against mjbots' own library.

Golden frames: mjbots/moteus docs/protocol/can.md, docs/integration/can-fd.md, issue 92, and frames
that moteus 1.1.1 makes. The library is the other reading of the protocol: it packs the commands and
parses the replies.
"""

from math import inf, isnan, nan

import moteus
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from motorhil.emulators.can.frame import BRS, EFF_FLAG, can_id_of, pack, pack_fd
from motorhil.emulators.moteus import registers as r
from tests.unit.emulators.moteus.bench import Bench

WITHOUT = 0x0001  # the identifier without the reply bit


# --- frames


def test_documented_reply_has_the_documented_bytes():
    values = [(10, "int"), (0.008, "position"), (0.064, "velocity"), (-1.44, "torque")]
    moved = r.subframe(r.REPLY, r.INT16, 0, [r.encode(*one, r.INT16) for one in values])
    rest = [(12.0, "voltage"), (20.0, "temperature"), (0, "int")]
    state = r.subframe(r.REPLY, r.INT8, 0x0D, [r.encode(*one, r.INT8) for one in rest])
    assert (moved + state).hex() == "2404000a005000000170ff230d181400"


def test_documented_command_sets_its_registers_and_is_answered():
    bench = Bench()
    reply = bench.tell("01000a07206000200150ff140400130d")
    assert reply == "2404000000000000000000230d301900"  # stopped still: the command comes after
    assert bench.read(0x020, 0x021, 0x022) == pytest.approx([0.0096, 0.072, -1.76], rel=1e-6)
    assert bench.run(15).mode() == 10


def test_default_query_is_padded_to_24_bytes():
    assert Bench().tell("11001f01130d") == "2100002f01" + "00" * 12 + "230d301900" + "5050"


@pytest.mark.parametrize(
    ("frame", "register", "value"),
    [
        ("01000a0e200000803f0000004011001f01130d", 0x020, 1.0),
        ("01000a0e200000803f0000004011001f01130d", 0x021, 2.0),
        ("01000a0d200000c07f0d270000c07f11001f01130d", 0x020, nan),
        ("01000a0d200000c07f0d270000c07f11001f01130d", 0x027, nan),
        ("01000a0e200000003f000000000d250000803f0e28000040400000004011001f01130d", 0x025, 1.0),
        ("01000a0e200000003f000000000d250000803f0e28000040400000004011001f01130d", 0x028, 3.0),
        ("01000a0e200000003f000000000d250000803f0e28000040400000004011001f01130d", 0x029, 2.0),
        ("0100090e1c000000400000803f", 0x01C, 2.0),
        ("0100090e1c000000400000803f", 0x01D, 1.0),
        ("01000d0e40000080bf0000803f", 0x040, -1.0),
        ("01000d0e40000080bf0000803f", 0x041, 1.0),
        ("097101000000", 0x071, 1.0),
    ],
)
def test_golden_frame_sets_its_register(frame, register, value):
    bench = Bench()
    bench.tell(frame, 0x8001)
    assert bench.read(register)[0] == pytest.approx(value, nan_ok=True)


@pytest.mark.parametrize(("frame", "mode"), [("01000f", 15), ("01000c", 12), ("0100090e1c", 0)])
def test_golden_mode_frame_enters_its_mode(frame, mode):
    bench = Bench()
    assert bench.tell(frame, WITHOUT) is None
    assert bench.run(15).mode() == (mode or 9)


def test_int16_command_of_another_host_is_answered_to_it():
    bench = Bench(node_id=2)
    (reply,) = bench.frame(
        pack_fd(0x8302 | EFF_FLAG, bytes.fromhex("01000a07205f00200150ff11001701130d505050"))
    )
    assert can_id_of(reply) == 0x203
    assert bench.library(bench.client.make_custom_query({0x20: moteus.INT16}))[0x20] == (
        pytest.approx(0.0095)
    )


def test_output_position_is_set_exactly_and_nearest():
    bench = Bench(rotor_to_output_ratio=0.25)
    bench.tell("0db1020000003f", WITHOUT)
    assert bench.read(0x001, 0x00C) == [0.5, 2]
    bench.tell("0db102cdcccc3d", WITHOUT)  # 0.1 exactly
    bench.tell("0db0020000003f", WITHOUT)  # nearest to 0.5, by whole turns of the rotor: 0.6
    assert bench.read(0x001)[0] == pytest.approx(0.6, abs=1e-3)


def test_query_of_a_user_is_answered_as_in_his_report():
    bench = Bench(abi_version=0x00010B)
    reply = bench.tell("01000a0d20cdcc4c3f0d290000c0401100110b198102")
    assert reply == "210000210b012981020b010000505050"  # his had been in mode 10 before
    bench.run(15)
    reply = bench.tell("01000a0d20cdcc4c3f0d290000c0401100110b198102")
    assert reply[:6] == "21000a"


@pytest.mark.parametrize(("given", "kept"), [("7f", 8.0), ("08", 8.0), ("07", 7.0), ("80", -8.0)])
def test_clock_trim_is_limited_to_8(given, kept):
    bench = Bench()
    bench.tell("0171" + given)
    assert bench.read(0x071) == [kept]


def test_uuid_is_read_by_broadcast_with_its_flag():
    bench = Bench(serial_number=0x0102030405060708)
    reply = bench.tell("1804d00211d802", 0x807F)
    assert reply == "2804d0020807060504030201000000006d6f74652 1d80201".replace(" ", "")


def test_uuid_mask_discards_the_frame_of_another():
    bench = Bench(serial_number=7)
    assert bench.tell("01000a" + "09d40207000000" + "1100") == "210000"
    assert bench.run(15).mode() == 10
    assert bench.tell("010000" + "09d40208000000" + "1100") is None
    assert bench.mode() == 10


@pytest.mark.parametrize("frame", ["01b20201", "01b30201"])  # reindex, recapture
def test_library_frames_of_the_encoder_are_taken_without_error(frame):
    bench = Bench()
    assert bench.tell(frame, WITHOUT) is None
    assert bench.tell(frame) == ""


def test_query_of_issue_92_has_its_reply():
    """Its hardware has ABI 1.11."""
    query = "01000a0d20cdcc4c3f0d290000c0401100110b198102"
    bench = Bench(abi_version=0x10B)
    for _ in range(40):  # 0.8 rev at 6 rev/s^2 take 0.73 s
        reply = bench.run(50).tell(query)
    assert reply == "21000a210b012981020b010000505050"


def test_diagnostic_text_stops_the_drive():
    bench = Bench().powered()
    assert bench.tell("400107642073746f700a", WITHOUT) is None
    assert bench.tell("420130") == "4101044f4b0d0a"
    assert bench.tell("420130") == "410100"
    assert bench.mode() == 0


def test_read_without_reply_bit_leaves_its_operands():
    bench = Bench()  # 1f 01 13 0d is then a write of registers 001h on, which cannot be written
    assert bench.tell("11001f01130d", WITHOUT) is None
    bench.tell("0d200000803f" + "11" + "0d200000004000", WITHOUT)
    assert bench.read(0x020) == [2.0]


def test_failed_read_ends_the_frame_and_keeps_what_was_before():
    bench = Bench()
    told = bench.tell("1100" + "1301" + "1109" + "0d200000803f")
    assert told == "210000" + "2301000000" + "310901" + "50"
    assert bench.read(0x020) == [0.0]


def test_failed_write_is_told_and_the_next_is_done():
    bench = Bench()
    assert bench.tell("060100000000" + "0d200000803f" + "1100") == "300102300202210000" + "505050"
    assert bench.read(0x020) == [1.0]
    assert bench.tell("01ff0101" + "019002" + "00") == "30ff0101309002 02".replace(" ", "")


def test_mode_beyond_15_is_an_unknown_register():
    bench = Bench()
    assert bench.tell("010010") == "300001"
    assert bench.tell("0100ff") == "300001"


@pytest.mark.parametrize("register", [0x100, 0x101, 0x102, 0x120, 0x122, 0x150, 0x153])
def test_identity_is_read_as_int32_only(register):
    head = r.packed(register).hex()
    assert Bench().tell("19" + head)[:6] == "29" + head
    for code in ("11", "15", "1d"):
        assert Bench().tell(code + head) == "31" + head + "01"


def test_frame_without_reads_is_answered_by_an_empty_one():
    assert Bench().tell("010000") == ""
    assert Bench().tell("ff") == ""


@pytest.mark.parametrize("length", [*range(9), 12])
def test_truncated_frame_does_what_is_complete(length):
    bench = Bench()
    frame = bytes.fromhex("0d2000000040" + "0d2100000040")[:length]
    bench.frame(pack_fd(WITHOUT, frame))
    assert bench.read(0x020, 0x021) == [2.0 if length >= 6 else 0.0, 2.0 if length == 12 else 0.0]


def test_reply_has_the_format_of_the_query():
    bench = Bench()
    query = bytes.fromhex("1100")
    classical, plain, switched = (
        bench.frame(pack(0x8001 | EFF_FLAG, query))[0],
        bench.frame(pack_fd(0x8001 | EFF_FLAG, query, 0))[0],
        bench.frame(pack_fd(0x8001 | EFF_FLAG, query, BRS))[0],
    )
    assert [len(one) for one in (classical, plain, switched)] == [16, 72, 72]
    assert [plain[5] & BRS, switched[5] & BRS] == [0, BRS]
    (long,) = bench.frame(pack(0x8001 | EFF_FLAG, bytes.fromhex("11001f01130d")))
    assert (len(long), long[5] & BRS) == (72, 0)


@pytest.mark.parametrize(("node", "flag"), [(1, 0), (7, 0), (8, EFF_FLAG), (126, EFF_FLAG)])
def test_reply_of_a_high_id_is_extended(node, flag):
    bench = Bench(node_id=node)
    (reply,) = bench.frame(pack_fd(0x8000 | node | EFF_FLAG, b"\x11\x00"))
    assert can_id_of(reply) == node << 8 | flag


def test_prefix_and_destination_are_filtered():
    bench = Bench(node_id=5, can_prefix=0x12)
    query = b"\x11\x00"
    first = 0x0012_0000 | EFF_FLAG
    for can_id, answers in ((0x8005, 1), (0x807F, 1), (0x8006, 0), (0x8000, 0), (0x0005, 0)):
        assert len(bench.frame(pack_fd(first | can_id, query))) == answers
    assert bench.frame(pack_fd(0x8005 | EFF_FLAG, query)) == []
    assert set(bench.drive.identifiers()) >= {first | 0x8005, first | 0x7F, first | 0xFF7F}


# --- numbers

SCALED = {
    **{0x020: "position", 0x021: "velocity", 0x022: "feedforward_torque", 0x023: "kp_scale"},
    **{0x024: "kd_scale", 0x025: "maximum_torque", 0x026: "stop_position"},
    **{0x027: "watchdog_timeout", 0x028: "velocity_limit", 0x029: "accel_limit"},
    **{0x02A: "fixed_voltage_override", 0x02B: "ilimit_scale"},
}
TYPES = (moteus.INT8, moteus.INT16, moteus.INT32, moteus.F32)


def step(register, kind):
    """Return the value of one bit, as the library has it."""
    return 1e-30 if kind == moteus.F32 else moteus.scale_register(register, kind, 1)


@settings(max_examples=300, deadline=None)
@given(
    register=st.sampled_from(sorted(SCALED)),
    kind=st.sampled_from(TYPES),
    value=st.floats(width=32) | st.floats(-4, 4, width=32),
)
def test_library_and_drive_read_each_other(register, kind, value):
    resolution = moteus.PositionResolution()
    setattr(resolution, SCALED[register], kind)
    client = moteus.Controller(id=1, transport=object(), position_resolution=resolution)
    command = client.make_position(**{SCALED[register]: value})
    sent = moteus.parse_registers(command.data).command[register]
    bench = Bench()
    bench.library(command)
    (stored,) = bench.read(register)
    assert stored == pytest.approx(sent, rel=1e-6, abs=1e-12, nan_ok=True)
    returned = bench.library(client.make_custom_query({register: kind}))[register]
    one = 1.001 * step(register, kind) + abs(sent) * 1e-6
    assert returned == pytest.approx(sent, abs=one, nan_ok=True) or sent == returned


@settings(max_examples=300, deadline=None)
@given(
    register=st.sampled_from(
        sorted(one for one in (*r.MEASURED, *r.COMMAND) if r.QUANTITIES[one] != "int")
    ),
    kind=st.sampled_from(TYPES[:3]),
    value=st.floats(-100, 100, width=32),
)
def test_integers_are_truncated_and_limited(register, kind, value):
    one = moteus.scale_register(register, kind, 1)
    if one == 1 and register not in (0x004, 0x005):
        return  # a register whose scale the library does not know
    raw = int.from_bytes(r.encode(value, r.QUANTITIES[register], kind), "little", signed=True)
    most = (1 << 8 * (1, 2, 4)[kind] - 1) - 1
    exact = value / one
    wanted = max(-most, min(most, exact))
    assert abs(raw - wanted) <= 1 + abs(wanted) * 2e-7
    assert abs(raw) <= abs(wanted) * (1 + 2e-7)


@pytest.mark.parametrize(
    ("kind", "least"), [(0, "80"), (1, "0080"), (2, "00000080")], ids=["int8", "int16", "int32"]
)
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_least_integer_stands_for_not_a_number(kind, least, value):
    assert r.encode(value, "position", kind).hex() == least
    assert isnan(r.decode(bytes.fromhex(least), "position", kind))
    most = bytes.fromhex(least)[:-1].replace(b"\0", b"\xff") + b"\x7f"
    assert r.encode(1e30, "position", kind) == most
    assert r.decode(r.encode(-1e30, "int", r.FLOAT), "int", r.FLOAT) == pytest.approx(-1e30)
