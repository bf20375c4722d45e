"""The connection to one drive, seen from a drive that is written by hand."""

import struct

import can
import pytest

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.frame import pack, pack_fd
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.python_can.bus import close_rig, open_rig
from motorhil.harness.virtual_time.runtime import VirtualRuntime
from motorhil.motorapi.api import (
    CanDrive,
    DeadlineExceeded,
    LinkError,
    MotorError,
    PeriodicMessage,
    SetpointStream,
    UsageError,
    checked_node,
)
from motorhil.motorapi.synchronization.bus_load import own_traffic
from tests.support.can.error_messages import tell

COMMAND, ANSWER, ALIVE = 0x101, 0x201, 0x301
TIMEOUT_S = 0.06
BUS_OFF = struct.pack("<IB3x8s", 0x2000_0040, 8, b"")  # linux/can/error.h: CAN_ERR_BUSOFF


class Hardware:
    def __init__(self, name):
        self.name = name

    def __repr__(self):
        return self.name


class Rig:
    """An FD bus with an application, and a peer that plays the drive."""

    def __init__(self):
        queue = EventQueue()
        self.world = World(queue)
        self.world.add_bus(CanBus("can0", 500_000, data_bitrate_bit_s=2_000_000))
        self.runtime = VirtualRuntime(queue)
        open_rig(self.world, self.runtime)
        self.bus = can.Bus(interface="emulated", channel="can0", fd=True)
        self.heard = []
        self.peer = self.world.add_host(
            "can0", "drive", lambda frame, time_ns, _: self.heard.append((frame, time_ns))
        )

    def wait(self, time_s):
        self.runtime.wait_until(lambda: False, time_s)

    def close(self):
        self.bus.shutdown()
        close_rig(self.world)
        self.runtime.close()


@pytest.fixture
def rig():
    rig = Rig()
    yield rig
    rig.close()


@pytest.fixture
def drive(rig):
    drive = CanDrive(rig.bus, 1, Hardware("the hardware"))
    yield drive
    drive.close(at_rest=True)


@pytest.mark.parametrize(
    ("extended", "fd", "told"),
    [
        (False, False, pack(COMMAND, b"ab")),
        (True, False, pack(COMMAND | 0x8000_0000, b"ab")),
        (True, True, pack_fd(COMMAND | 0x8000_0000, b"ab")),
    ],
)
def test_command_is_sent_and_confirmed_at_its_time(rig, extended, fd, told):
    drive = CanDrive(rig.bus, 1, Hardware("the hardware"), extended=extended, fd=fd)
    sent = drive.command(COMMAND, b"ab", flags=1 if fd else None)
    assert sent.time_ns is None
    assert drive.confirm(sent) == sent.time_ns
    assert rig.heard == [(told, sent.time_ns)]
    drive.close(at_rest=True)


def test_frames_reach_the_handler_of_their_format_only(rig):
    drive = CanDrive(rig.bus, 1, Hardware("the hardware"), extended=True, fd=True)
    got = []
    drive.handle(ANSWER, lambda data, time_ns: got.append(data))
    for frame in (
        pack(ANSWER, b"short"),
        pack(ANSWER | 0x8000_0000, b"long"),
        pack_fd(ANSWER | 0x8000_0000, bytes(64)),
    ):
        rig.peer.send(frame)
        rig.wait(0.01)
    assert got == [b"long", bytes(64)]
    drive.close(at_rest=True)


def test_fd_frames_stay_away_from_a_classical_drive(rig, drive):
    got = []
    drive.handle(ANSWER, lambda data, time_ns: got.append(data))
    rig.peer.send(pack_fd(ANSWER, b"fd"))
    rig.peer.send(pack(ANSWER, b"ok"))
    rig.wait(0.01)
    assert got == [b"ok"]


