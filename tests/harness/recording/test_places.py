import can
import pytest

from harness.recording.places import Kind, Place, PlaceError, parse_place, refuse_twice, topic_name
from harness.recording.python_can import PythonCanTap, frame_of, message_of
from harness.recording.taps import HubClocks
from traces.traffic import classic, flexible, remote

NOW_S = 1_800_000_000


@pytest.mark.parametrize(
    ("text", "kind", "interface", "channel", "name"),
    [
        ("vcan0", Kind.SOCKETCAN, "", "vcan0", ""),
        ("arm=can1", Kind.SOCKETCAN, "", "can1", "arm"),
        ("./hub", Kind.HUB, "", "./hub", ""),
        ("/tmp/a=b", Kind.HUB, "", "/tmp/a=b", ""),
        ("left=/tmp/hub#can1", Kind.HUB, "", "/tmp/hub#can1", "left"),
        ("pcan:PCAN_USBBUS1", Kind.PYTHON_CAN, "pcan", "PCAN_USBBUS1", ""),
        ("x=slcan:/dev/ttyACM0@115200", Kind.PYTHON_CAN, "slcan", "/dev/ttyACM0@115200", "x"),
        ("udp_multicast:ff15:7079::1", Kind.PYTHON_CAN, "udp_multicast", "ff15:7079::1", ""),
    ],
)
def test_a_place_is_told_by_its_form(text, kind, interface, channel, name):
    assert parse_place(text) == Place(text, kind, interface, channel, name)


@pytest.mark.parametrize("text", ["", "can0=", "=vcan0", "a b", "pcan:", ":0", "x" * 16])
def test_what_names_no_bus_is_refused_with_what_to_write(text):
    with pytest.raises(PlaceError, match="interface:channel"):
        parse_place(text)


def test_two_buses_need_two_names():
    places = [parse_place("vcan0"), parse_place("./hub")]
    refuse_twice(["vcan0", "can0"], places)
    with pytest.raises(
        PlaceError, match=r"--on ./hub: the name can0 is used already, by vcan0.*NAME=./hub"
    ):
        refuse_twice(["can0", "can0"], places)


def test_a_channel_becomes_a_name_that_a_topic_can_have():
    assert topic_name("/dev/ttyACM0@115200") == "dev_ttyACM0_115200"
    assert topic_name("0") == "0"
    assert topic_name("::") == "can"


def test_hub_times_are_kept_where_one_hub_is_all_there_is():
    one = HubClocks([parse_place("./hub"), parse_place("b=./hub#can1")])
    assert one.keeps
    assert one.shift("./hub", 5, 1000) == 0
    both = HubClocks([parse_place("./hub"), parse_place("./hub#can1"), parse_place("vcan0")])
    assert not both.keeps
    assert [both.shift("./hub", 5, 1000), both.shift("./hub", 900, 2000)] == [995, 995]
    assert not HubClocks([parse_place("./one"), parse_place("./two")]).keeps


# --- python-can's messages


FRAMES = {
    "11 bit": classic(0x7FF, b"\1\2"),
    "29 bit": classic(0x8000_0123, bytes(8)),
    "remote": remote(0x123, 5),
    "FD": flexible(0x123, 0, bytes(12)),
    "FD, BRS, ESI": flexible(0x9FFF_FFFF, 3, bytes(range(64))),
}


@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES)
def test_a_frame_is_a_message_is_a_frame(frame):
    assert frame_of(message_of(frame)) == frame


def test_messages_say_what_python_can_calls_it():
    message = message_of(FRAMES["FD, BRS, ESI"])
    expected = can.Message(
        arbitration_id=0x1FFF_FFFF,
        is_fd=True,
        bitrate_switch=True,
        error_state_indicator=True,
        data=bytes(range(64)),
    )
    assert message.equals(expected, timestamp_delta=None)
    error = can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False, dlc=8,
                        data=bytes(8))  # fmt: skip
    assert frame_of(error)[:4] == bytes.fromhex("40000020")


@pytest.fixture
def tap():
    tap = PythonCanTap(parse_place("virtual:places"), {})
    yield tap
    tap.close()


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([NOW_S - 1.5, NOW_S], [NOW_S * 10**9 - 1_500_000_000, NOW_S * 10**9]),  # since 1970
        ([12.5, 13.75], [NOW_S * 10**9, NOW_S * 10**9 + 1_250_000_000]),  # since it was plugged in
        ([0.0, 0.0], [NOW_S * 10**9] * 2),  # it has none
    ],
)
def test_an_interfaces_own_stamps_are_used_and_moved_only_where_they_must_be(tap, stamps, expected):
    assert [tap._time_ns(stamp, NOW_S * 10**9) for stamp in stamps] == expected
    assert ("moved" in tap.clock) == (stamps[0] == 12.5)


def test_an_unknown_interface_is_told_with_those_there_are():
    with pytest.raises(PlaceError, match=r"no interface 'vrtual'; available: .*virtual"):
        PythonCanTap(parse_place("vrtual:0"), {})


def test_a_driver_that_is_not_there_is_one_error_with_its_words():
    with pytest.raises(PlaceError, match=r"--on pcan:PCAN_USBBUS1: .*--bitrate") as caught:
        PythonCanTap(parse_place("pcan:PCAN_USBBUS1"), {})
    assert "\n" not in str(caught.value)


def test_an_error_frame_of_an_adapter_with_codes_of_its_own_is_a_bus_error_and_no_more():
    """PCAN-Basic: identifier 4 is a stuff error; Linux's class 4 would be the controller's."""
    error = can.Message(arbitration_id=4, is_error_frame=True, data=bytes([1, 10, 0, 8]))
    assert frame_of(error, "pcan") == bytes.fromhex("80000020 08 000000") + bytes(8)
    assert frame_of(error, "gs_usb")[:4] != bytes.fromhex("80000020")
