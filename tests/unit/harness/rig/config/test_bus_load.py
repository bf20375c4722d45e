"""Declared bus traffic of a rig, and its use."""

import tomllib
from pathlib import Path

import jsonschema
import pytest

from motorhil.harness.rig.config.rig_file import Known, parse_rig
from motorhil.harness.rig.config.schema import rig_schema
from motorhil.harness.rig.config.toml import RigError, Source
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage, declared_traffic
from motorhil.motorapi.synchronization.can_response_time import BusLoad
from tests.support.motors.drive_rigs import HEAD, drive

SCHEMA = rig_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
KNOWN = Known(("cia402",), ("cia402",))
MESSAGE = "[[bus.can0.message]]\nidentifier = 0x181\nlength = 8\nperiod_s = 0.01\n"


def text_of(messages: str) -> str:
    return f"[bus.can0]\nbitrate_bit_s = 1_000_000\n{messages}"


def parsed(messages: str):
    return parse_rig(Source(Path("rig.toml"), text_of(messages)), KNOWN).buses["can0"]


def test_messages_are_read_as_written():
    extended = "[[bus.can0.message]]\nidentifier = 0x12345678\nextended = true\nlength = 0\n"
    extended += "period_s = 1\njitter_s = 0.5\n"
    assert parsed(MESSAGE + extended).messages == (
        PeriodicMessage(0x181, 8, 0.01),
        PeriodicMessage(0x12345678, 0, 1.0, 0.5, extended=True),
    )
    assert VALIDATOR.is_valid(tomllib.loads(text_of(MESSAGE + extended)))


def test_empty_message_list_is_a_declaration():
    assert parsed("").messages is None
    assert parsed("message = []\n").messages == ()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "length = 8",
            "length = 9",
            "5: bus.can0.message[0].length: 9 bytes is out of range; allowed: 0 to 8 bytes;"
            " with fd = true (CAN FD) up to 64 bytes",
        ),
        (
            "0x181",
            "0x800",
            "4: bus.can0.message[0].identifier: 2048 is out of range; allowed: 0 to 2047, "
            "or extended = true",
        ),
        (
            "period_s = 0.01",
            "",
            "3: bus.can0.message[0].period_s: is missing; write period_s = 0.01",
        ),
        (
            "period_s = 0.01",
            "period_s = 0",
            "6: bus.can0.message[0].period_s: 0 s is out of range; allowed: 1e-06 to 1e+06 s",
        ),
        (
            "period_s",
            "periode_s",
            "6: bus.can0.message[0].periode_s: unknown key (known: identifier, length, period_s,"
            " jitter_s, extended, deadline_s, sender, fd, bit_rate_switch); did you mean period_s?",
        ),
        (
            "length",
            'jitter_s = "no"\nlength',
            '5: bus.can0.message[0].jitter_s: must be a number [s], but is a string ("no"); '
            "allowed: 0 to 1e+06 s",
        ),
        (
            "[[bus.can0.message]]",
            "[bus.can0.message]",
            "3: bus.can0.message: must be an array of tables, but is a table (3 entries);"
            " write [[bus.can0.message]]",
        ),
    ],
)
def test_mistake_is_refused_by_reader_and_schema(old: str, new: str, told: str):
    text = MESSAGE.replace(old, new, 1)
    with pytest.raises(RigError) as caught:
        parsed(text)
    assert str(caught.value) == f"rig.toml:{told}"
    assert not VALIDATOR.is_valid(tomllib.loads(text_of(text)))


@pytest.mark.parametrize(
    ("second", "told"),
    [
        (
            MESSAGE,
            "8: bus.can0.message[1].identifier: 181h is already declared (line 3); declare"
            " it once, with the shorter period and the greater length",
        ),
        (
            MESSAGE.replace("181", "182").replace("0.01", "0.0001"),
            "10: bus.can0.message[1].period_s: the messages up to this one take 136% of the bus;"
            " use a longer period, or a higher bit rate",
        ),
    ],
)
def test_incompatible_messages_are_reported_at_the_later_one(second: str, told: str):
    with pytest.raises(RigError) as caught:
        parsed(MESSAGE + second)
    assert str(caught.value) == f"rig.toml:{told}"


FD = MESSAGE.replace("length = 8", "length = 64\nfd = true\nbit_rate_switch = true")
FD_BUS = "data_bitrate_bit_s = 5_000_000\n"


