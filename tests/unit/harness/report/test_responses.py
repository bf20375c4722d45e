"""Response times on the page: recorded lower bounds beside the theory's upper bounds."""

from pathlib import Path

import can
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.bus.port import confirms
from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.emulators.can.frame import pack
from motorhil.harness.analysis.from_recording import RecordedBus
from motorhil.harness.analysis.subject import Queues
from motorhil.harness.cli.main import main
from motorhil.harness.report.responses import MESSAGES_MAX
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.synchronization.can_response_time import ErrorModel, response_times
from motorhil.traces.can_frame import BRS, flexible
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Schema, encode_can_frame
from tests.support.can.deliveries import run
from tests.support.recordings.handmade import MS, Recorded
from tests.unit.harness.report.conftest import document_in

US = 1_000
RIG = "[bus.can0]\nbitrate_bit_s = 500_000\n"
BIT_S = 2e-6


def recorded(path, frames, rig=RIG):
    with TraceWriter(path) as writer:
        if rig:
            writer.attach("rig.toml", rig.encode(), "application/toml")
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for time_ns, frame, *sender in sorted(frames):
            writer.write(
                channel, time_ns, encode_can_frame(frame, sender=sender[0] if sender else "")
            )
    return path


def every(period_ns, frame, late_ns=None, count=40):
    """Return periodic frames, some of them delayed, by number."""
    return [(n * period_ns + (late_ns or {}).get(n, 0), frame) for n in range(1, count)]


def seconds(message, *keys):
    return [pytest.approx(message[f"{key}_s"], abs=1e-12) for key in keys]


def test_recorded_times_bound_and_deadline_are_shown(tmp_path, report_of):
    """000h: 53 bits (can-physics, 6.2), 7FFh: 50; both 55 at most, and one was 300 us late."""
    frames = every(10 * MS, pack(0x000)) + every(40 * MS, pack(0x7FF), {5: 300 * US})
    (bus,) = report_of(recorded(tmp_path / "a.mcap", frames))[1]["responses"]
    assert (bus["bus"], bus["why"]) == ("can0", "")
    assert bus["about"] == "500000 bit/s, utilisation at most 1.4%"
    first, second = bus["messages"]
    assert [first["label"], first["frames"], first["bytes"]] == ["000h", 39, "0"]
    assert seconds(first, "least", "usual", "most") == [53 * BIT_S, 53 * BIT_S, 53 * BIT_S]
    assert seconds(first, "bound", "deadline", "period") == [110 * BIT_S, 0.01, 0.01]
    assert seconds(second, "least", "usual", "most") == [
        50 * BIT_S,
        50 * BIT_S,
        50 * BIT_S + 300e-6,
    ]
    assert seconds(second, "bound") == [110 * BIT_S + 300e-6]


def test_usual_time_is_the_median_delay(tmp_path, report_of):
    late = {n: 100 * US for n in range(1, 39) if n % 3}
    frames = every(10 * MS, pack(0x7FF), late)
    (bus,) = report_of(recorded(tmp_path / "a.mcap", frames))[1]["responses"]
    (message,) = bus["messages"]
    assert seconds(message, "usual", "most") == [50 * BIT_S + 100e-6] * 2


def test_can_fd_bound_uses_both_rates(tmp_path, report_of):
    """64 bytes: 712 bits at most, 33 of them at 500 kbit/s (can-physics, 6.3)."""
    frames = every(10 * MS, flexible(0x123, BRS, bytes([0x55]) * 64))
    rig = RIG + "data_bitrate_bit_s = 2_000_000\n"
    (bus,) = report_of(recorded(tmp_path / "a.mcap", frames, rig))[1]["responses"]
    (message,) = bus["messages"]
    assert message["bytes"] == "64 FD"
    assert seconds(message, "bound") == [33 * BIT_S + 679 * BIT_S / 4]
    assert 579 * BIT_S / 4 < message["least_s"] == message["most_s"] < message["bound_s"]
    (slow,) = report_of(recorded(tmp_path / "b.mcap", frames))[1]["responses"]
    assert seconds(slow["messages"][0], "bound") == [712 * BIT_S]
    assert "the data bit rate of 39 CAN FD frames is not known" in slow["notes"][0]


def test_one_frame_without_switch_counts_for_all(tmp_path, report_of):
    data = bytes([0x55]) * 64
    switched = every(10 * MS, flexible(0x123, BRS, data))
    rig = RIG + "data_bitrate_bit_s = 2_000_000\n"
    for place in (0, 20):
        frames = list(switched)
        frames[place] = (frames[place][0], flexible(0x123, 0, data))
        (bus,) = report_of(recorded(tmp_path / f"{place}.mcap", frames, rig))[1]["responses"]
        assert seconds(bus["messages"][0], "bound") == [712 * BIT_S]


