"""Immediate stop of a drive without PDOs, during any SDO transfer."""

from collections.abc import Callable
from pathlib import Path

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel
from motorhil.motorapi.errors import DeadlineExceeded, MotionInterrupted
from motorhil.motorapi.runtime.can_link import CanLink
from tests.support.motors.drive_rigs import drive
from tests.support.motors.scripted import FRAME_NS, MS, Answer, ScriptedBus, frame
from tests.support.motors.wheels import go_to, motor_of, truth
from tests.support.sharing.movers import without_pdos

HALT = bytes.fromhex("2B406000 0F010000")  # CiA 301: expedited download; CiA 402: 6040h = 010Fh
QUICK_STOP = bytes.fromhex("2B406000 02000000")
SET_POINT = bytes.fromhex("2B406000 3F000000")


@pytest.fixture
def rig(open_rig: Callable[..., Rig], tmp_path: Path) -> Rig:
    (tmp_path / "sdo_only.eds").write_text(without_pdos(OWN_EDS.read_text()))
    return open_rig(drive("left", 1, 'eds = "sdo_only.eds"'))


def told(rig: Rig) -> list[tuple[int, bytes]]:
    """Record (time, controlword download) of all from now on."""
    found: list[tuple[int, bytes]] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        if data[:2] == b"\x01\x06" and data[9:12] == b"\x40\x60\x00":
            found.append((time_ns, data[8:16]))

    rig.world.tap_frames(on_frame)
    return found


def lose_answer_to_set_point(rig: Rig) -> None:
    """Drop the next confirmation of the controlword that starts the motion."""
    words: list[bytes] = []

    def on_frame(bus: str, time_ns: int, sender: str, data: bytes) -> None:
        if data[:2] == b"\x01\x06" and data[8:16] == SET_POINT and not words:
            words.append(data)
            rig.faults.inject("can0", FaultRule("lose", FaultKind.DROP, identifier=0x581, limit=1))

    rig.world.tap_frames(on_frame)


@pytest.mark.parametrize(("stop", "word"), [("stop", HALT), ("quick_stop", QUICK_STOP)])
def test_stop_after_a_lost_answer_is_sent_at_once(rig: Rig, stop: str, word: bytes):
    motor = motor_of(rig)
    motor.enable()
    lose_answer_to_set_point(rig)
    heard = told(rig)
    with pytest.raises(DeadlineExceeded):
        go_to(motor, 3.0)
    now_ns = rig.runtime.now_ns()
    getattr(motor, stop)()
    assert rig.runtime.now_ns() == now_ns
    motor.wait_until_done(timeout_s=5)
    at_ns = next(time_ns for time_ns, data in heard if data == word)
    assert at_ns - now_ns < 1 * MS
    assert truth(rig) < 2.5
    motor.enable()
    go_to(motor, 0.0)  # and nothing delays it
    motor.wait_until_done(timeout_s=5)
    assert abs(truth(rig)) < 0.01


def test_callback_stops_the_drive_without_waiting(rig: Rig):
    motor = motor_of(rig)
    motor.enable()
    go_to(motor, 3.0)
    heard = told(rig)
    at_ns = rig.runtime.now_ns() + 200 * MS
    timer = rig.runtime.every(0.2, lambda: (motor.stop(), timer.cancel()))
    with pytest.raises(MotionInterrupted):
        motor.wait_until_done(timeout_s=5)
    assert heard[0][1] == HALT
    assert heard[0][0] - at_ns < 1 * MS
    rig.runtime.run_for(2.0)
    assert truth(rig) < 1.0


@pytest.mark.parametrize("lost", [1, 3])
def test_lost_stop_is_repeated_until_the_drive_obeys(rig: Rig, lost: int):
    motor = motor_of(rig)
    motor.enable()
    go_to(motor, 3.0)
    rig.runtime.run_for(0.2)
    heard = told(rig)
    rig.faults.inject("can0", FaultRule("lose", FaultKind.DROP, identifier=0x601, limit=lost))
    motor.stop()
    rig.runtime.run_for(0.1 * lost + 0.05)
    motor.wait_until_done(timeout_s=5)
    halts = [time_ns for time_ns, data in heard if data == HALT]
    assert [round((time_ns - halts[0]) / MS) for time_ns in halts[: lost + 1]] == [
        100 * place for place in range(lost + 1)
    ]
    assert truth(rig) < 2.0
    rig.runtime.run_for(2.0)
    count = len(heard)
    rig.runtime.run_for(2.0)
    assert len(heard) == count