def test_can_fd_messages_are_read_and_use_both_bit_rates():
    text = FD_BUS + FD.replace("bit_rate_switch = true\n", "") + FD.replace("0x181", "0x182")
    assert parsed(text).messages == (
        PeriodicMessage(0x181, 64, 0.01, fd=True),
        PeriodicMessage(0x182, 64, 0.01, fd=True, bit_rate_switch=True),
    )
    assert VALIDATOR.is_valid(tomllib.loads(text_of(text)))
    # 712 bits at most, of them 33 at 1 Mbit/s and 679 at 5 Mbit/s: 168.8 us (can-physics, 6.3)
    assert parsed(FD_BUS + FD.replace("0.01", "169e-6")).messages is not None
    with pytest.raises(RigError, match="take 101% of the bus"):
        parsed(FD_BUS + FD.replace("0.01", "167e-6"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (FD, '6: bus.can0.message[0].fd: bus "can0" is classical CAN; give it a'
         " data_bitrate_bit_s, or remove fd"),
        (FD_BUS + FD.replace("64", "9"), "6: bus.can0.message[0].length: CAN FD frames"
         " cannot have 9 bytes; the frame is padded: write length = 12"),
        (FD_BUS + FD.replace("64", "65"), "6: bus.can0.message[0].length: 65 bytes is out of"
         " range; allowed: 0 to 64 bytes"),
        (FD_BUS + FD.replace("fd = true\n", ""), "7: bus.can0.message[0].bit_rate_switch: only CAN"
         " FD frames can switch the bit rate; write fd = true, or remove it"),
        (FD_BUS + FD.replace("fd = true\nbit_rate_switch = true\n", ""), "6:"
         " bus.can0.message[0].length: 64 bytes is out of range; allowed: 0 to 8 bytes; with"
         " fd = true (CAN FD) up to 64 bytes"),
    ],
)  # fmt: skip
def test_invalid_can_fd_message_is_refused_also_by_the_schema(text: str, told: str):
    with pytest.raises(RigError) as caught:
        parsed(text)
    assert str(caught.value) == f"rig.toml:{told}"
    assert not VALIDATOR.is_valid(tomllib.loads(text_of(text)))


def test_motorapi_gets_can_fd_messages_and_data_bit_rate(tmp_path: Path):
    with opened(tmp_path, f"{HEAD}{FD_BUS}{FD}{drive('left', 1)}") as rig:
        traffic = declared_traffic(rig.bus("can0"))
    assert traffic is not None
    assert traffic.data_bitrate_bit_s == 5_000_000
    load = BusLoad.of(traffic)
    assert load.takes_ns(load.messages[0]) == 33_000 + 679 * 200


def opened(tmp_path: Path, text: str) -> Rig:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return Rig.open(path)


def test_open_rig_declares_its_messages_and_its_nodes_own(
    tmp_path: Path,
):
    silent = drive("left", 1)
    beating = drive("right", 2, controller='objects = { "1017h" = 50 }')
    with opened(tmp_path, f"{HEAD}{MESSAGE}{silent}{beating}") as rig:
        traffic = declared_traffic(rig.bus("can0"))
        assert traffic is not None
        assert traffic.bitrate_bit_s == 1_000_000
        assert traffic.messages == (
            PeriodicMessage(0x181, 8, 0.01),
            PeriodicMessage(0x701, 1, 1.0),
            PeriodicMessage(0x702, 1, 0.05),
        )
    with opened(tmp_path, f"{HEAD}{silent}") as rig:
        assert declared_traffic(rig.bus("can0")) is None


# --- a motor's timing from its controller ----------------------------------------------------


def options_of(rig: Rig, name: str):
    return rig.motors[name].hardware.options


def test_motor_takes_its_drives_timing_on_request(tmp_path: Path):
    controller = "servo = { tick_s = 0.0005 }\ntiming = { sdo_reply_s = 0.002 }\n"
    given = drive("left", 1, f"{controller}oscillator = {{ ppm = -40 }}")
    asking = "timing_from_controller = true"
    asked = drive("right", 2, f"{controller}oscillator = {{ ppm_max = 100 }}", asking)
    own = drive("own", 3, controller, f"{asking}\nservo_period_ms = 2")
    with opened(tmp_path, f"{HEAD}{given}{asked}{own}") as rig:
        left, right, mine = (options_of(rig, name) for name in ("left", "right", "own"))
        assert (left.servo_period_ms, left.oscillator_ppm, left.sdo_reply_ms) == (None, None, None)
        assert (right.servo_period_ms, right.oscillator_ppm) == (0.5, 100.0)
        assert right.sdo_reply_ms == 2.0 / (1.0 - 1e-4)
        assert (mine.servo_period_ms, mine.oscillator_ppm) == (2, 0.0)
        told = [note for note in rig.notes if "a mistake in it is on both sides" in note]
        assert len(told) == 2
        assert "servo_period_ms = 0.5, oscillator_ppm = 100, sdo_reply_ms = 2.0002" in told[0]
        assert "servo_period_ms" not in told[1]


def test_unavailable_timing_is_reported_with_its_line(tmp_path: Path):
    text = f"{HEAD}{drive('left', 1, motor='timing_from_controller = 1')}"
    line = text.splitlines().index("timing_from_controller = 1") + 1
    with opened(tmp_path, text) as rig, pytest.raises(RigError) as caught:
        rig.build_motors()
    assert (caught.value.line, caught.value.message) == (
        line,
        "must be true or false, but is an integer (1)",
    )
    other = text.replace("= 1\n[motor.left.model]", "= true\n[motor.left.model]").replace(
        'controller = "left"', 'bus = "can0"\nnode_id = 7'
    )
    refused = pytest.raises(RigError, match="not an emulated CiA 402 drive")
    with opened(tmp_path, other) as rig, refused:
        rig.build_motors()
