import can
import pytest

from motorhil.harness.python_can.messages import to_message
from motorhil.harness.recording.sources import (
    BusDownError,
    HubClocks,
    Kind,
    Place,
    PlaceError,
    PythonCanTap,
    frame_of,
    parse_place,
    refuse_twice,
    topic_name,
)
from motorhil.traces.can_frame import classic, flexible, remote

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
def test_parse_place_recognises_kind_by_form(text, kind, interface, channel, name):
    assert parse_place(text) == Place(text, kind, interface, channel, name)


@pytest.mark.parametrize("text", ["", "can0=", "=vcan0", "a b", "pcan:", ":0", "x" * 16])
def test_parse_place_without_bus_raises_with_remedy(text):
    with pytest.raises(PlaceError, match="interface:channel"):
        parse_place(text)


def test_refuse_twice_for_equal_names_raises():
    places = [parse_place("vcan0"), parse_place("./hub")]
    refuse_twice(["vcan0", "can0"], places)
    with pytest.raises(
        PlaceError, match=r"--on ./hub: the name can0 is used already, by vcan0.*NAME=./hub"
    ):
        refuse_twice(["can0", "can0"], places)


def test_topic_name_replaces_invalid_characters():
    assert topic_name("/dev/ttyACM0@115200") == "dev_ttyACM0_115200"
    assert topic_name("0") == "0"
    assert topic_name("::") == "can"


def test_hub_clocks_for_single_hub_keep_its_times():
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
def test_frame_of_inverts_to_message(frame):
    assert frame_of(to_message(frame, 0, "can0", received=False)) == frame


def test_to_message_of_fd_frame_has_python_can_attributes():
    message = to_message(FRAMES["FD, BRS, ESI"], 0, "can0", received=False)
    expected = can.Message(
        arbitration_id=0x1FFF_FFFF,
        is_fd=True,
        bitrate_switch=True,
        error_state_indicator=True,
        data=bytes(range(64)),
        channel="can0",
        is_rx=False,
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


@pytest.mark.parametrize("stamp", [float("inf"), float("nan"), -1.0, 1e300])
def test_stamp_that_is_not_a_time_is_told_once(tap, stamp):
    with can.Bus(interface="virtual", channel="places", preserve_timestamps=True) as bus:
        for number in range(3):
            bus.send(can.Message(arbitration_id=number, timestamp=stamp))
    found, problems = [], []
    while len(found) < 3 or not problems:
        try:
            found += tap.read(NOW_S * 10**9)
        except BusDownError as problem:
            problems.append(str(problem))
    assert [time_ns for _, time_ns, _ in found] == [NOW_S * 10**9] * 3
    told = f"virtual:places: a frame has the stamp {stamp:g} s; such frames get this computer's"
    assert problems == [f"{told} time"]
    assert tap.read(NOW_S * 10**9) == []  # not again


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ([NOW_S - 1.5, NOW_S], [NOW_S * 10**9 - 1_500_000_000, NOW_S * 10**9]),  # since 1970
        (
            [12.5, 13.75],
            [NOW_S * 10**9, NOW_S * 10**9 + 1_250_000_000],
        ),  # since power-on
        ([0.0, 0.0], [NOW_S * 10**9] * 2),  # no stamps
    ],
)
def test_python_can_stamps_are_shifted_only_if_necessary(tap, stamps, expected):
    assert [tap._time_ns(stamp, NOW_S * 10**9) for stamp in stamps] == expected
    assert ("moved" in tap.clock) == (stamps[0] == 12.5)


def test_unknown_interface_error_lists_available_ones():
    with pytest.raises(PlaceError, match=r"no interface 'vrtual'; available: .*virtual"):
        PythonCanTap(parse_place("vrtual:0"), {})


def test_missing_driver_raises_place_error_in_one_line():
    with pytest.raises(PlaceError, match=r"--on pcan:PCAN_USBBUS1: .*--bitrate") as caught:
        PythonCanTap(parse_place("pcan:PCAN_USBBUS1"), {})
    assert "\n" not in str(caught.value)


def test_error_frame_with_foreign_codes_becomes_bus_error():
    """In PCAN-Basic identifier 4 is a stuff error; in Linux class 4 is a controller state."""
    error = can.Message(arbitration_id=4, is_error_frame=True, data=bytes([1, 10, 0, 8]))
    assert frame_of(error, "pcan") == bytes.fromhex("80000020 08 000000") + bytes(8)
    assert frame_of(error, "gs_usb")[:4] != bytes.fromhex("80000020")
