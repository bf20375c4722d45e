"""SDO by canopen's client in a runtime: bytes, deadlines, stale answers."""

import pytest
from canopen.sdo.exceptions import SdoAbortedError

from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation, SdoAborted
from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel
from motorhil.motorapi.errors import DeadlineExceeded, MotorBusyError
from motorhil.motorapi.runtime.can_link import CanLink
from tests.support.motors.scripted import FRAME_NS, MS, Answer, ScriptedBus, Transcript, frame


def channel_to(bus: ScriptedBus, timeout_s: float = 0.3, quarantine_s: float = 1.0) -> SdoChannel:
    link = CanLink(bus, bus.runtime)
    return SdoChannel(link, 2, timeout_s=timeout_s, quarantine_s=quarantine_s)


# Bytes: canopen's own test/test_sdo.py, which follows CiA 301's SDO protocols.


def test_expedited_upload_is_one_request_and_one_answer():
    script = Transcript([("602#4018100100000000", "582#4318100104000000")])
    bus = ScriptedBus(script)
    assert channel_to(bus).upload(0x1018, 1) == b"\x04\x00\x00\x00"
    assert script.is_over
    assert bus.runtime.now_ns() == FRAME_NS + 1 * MS  # when the answer was complete


@pytest.mark.parametrize("code", SdoAbortedError.CODES)
def test_each_abort_code_of_the_standard_has_a_text(code):
    error = SdoAborted(node_id=2, index=0x6040, subindex=0, abort_code=code)
    assert "not listed" not in str(error)


def test_segmented_upload_alternates_the_toggle_bit():
    script = Transcript(
        [
            ("602#4008100000000000", "582#410810001A000000"),
            ("602#6000000000000000", "582#0054696E79204E6F"),
            ("602#7000000000000000", "582#106465202D204D65"),
            ("602#6000000000000000", "582#00676120446F6D61"),
            ("602#7000000000000000", "582#15696E7320210000"),
        ]
    )
    assert channel_to(ScriptedBus(script)).upload(0x1008) == b"Tiny Node - Mega Domains !"
    assert script.is_over


def test_expedited_download_is_confirmed():
    script = Transcript([("602#2B171000A00F0000", "582#6017100000000000")])
    channel_to(ScriptedBus(script)).download(0x1017, 0, (4000).to_bytes(2, "little"))
    assert script.is_over


class Refusal:
    """The fence of a motor that another program has taken over."""

    def send(self, frame):
        raise MotorBusyError(motor="left", holder="rescue", since_ns=0)


def test_only_a_write_that_stops_passes_the_fence():
    script = Transcript([("602#2B4060000B000000", "582#6040600000000000")])
    bus = ScriptedBus(script)
    channel = channel_to(bus)
    channel.fence = Refusal()
    with pytest.raises(MotorBusyError, match="left is held by rescue"):
        channel.download(0x6040, 0, b"\x0f\x00")
    assert bus.texts == []
    channel.download(0x6040, 0, b"\x0b\x00", stops=True)
    assert script.is_over


def test_segmented_download_marks_its_last_segment():
    script = Transcript(
        [
            ("602#210020000D000000", "582#6000200000000000"),
            ("602#0041206C6F6E6720", "582#2000000000000000"),
            ("602#13737472696E6700", "582#3000000000000000"),
        ]
    )
    channel_to(ScriptedBus(script)).download(0x2000, 0, b"A long string")
    assert script.is_over


def test_abort_error_names_place_and_code():
    script = Transcript([("602#4018100100000000", "582#8018100111000906")])
    with pytest.raises(SdoAborted, match=r"node 2: SDO 1018h:01h aborted: sub-index") as caught:
        channel_to(ScriptedBus(script)).upload(0x1018, 1)
    error = caught.value
    assert (error.node_id, error.index, error.subindex) == (2, 0x1018, 1)
    assert error.abort_code == 0x0609_0011


def test_missing_answer_ends_exactly_at_the_deadline():
    bus = ScriptedBus()
    with pytest.raises(DeadlineExceeded, match="answer to SDO 6041h:00h") as caught:
        channel_to(bus, timeout_s=0.3).upload(0x6041)
    assert bus.runtime.now_ns() == 300 * MS
    assert caught.value.timeout_s == 0.3
    # the abort names the object (CiA 301: abort transfer, 0504 0000h)
    assert bus.texts == ["602#4041600000000000", "602#8041600000000405"]


def answers(*values: tuple[int, int]):
    """Return a peer that answers uploads of 6064h in turn: (delay [ns], value); delay -1: never."""
    waiting = list(values)

    def peer(data: bytes) -> list[Answer]:
        if data[8] != 0x40 or not waiting:
            return []
        delay_ns, value = waiting.pop(0)
        if delay_ns < 0:
            return []
        return [(delay_ns, frame("582#43646000" + value.to_bytes(4, "little").hex()))]

    return peer


def test_late_answer_never_answers_the_next_request():
    bus = ScriptedBus(answers((400 * MS, 111), (1 * MS, 222)))
    channel = channel_to(bus)
    with pytest.raises(DeadlineExceeded):
        channel.upload(0x6064)
    assert channel.upload(0x6064) == (222).to_bytes(4, "little")
    # it waited for the late answer before the next request, no longer
    assert bus.sent[2] == (400 * MS + FRAME_NS, "602#4064600000000000")
    assert channel.strays == 1


def test_quarantine_ends_after_its_time_limit():
    bus = ScriptedBus(answers((-1, 111), (1 * MS, 222)))
    channel = channel_to(bus, quarantine_s=1.0)
    with pytest.raises(DeadlineExceeded):
        channel.upload(0x6064)
    assert channel.upload(0x6064) == (222).to_bytes(4, "little")
    assert bus.sent[2][0] == 1000 * MS