# ---- the channel alone ----


ASKED, LATE = "602#4064600000000000", "582#4364600001000000"
STOP, STOPPED = "602#2B4060000F010000", "582#6040600000000000"
GO = b"\x0f\0"


def channel_to(bus: ScriptedBus) -> SdoChannel:
    return SdoChannel(CanLink(bus, bus.runtime), 2, timeout_s=0.3, quarantine_s=1.0)


def answering(table: dict[str, list[Answer]]):
    """Return a peer that answers each request with the next entry of its list."""

    def peer(data: bytes) -> list[Answer]:
        waiting = table.get(data[8:16].hex().upper(), [])
        return [waiting.pop(0)] if waiting else []

    return peer


def test_stop_at_once_neither_ends_quarantine_nor_answers():
    """An upload gets no answer in time; the answer to a stop comes before the late one."""
    bus = ScriptedBus(
        answering(
            {
                "4064600000000000": [(600 * MS, frame(LATE)), (1 * MS, frame(LATE[:-8] + "0" * 8))],
                "2B4060000F010000": [(1 * MS, frame(STOPPED))],
            }
        )
    )
    channel = channel_to(bus)
    with pytest.raises(DeadlineExceeded):
        channel.upload(0x6064)
    channel.send_at_once(0x6040, 0, b"\x0f\x01")
    assert bus.sent[-1] == (300 * MS, STOP)
    assert channel.upload(0x6064) == bytes(4)
    assert bus.sent[-1][0] == 600 * MS + FRAME_NS  # when the late one had come
    assert channel.strays == 2


@pytest.mark.parametrize("answered", [True, False])
def test_same_object_is_not_requested_before_the_stop_answer(answered: bool):
    stopped = [(5 * MS, frame(STOPPED))] if answered else []
    bus = ScriptedBus(
        answering({"2B4060000F010000": stopped, "2B4060000F000000": [(1 * MS, frame(STOPPED))]})
    )
    channel = channel_to(bus)
    channel.send_at_once(0x6040, 0, b"\x0f\x01")
    channel.download(0x6040, 0, GO)
    assert bus.sent[1][0] == (5 * MS + FRAME_NS if answered else 1000 * MS)


def test_other_objects_are_requested_meanwhile():
    bus = ScriptedBus(answering({"4064600000000000": [(1 * MS, frame(LATE))]}))
    channel = channel_to(bus)
    channel.send_at_once(0x6040, 0, b"\x0f\x01")
    channel.upload(0x6064)
    assert bus.sent[1] == (0, ASKED)


@pytest.mark.parametrize("by_others", [False, True])
@pytest.mark.parametrize("heard", [False, True])
def test_stop_answer_does_not_confirm_another_download(by_others: bool, heard: bool):
    """`heard`: whether the device had received the active download."""
    own = [(4 * MS, frame(STOPPED))] if heard else []
    stopped = [(4 * MS, frame(STOPPED))]
    bus = ScriptedBus(answering({"2B4060000F000000": own, "2B4060000F010000": stopped}))
    channel = channel_to(bus)

    def stop(now_ns: int) -> None:
        if by_others:
            bus.deliver(STOP)
            bus.deliver(STOPPED, 4 * MS)
        else:
            channel.send_at_once(0x6040, 0, b"\x0f\x01")

    bus.queue.alarm(stop).set(2 * MS)
    if heard:
        channel.download(0x6040, 0, GO)
        assert bus.runtime.now_ns() >= 6 * MS
        assert channel.strays == 1
    else:
        with pytest.raises(DeadlineExceeded):
            channel.download(0x6040, 0, GO)


def test_booted_device_owes_no_answer_to_an_earlier_stop():
    bus = ScriptedBus(answering({"2B4060000F000000": [(1 * MS, frame(STOPPED))]}))
    channel = channel_to(bus)
    channel.send_at_once(0x6040, 0, b"\x0f\x01")
    channel.rebooted()
    channel.download(0x6040, 0, GO)
    assert bus.sent[1][0] == 0