def test_rig_with_errors_and_can_fd_gives_response_times(tmp_path):
    """Destroyed frames are sent again, so they are late, and error frames are recorded."""
    path = tmp_path / "rig.toml"
    path.write_text(
        f"{RIG}data_bitrate_bit_s = 2_000_000\n[bus.can0.node.ear]\nsilent = true\nframes = 'fd'\n"
        "[[fault]]\nbus = 'can0'\nkind = 'error'\nerror = 'crc'\nprobability = 0.2\n"
    )
    record = tmp_path / "errors.mcap"
    with Rig.open(path, seed=3, record=record) as rig:
        bus = can.Bus(interface="emulated", channel="can0", fd=True)
        for number in range(60):
            message = can.Message(
                arbitration_id=0x123 if number % 2 else 0x80,
                data=bytes(64),
                is_extended_id=False,
                is_fd=True,
                bitrate_switch=True,
            )
            bus.send(message)
            rig.runtime.run_for(0.005)
        bus.shutdown()
    page = tmp_path / "errors.html"
    assert main(["report", str(record), "-o", str(page)]) == 0
    (told,) = document_in(page)[0]["responses"]
    assert [one["label"] for one in told["messages"]] == ["080h", "123h"]
    for one in told["messages"]:
        assert one["least_s"] < one["most_s"] < one["bound_s"] < one["deadline_s"]
    assert any("error messages were recorded" in note for note in told["notes"])


def test_missing_bit_rate_is_stated(tmp_path, report_of):
    path = recorded(tmp_path / "a.mcap", every(10 * MS, pack(0x7FF)), rig="")
    (bus,) = report_of(path)[1]["responses"]
    assert bus["why"] == "its bit rate is not in the recording; give --bitrate"
    assert bus["messages"] == []
    page = tmp_path / "a.html"
    assert main(["report", str(path), "-o", str(page), "--bitrate", "can0=500k"]) == 0
    (known,) = document_in(page)[0]["responses"]
    assert [one["label"] for one in known["messages"]] == ["7FFh"]


@pytest.mark.parametrize(
    ("frames", "why"),
    [
        ([], None),
        ([(5, pack(1))], None),
        ([(n * n * MS, pack(1)) for n in range(30)], None),
        ([(7, pack(n)) for n in range(30)], None),  # all at the same time
        (
            [(n * 10 * MS, pack(number)) for n in range(12) for number in range(MESSAGES_MAX + 1)],
            "it has 501 messages; at most 500 are analysed",
        ),
    ],
)
def test_no_or_too_many_messages_give_no_rows(tmp_path, report_of, frames, why):
    told = report_of(recorded(tmp_path / "a.mcap", frames))[1]["responses"]
    assert [bus["why"] for bus in told] == ([] if why is None else [why])


def test_full_bus_has_no_bound(tmp_path, report_of):
    """200 frames of up to 55 bits in 20 ms at 500 kbit/s: 110 % with all stuff bits."""
    frames = [(n * 100 * US, pack(0x7FF)) for n in range(1, 200)]
    frames += every(1 * MS, pack(0x7FE), count=20)
    (bus,) = report_of(recorded(tmp_path / "a.mcap", frames))[1]["responses"]
    urgent, starving = bus["messages"]
    assert urgent["bound_s"] is not None
    assert starving["bound_s"] is None


def test_modbus_recording_has_no_response_times(tmp_path, report_of):
    path = Recorded(Path(tmp_path / "a.mcap")).modbus(1, "0103", True).close()
    assert report_of(path)[1]["responses"] == []


@given(
    st.lists(
        st.tuples(st.integers(0, 0x7FF), st.integers(0, 8), st.integers(400, 2_000)),
        min_size=2,
        max_size=5,
        unique_by=lambda one: one[0],
    ),
    st.randoms(use_true_random=False),
    st.sampled_from([0.0, 0.0, 0.1]),
)
def test_recorded_time_never_exceeds_the_true_one(messages, chance, errors: float):
    """The delay proved by later frames never exceeds the true one of the simulated bus."""
    rule = FaultRule("struck", FaultKind.ERROR, probability=errors, bit=20)
    bus = CanBus("can0", 1_000_000, FaultPlan([rule] if errors else [], chance.random))
    ports = {one[0]: bus.attach(f"{one[0]:X}") for one in messages}
    bus.attach("ear")
    due: dict[int, list[int]] = {}
    queued = []
    for identifier, length, period_us in messages:
        phase_us = chance.randrange(period_us)
        times = [(phase_us + n * period_us) * US for n in range(30)]
        due[identifier] = list(times)
        queued += [
            (at, ports[identifier], pack(identifier, chance.randbytes(length))) for at in times
        ]
    took: dict[int, int] = {}
    heard = RecordedBus("can0")
    for end_ns, (frame, sender, kind) in run(bus, sorted(queued), until_ns=10**12):
        if confirms(kind):
            identifier = int.from_bytes(frame[:2], "little")
            late_ns = end_ns + 3 * US - due[identifier].pop(0)
            took[identifier] = max(took.get(identifier, 0), late_ns)
            heard.take(end_ns, frame, str(sender))
    subject = heard.subject(1_000_000, None, {}, Queues())
    bounds = {
        one.message.rank: one.response_ns for one in response_times(subject.load, ErrorModel(0))
    }
    for seen in subject.recorded:
        message = seen.message
        if message.arrival.value == "periodic":
            assert seen.shortest is not None
            told_ns = seen.shortest.time_ns(1_000_000) + message.jitter_ns
            bound_ns = bounds[message.rank]
            share = told_ns / took[message.identifier]
            event(f"{share:.1f} of how late it was")
            assert told_ns <= took[message.identifier]
            assert bound_ns is None or told_ns <= bound_ns