def test_answer_to_another_object_is_dropped():
    def peer(data: bytes) -> list[Answer]:
        if data[8] != 0x40:
            return []
        return [(1 * MS, frame("582#4341600037020000")), (2 * MS, frame("582#4364600005000000"))]

    channel = channel_to(ScriptedBus(peer))
    assert channel.upload(0x6064) == b"\x05\x00\x00\x00"
    assert channel.strays == 1


def test_answer_before_its_request_was_sent_is_dropped():
    bus = ScriptedBus(answers((1 * MS, 7), (1 * MS, 222)))
    channel = channel_to(bus)
    assert channel.upload(0x6064) == (7).to_bytes(4, "little")
    bus.deliver("582#436460006F000000", FRAME_NS // 2)  # 111, of unknown origin
    assert channel.upload(0x6064) == (222).to_bytes(4, "little")
    assert channel.strays == 1


def test_bus_without_own_frame_reports_still_works():
    bus = ScriptedBus(answers((1 * MS, 222)), confirms=False)
    assert channel_to(bus).upload(0x6064) == (222).to_bytes(4, "little")


def test_abort_of_another_transfer_is_dropped():
    def peer(data: bytes) -> list[Answer]:
        if data[8] != 0x40:
            return []
        return [(1 * MS, frame("582#8041600000000206")), (2 * MS, frame("582#4364600005000000"))]

    assert channel_to(ScriptedBus(peer)).upload(0x6064) == b"\x05\x00\x00\x00"


def test_answer_of_the_wrong_kind_is_a_violation():
    def peer(data: bytes) -> list[Answer]:
        return [(1 * MS, frame("582#6064600000000000"))] if data[8] == 0x40 else []

    bus = ScriptedBus(peer)
    channel = channel_to(bus)
    with pytest.raises(ProtocolViolation, match=r"SDO 6064h:00h: no answer but 60 64 60 00"):
        channel.upload(0x6064)
    assert bus.runtime.now_ns() == 300 * MS


def test_repeated_read_answer_does_not_confirm_a_write():
    again = ("582#43646000D7000000", "582#6064600000000000")
    script = Transcript([("602#4064600000000000", again[0])])
    bus = ScriptedBus(script)
    channel = channel_to(bus)
    channel.upload(0x6064)
    bus.peer = lambda data: [(50, frame(again[0])), (1 * MS, frame(again[1]))]
    channel.download(0x6064, 0, b"\x01\x00\x00\x00")
    assert channel.strays == 1


def test_repeated_read_answer_without_another_is_no_violation():
    """A drive may repeat a frame, whose last bit is disturbed, until it is bus-off."""
    answer = frame("582#4B07600001000000")

    def peer(data: bytes) -> list[Answer]:
        return [(1 * MS, answer)] if data[8] >> 5 in (1, 2) else []

    channel = channel_to(ScriptedBus(peer))
    channel.upload(0x6007)
    with pytest.raises(DeadlineExceeded, match="answer to SDO 6007h:00h"):
        channel.download(0x6007, 0, b"\x02\x00")
    assert channel.strays == 1


def test_repeated_segment_is_not_the_next_one():
    segments = {
        0x40: ["582#410810000A000000"],
        0x60: ["582#0054696E79204E6F"],
        0x70: ["582#0054696E79204E6F", "582#1964652000000000"],  # the first one again
    }

    def peer(data: bytes) -> list[Answer]:
        return [(place * MS, frame(text)) for place, text in enumerate(segments[data[8]], 1)]

    channel = channel_to(ScriptedBus(peer))
    assert channel.upload(0x1008) == b"Tiny Node "
    assert channel.strays == 1


@pytest.mark.parametrize(
    ("segments", "problem"),
    [
        ({0x40: "582#410810000A000000", 0x60: "582#0D54000000000000"}, "1 bytes came of 10"),
        ({0x40: "582#4108100002000000", 0x60: "582#0154696E79204E6F"}, "7 bytes came of 2"),
    ],
)
def test_answer_of_another_length_than_announced_is_a_violation(segments, problem):
    bus = ScriptedBus(lambda data: [(MS, frame(segments[data[8]]))] if data[8] in segments else [])
    with pytest.raises(ProtocolViolation, match=f"1008h:00h: {problem} announced"):
        channel_to(bus).upload(0x1008)


def test_boot_up_ends_waiting_and_quarantine():
    bus = ScriptedBus(answers((-1, 0), (1 * MS, 222)))
    channel = channel_to(bus)
    bus.queue.alarm(lambda now_ns: channel.rebooted()).set(50 * MS)
    with pytest.raises(DeadlineExceeded, match="last heard: a boot-up"):
        channel.upload(0x6064)
    assert bus.runtime.now_ns() <= 51 * MS
    bus.queue.alarm(lambda now_ns: channel.rebooted()).set(200 * MS)
    assert channel.upload(0x6064) == (222).to_bytes(4, "little")
    assert bus.sent[-1][0] == 200 * MS


def test_two_parties_take_turns_on_one_channel():
    bus = ScriptedBus(answers((1 * MS, 1), (1 * MS, 2)))
    channel = channel_to(bus)
    seen: list[tuple[str, int]] = []

    def ask(name: str) -> None:
        seen.append((name, int.from_bytes(channel.upload(0x6064), "little")))

    parties = [bus.runtime.spawn(name, lambda name=name: ask(name)) for name in ("a", "b")]
    assert all(party.join(1.0) for party in parties)
    assert seen == [("a", 1), ("b", 2)]
    assert bus.sent[1][0] >= bus.sent[0][0] + FRAME_NS + 1 * MS  # never two requests at once