def test_drives_of_a_bus_listen_once_together(rig, monkeypatch):
    listened, listen = [], VirtualRuntime.listen

    def counted(runtime, bus, on_frame, *, fd=False):
        listened.append(fd)
        return listen(runtime, bus, on_frame, fd=fd)

    monkeypatch.setattr(VirtualRuntime, "listen", counted)
    hardware = [Hardware(f"{node}") for node in range(16)]
    drives = [CanDrive(rig.bus, node, one) for node, one in enumerate(hardware)]
    fd_drive = CanDrive(rig.bus, 16, rig, fd=True)
    assert listened == [False, True]  # again when the first drive asks for CAN FD
    got = []
    for node, drive in enumerate([*drives[:2], fd_drive]):
        drive.handle(ANSWER, lambda data, time_ns, node=node: got.append((node, data)))
    rig.peer.send(pack(ANSWER, b"to all"))
    rig.peer.send(pack_fd(ANSWER, b"fd"))
    rig.wait(0.01)
    assert got == [(0, b"to all"), (1, b"to all"), (2, b"to all"), (2, b"fd")]
    got.clear()
    drives[0].close(at_rest=True)
    drives[1].handle(ANSWER, lambda data, time_ns: got.append("again"))
    rig.peer.send(pack(ANSWER))
    rig.wait(0.01)
    assert got == [(2, b""), "again"]
    for drive in (*drives, fd_drive):
        drive.close(at_rest=True)


@pytest.mark.parametrize("is_news", [True, False])
def test_frame_of_a_drive_is_news_unless_told_otherwise(rig, drive, is_news):
    drive.handle(ANSWER, lambda data, time_ns: None, is_news=is_news)
    before = drive.news.count
    rig.peer.send(pack(ANSWER))
    rig.wait(0.01)
    assert drive.news.count - before == (1 if is_news else 0)


@pytest.mark.parametrize(("data", "flags"), [(bytes(9), None), (bytes(9), 1), (bytes(65), 1)])
def test_data_of_impossible_length_are_refused(rig, drive, data, flags):
    with pytest.raises(ValueError, match=rf"101h: {len(data)} bytes of data"):
        drive.command(COMMAND, data, flags=flags)
    rig.wait(0.01)
    assert not rig.heard


def test_missing_sign_of_life_is_a_loss_until_it_comes_again(rig, drive):
    losses = []
    sign = drive.expect("heartbeat", TIMEOUT_S, lambda: losses.append(rig.runtime.now_ns()))
    drive.handle(ALIVE, lambda data, time_ns: sign.came(time_ns))
    rig.wait(1.0)
    assert not drive.is_lost  # never heard is not lost: connect tells that
    rig.peer.send(pack(ALIVE))
    rig.wait(TIMEOUT_S)
    assert not drive.is_lost
    count = drive.news.count
    rig.wait(TIMEOUT_S)
    assert drive.is_lost
    assert drive.news.count > count
    with pytest.raises(LinkError, match="can0 node 1: no heartbeat for 60 ms"):
        drive.check()
    assert len(losses) == 1
    assert losses[0] - sign.last_ns <= TIMEOUT_S * 1e9 * 7 / 6
    rig.peer.send(pack(ALIVE))
    rig.wait(0.01)
    drive.check()


def test_connect_asks_until_the_drive_is_heard(rig, drive):
    asked, up = [], []
    drive.handle(ALIVE, lambda data, time_ns: up.append(time_ns))

    def ask():
        asked.append(drive.request(COMMAND, remote=4))
        if len(asked) == 3:
            rig.peer.send(pack(ALIVE))

    drive.connect(lambda: bool(up), ask, 1.0, "heartbeat")
    assert len(asked) == 3
    assert rig.heard[0][0] == struct.pack("<IB3x8s", COMMAND | 0x4000_0000, 4, b"")
    drive.connect(lambda: bool(up), ask, 1.0, "heartbeat")
    assert len(asked) == 3


def test_first_of_two_callers_connects_for_both(rig, drive):
    asked, up = [], []
    drive.handle(ALIVE, lambda data, time_ns: up.append(time_ns))

    def connect(name):
        def ask():
            asked.append(name)
            if len(asked) == 3:
                rig.peer.send(pack(ALIVE))

        drive.connect(lambda: bool(up), ask, 1.0, "heartbeat")

    other = rig.runtime.spawn("other", lambda: connect("other"))
    connect("first")
    assert other.join(1.0)
    assert (other.error, len(asked), len(set(asked))) == (None, 3, 1)


def test_frame_that_was_not_recognised_is_named(rig, drive):
    drive.handle(ANSWER, lambda data, time_ns: None)
    with pytest.raises(LinkError, match=r"no reply within 0\.5 s; last heard: .*h with 21 at 0\."):
        drive.connect(lambda: False, lambda: rig.peer.send(pack(ANSWER, b"!")), 0.5, "reply")


def test_drive_that_is_not_heard_is_a_link_error(drive):
    with pytest.raises(LinkError, match=r"can0 node 1: no heartbeat within 0\.5 s"):
        drive.connect(lambda: False, lambda: None, 0.5, "heartbeat")


def test_exchange_returns_with_its_answer_or_a_reason(rig, drive):
    got = []
    drive.handle(ANSWER, lambda data, time_ns: got.append(data))

    def ask():
        drive.request(COMMAND, b"?")
        rig.peer.send(pack(ANSWER, b"!"))

    drive.exchange(ask, lambda: bool(got), 0.1, "the answer")
    assert got == [b"!"]
    with pytest.raises(DeadlineExceeded, match=r"can0 node 1: the answer.*h with 21 at 0\.\d+ s"):
        drive.exchange(lambda: drive.request(COMMAND), lambda: len(got) > 1, 0.1, "the answer")


def test_exchange_repeats_its_request_until_answered(rig, drive):
    asked, got = [], []
    drive.handle(ANSWER, lambda data, time_ns: got.append(time_ns))

    def ask():
        asked.append(rig.runtime.now_ns())
        drive.request(COMMAND)
        if len(asked) == 3:
            rig.peer.send(pack(ANSWER))

    drive.exchange(ask, lambda: bool(got), 1.0, "the answer", repeat_s=0.02)
    assert [round((now_ns - asked[0]) / 1e9, 6) for now_ns in asked] == [0.0, 0.02, 0.04]
    with pytest.raises(DeadlineExceeded):
        drive.exchange(ask, lambda: False, 0.05, "another", repeat_s=0.02)
    assert len(asked) == 6


def test_ask_waits_for_an_answer_after_its_request(rig, drive):
    drive.handle(ANSWER, lambda data, time_ns: drive.answered(data[0]))
    rig.peer.send(pack(ANSWER, b"\1"))
    rig.wait(0.01)  # an earlier answer, and one under another key, do not count
    others = []

    def request():
        others.append(drive.request(COMMAND))
        rig.peer.send(pack(ANSWER, b"\2"))

    with pytest.raises(DeadlineExceeded, match="answer 1"):
        drive.ask(1, request, 0.1, "answer 1")
    drive.ask(2, request, 0.1, "answer 2")
    assert len(others) == 2


def test_repeat_pauses_while_the_bus_is_off(rig, drive):
    runs = []

    def send():
        runs.append(rig.runtime.now_ns())
        if len(runs) == 2:
            raise LinkError(link="can0", reason="it is full")

    drive.repeat(0.01, send)
    rig.wait(0.035)
    assert len(runs) == 3  # also after an error of the bus
    tell(rig.world, "can0", "host", BUS_OFF)
    rig.wait(0.1)
    assert drive.status.is_off
    assert len(runs) == 3


@pytest.mark.parametrize(("extended", "fd"), [(False, False), (True, False), (True, True)])
def test_noted_frames_have_the_format_of_the_drive(rig, extended, fd):
    drive = CanDrive(rig.bus, 2, Hardware("the hardware"), extended=extended, fd=fd)
    drive.note_frames([(ANSWER, 8, 0.01)], [(COMMAND, 4, 0.02), (COMMAND | 0x8000_0000, 2, 0.5)])
    (traffic,) = own_traffic(rig.bus)
    form = {"extended": extended, "fd": fd, "bit_rate_switch": fd}
    assert traffic.sent == (PeriodicMessage(ANSWER, 8, 0.01, **form),)
    assert traffic.ours == (
        PeriodicMessage(COMMAND, 4, 0.02, **form),
        PeriodicMessage(COMMAND, 2, 0.5, **(form | {"extended": True})),
    )
    drive.close(at_rest=True)


def test_declared_start_is_offered(drive):
    assert drive.own_offer() is None
    drive.starts_by(COMMAND, 4)
    assert drive.own_offer() == drive.start_offer(COMMAND, 4)
    drive.starts_by(COMMAND, 48, flags=1)
    assert drive.own_offer() == drive.start_offer(COMMAND, 48, flags=1)


def test_bus_off_ends_waits_at_once(rig, drive):
    began_ns = rig.runtime.now_ns()

    def fail():
        tell(rig.world, "can0", "host", BUS_OFF)

    with pytest.raises(LinkError, match=r"bus-off|was off"):
        drive.exchange(fail, lambda: False, 5.0, "the answer")
    assert rig.runtime.now_ns() - began_ns < 1e9
    with pytest.raises(LinkError, match="bus-off"):
        drive.command(COMMAND, b"")
    assert drive.is_lost


def test_memory_of_what_was_told_ends_with_the_token(drive):
    drive.remember("mode", 3)
    assert drive.remembered("mode") == 3
    drive.physical.token += 1
    assert drive.remembered("mode") is None
    drive.remember("limit", 1.0)
    drive.doubt()
    assert drive.remembered("limit") is None


def test_second_hardware_object_for_a_drive_is_refused(rig, drive):
    with pytest.raises(UsageError, match="the hardware"):
        CanDrive(rig.bus, 1, Hardware("another one"))


def test_closed_drive_refuses_and_frees_its_place(rig):
    drive = CanDrive(rig.bus, 1, Hardware("the hardware"))
    runs = []
    drive.every(0.01, lambda: runs.append(1))
    drive.close(at_rest=True)
    drive.close(at_rest=True)
    rig.wait(0.1)
    assert not runs
    assert drive.is_lost
    with pytest.raises(LinkError, match="this hardware object is closed"):
        drive.command(COMMAND, b"")
    CanDrive(rig.bus, 1, Hardware("the next")).close(at_rest=True)


def test_fd_drive_on_a_classical_bus_object_frees_its_place(rig):
    with can.Bus(interface="emulated", channel="can0") as bus:
        with pytest.raises(UsageError, match="opened for classical CAN"):
            CanDrive(bus, 2, Hardware("the hardware"), fd=True)
        CanDrive(bus, 2, Hardware("the hardware")).close(at_rest=True)


@pytest.mark.parametrize("node", [-1, 63, "1", True, 1.0, None])
def test_number_of_a_drive_out_of_range_is_refused(node):
    with pytest.raises(UsageError, match=r"node_id of an X = .*: out of range; expected 0 to 62"):
        checked_node(node, 62, "node_id of an X")


class TestSetpointStream:
    def stream(self, drive, sent, duration_s, last):
        def send(value, fence):
            sent.append(value)
            return drive.command(COMMAND, struct.pack("<f", value), fence=fence)

        return SetpointStream(drive, lambda at_s: 10.0 * at_s, duration_s, 0.01, send, last.append)

    def test_stream_samples_the_function_up_to_its_end(self, rig, drive):
        sent, last = [], []
        stream = self.stream(drive, sent, 0.035, last)
        first = stream.begin()
        rig.wait(0.2)
        assert sent == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.35])
        assert not stream.is_going
        assert (first.time_ns, len(last), stream.late_s) == (rig.heard[0][1], 1, 0.0)
        assert last[0].time_ns == rig.heard[-1][1]

    def test_stream_of_one_setpoint_ends_with_it(self, rig, drive):
        sent, last = [], []
        stream = self.stream(drive, sent, 0.0, last)
        assert last == [stream.begin()]
        rig.wait(0.1)
        assert sent == [0.0]

    def test_error_ends_the_stream_and_is_kept(self, rig, drive):
        sent, last = [], []
        stream = self.stream(drive, sent, 1.0, last)
        stream.begin()
        tell(rig.world, "can0", "host", BUS_OFF)
        count = drive.news.count
        rig.wait(0.1)
        assert isinstance(stream.error, MotorError)
        assert (stream.is_going, last) == (False, [])
        assert drive.news.count > count

    def test_cancelled_stream_sends_nothing_more(self, rig, drive):
        sent, last = [], []
        stream = self.stream(drive, sent, 1.0, last)
        stream.begin()
        stream.cancel()
        stream.cancel()
        rig.wait(0.1)
        assert (sent, last) == ([0.0], [])
