"""Reports of all kinds of recordings: imported, truncated, empty, without times, in wall time."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from motorhil.harness.cli.main import main
from motorhil.harness.report.collect import collect
from motorhil.harness.report.document import document_of
from motorhil.harness.report.series import (
    Track,
    cells,
    difference,
    extremes,
    reduce_held,
    reduce_rows,
    remarkable,
)
from motorhil.traces.can_frame import BRS, flexible
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import (
    CAN_FRAME,
    GROUP_SYNC,
    MODBUS_ADU,
    MOTOR_LOCK,
    Schema,
    encode_can_frame,
)
from tests.support.recordings.handmade import MS, Recorded, S

WALL_NS = 1_700_000_000 * S
ERROR_FRAME = struct.pack("<IB3x8s", 0x2000_0040, 8, bytes(8))  # bus-off, linux/can/error.h


def plain(path, frames):
    """Record CAN frames only, as `motorhil convert` does."""
    with TraceWriter(path) as writer:
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for time_ns, frame in frames:
            writer.write(channel, time_ns, encode_can_frame(frame))
    return path


def frame(identifier, data=""):
    content = bytes.fromhex(data)
    return struct.pack("<IB3x8s", identifier, len(content), content)


def rows(document, title):
    timeline = next(one for one in document["timelines"] if one["title"] == title)
    return {row["name"]: row for row in timeline["rows"]}


def words(document, arrays, title, name):
    timeline = next(one for one in document["timelines"] if one["title"] == title)
    row = next(one for one in timeline["rows"] if one["name"] == name)
    return [timeline["words"][word] for word in arrays.whole(row["word"])]


@pytest.fixture
def drive(tmp_path):
    """Record a drive with its PDO mapping: 6041h and 6064h, and 6062h."""
    told = [(0, frame(0x701, "00"))]
    for index, entries in (("001A", ("10004160", "20006460")), ("011A", ("20006260",))):
        parts = [f"2F{index}0000", *(f"23{index}{n + 1:02X}{e}" for n, e in enumerate(entries))]
        for data in (*parts, f"2F{index}00{len(entries):02X}"):
            told.append((len(told) * MS, frame(0x601, data.ljust(16, "0"))))
            told.append((len(told) * MS, frame(0x581, "60" + data[2:8] + "00000000")))
    told.append((100 * MS, frame(0x701, "05")))
    for step, (state, demand, actual) in enumerate(
        (("5002", 0, 0), ("3106", 0, 0), ("3706", 5, 0), ("3706", 9, -6), ("0806", 9, 8))
    ):
        at = (200 + 10 * step) * MS
        told.append((at, frame(0x281, demand.to_bytes(4, "little", signed=True).hex())))
        position = actual.to_bytes(4, "little", signed=True).hex()
        told.append((at + MS, frame(0x181, state + position)))
    told.append((300 * MS, frame(0x081, "1023010000000000")))
    return plain(tmp_path / "drive.mcap", told)


def test_imported_drive_is_drawn_in_increments(drive, report_of):
    _, document, arrays = report_of(drive)
    (motor,) = document["motors"]
    plots = {plot["quantity"]: plot for plot in motor["plots"]}
    assert motor["name"] == "can0 node 1"
    assert [line["role"] for line in plots["position"]["lines"]] == ["demand", "actual"]
    assert plots["position"]["unit"] == "inc"
    demand, actual = plots["position"]["lines"]
    assert arrays.numbers(demand["v"]) == [0, 5, 9]
    assert arrays.numbers(actual["v"]) == [0, -6, 8]
    (error,) = plots["following error"]["lines"]
    assert arrays.numbers(error["v"])[-3:] == [
        9,
        15,
        1,
    ]  # demand minus actual, for each new value
    assert "6062h minus 6064h" in error["source"]
    assert plots["velocity"]["lines"] == []
    assert "no velocity in the recording" in plots["velocity"]["missing"]
    assert "the recording does not give" in motor["scale"]


def test_imported_drive_has_states_and_faults(drive, report_of):
    _, document, arrays = report_of(drive)
    assert words(document, arrays, "PDS FSA", "can0 node 1") == [
        "switch on disabled",
        "ready to switch on",
        "operation enabled",
        "fault",
    ]
    assert words(document, arrays, "NMT", "can0 node 1") == ["boot-up", "operational"]
    told = [(kind, text) for _, _, kind, _, text in document["incidents"]["list"]]
    kinds = document["incidents"]["kinds"]
    assert [kinds[kind] for kind, _ in told] == ["boot-up", "drive fault", "emergency"]
    assert "statusword 0608h" in told[1][1]
    assert "2310h" in told[2][1]
    assert [one[1] for one in document["incidents"]["list"]] == [0, 2, 2]


def test_load_without_bit_rate_is_not_guessed(drive, report_of, tmp_path, capsys):
    _, document, _ = report_of(drive)
    (traffic,) = document["traffic"]
    assert traffic["capacity_s"] is None
    assert "bit rate is not in the recording" in traffic["why"]
    page = tmp_path / "page.html"
    assert main(["report", str(drive), "-o", str(page), "--bitrate", "can0=250k"]) == 0
    assert '"capacity_s":250000.0' in page.read_text()
    assert main(["report", str(drive), "-o", str(page), "--bitrate", "can7=1M"]) == 0
    assert "no CAN bus can7" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["can0", "can0=", "=5", "can0=fast", "can0=0", "can0=-1", "a=1G"])
def test_invalid_bitrate_option_is_refused(drive, capsys, text):
    assert main(["report", str(drive), "--bitrate", text]) == 2
    assert "BUS=RATE" in capsys.readouterr().err


def test_pdos_without_mapping_are_counted(tmp_path, report_of):
    path = plain(tmp_path / "a.mcap", [(n * MS, frame(0x181, "3706000000FF")) for n in range(9)])
    _, document, _ = report_of(path)
    assert document["motors"] == []
    assert any("9 possible PDOs" in note for note in document["notes"])


def test_late_mapping_applies_from_then_on(tmp_path, report_of):
    told = [(0, frame(0x181, "3706"))]
    told += [(1, frame(0x601, "23001A0110004160")), (2, frame(0x581, "60001A0100000000"))]
    told += [(3, frame(0x601, "2F001A0001000000")), (4, frame(0x581, "60001A0000000000"))]
    path = plain(tmp_path / "a.mcap", [*told, (5, frame(0x181, "3106"))])
    _, document, arrays = report_of(path)
    assert words(document, arrays, "PDS FSA", "can0 node 1") == ["ready to switch on"]
    assert any("of 1 possible PDOs" in note for note in document["notes"])


def test_device_of_another_profile_is_not_a_drive(tmp_path, report_of):
    told = [(0, frame(0x601, "4000100000000000")), (1, frame(0x581, "4300100091010000"))]
    told += [(2, frame(0x601, "23001A0110004160")), (3, frame(0x581, "60001A0100000000"))]
    told += [(4, frame(0x601, "2F001A0001000000")), (5, frame(0x581, "60001A0000000000"))]
    path = plain(tmp_path / "a.mcap", [*told, (6, frame(0x181, "3706"))])
    _, document, _ = report_of(path)
    assert document["motors"] == []


def test_emergencies_need_a_certain_canopen_bus(tmp_path, report_of):
    noise = [(n * MS, frame(0x0CA, "1023010000000000")) for n in range(5)]
    _, document, _ = report_of(plain(tmp_path / "a.mcap", noise))
    assert document["incidents"]["list"] == []
    assert any("5 frames have identifiers of emergencies" in note for note in document["notes"])
    later = [*noise, (9 * MS, frame(0x701, "05"))]
    _, document, _ = report_of(plain(tmp_path / "b.mcap", later))
    assert dict(
        zip(document["incidents"]["kinds"], document["incidents"]["counts"], strict=True)
    ) == {"emergency": 5}


def test_wall_times_keep_their_nanoseconds(tmp_path, report_of):
    told = [(WALL_NS + n * 1_000_003, frame(0x100 + n)) for n in range(1000)]
    _, document, arrays = report_of(plain(tmp_path / "a.mcap", told))
    assert document["time"]["kind"] == "wall"
    assert document["time"]["begin_ns"] == str(WALL_NS)
    assert document["time"]["tick_s"] == 1e-9
    assert arrays.times(document["traffic"][0]["t"]) == [n * 1_000_003 for n in range(1000)]


def test_frames_without_times_are_drawn_in_order(tmp_path, report_of):
    told = [(WALL_NS, frame(0x100)) for _ in range(50)]
    _, document, arrays = report_of(plain(tmp_path / "a.mcap", told))
    assert document["time"]["kind"] == "order"
    assert arrays.times(document["traffic"][0]["t"]) == list(range(1, 51))
    assert any("all messages have the same time" in note for note in document["notes"])


def test_backward_stamps_are_noted_and_drawn_by_stamp(tmp_path, report_of):
    told = [(at * MS, frame(0x181)) for at in (5, 1, 6, 2, 7)]
    _, document, arrays = report_of(plain(tmp_path / "a.mcap", told))
    times = arrays.times(document["traffic"][0]["t"])
    assert times == sorted(times)
    assert len(times) == 5
    assert any("2 messages have earlier stamps" in note for note in document["notes"])


def test_can_fd_frames_count_with_both_rates(tmp_path, report_of):
    told = flexible(0x123, BRS, bytes([0x55]) * 64)
    path = tmp_path / "fd.mcap"
    rig = "[bus.can0]\nbitrate_bit_s = 500_000\n"
    weights = {}
    for rate in ("", "data_bitrate_bit_s = 2_000_000\n"):
        with TraceWriter(path) as writer:
            writer.attach("rig.toml", (rig + rate).encode(), "application/toml")
            channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
            writer.write(channel, MS, encode_can_frame(told))
            writer.write(channel, 2 * MS, encode_can_frame(told))
        _, document, arrays = report_of(path)
        weights[rate] = arrays.whole(document["traffic"][0]["weight"])[0]
        assert any("data bit rate of 2 CAN FD" in note for note in document["notes"]) is (not rate)
    # Only fixed stuff bits: 17 + 13 nominal, 5 + 512 + 32 at the data rate.
    assert weights[""] in range(579, 579 + 10)
    assert weights["data_bitrate_bit_s = 2_000_000\n"] in range(30 + 549 // 4, 30 + 549 // 4 + 10)


def test_error_frames_are_incidents_but_not_traffic(tmp_path, report_of):
    path = plain(tmp_path / "a.mcap", [(0, frame(0x100)), (MS, ERROR_FRAME)])
    _, document, _ = report_of(path)
    assert document["traffic"][0]["frames"] == 1
    ((_, severity, _, place, text),) = document["incidents"]["list"]
    assert (severity, place) == (2, "can0")
    assert "bus-off" in text
    incidents = document["incidents"]
    assert (incidents["kinds"], incidents["counts"]) == (["state of a CAN controller"], [1])


def test_empty_recording_page_states_it(tmp_path, capsys):
    path = tmp_path / "a.mcap"
    TraceWriter(path).close()
    assert main(["report", str(path)]) == 0
    assert "the recording holds no messages" in (tmp_path / "a.html").read_text()
    assert "0 messages" in capsys.readouterr().out


def test_truncated_recording_is_drawn_as_far_as_readable(demo, tmp_path, report_of):
    content = demo.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: len(content) * 2 // 3])
    found, document, _ = report_of(path)
    assert 5_000 < sum(found.messages.values()) < 28_000
    assert any(note.startswith("the file is cut at byte") for note in document["notes"])


def test_serial_line_load_and_exceptions_are_shown(tmp_path, report_of):
    """The line has 115,200 bit/s and a parity bit: 11 bits a byte.

    The CRCs are those computed by pymodbus: 8 and 5 bytes in all.
    """
    one = Recorded(tmp_path / "a.mcap")
    for at, data, received in (
        (10 * MS, "01030001000295CB", False),  # read two registers of unit 1 ...
        (20 * MS, "018302C0F1", True),  # ... refused: illegal data address
    ):
        content = bytes.fromhex(data)
        start = at - round(len(content) * 11 / 115_200 * S)
        values = {"direction": 1 if received else 2, "data": content}
        values |= {"start_ns": start, "end_ns": at}
        one.message(at + MS, "/modbus/rs485", MODBUS_ADU, values)
    _, document, arrays = report_of(one.close())
    (traffic,) = document["traffic"]
    assert (traffic["kind"], traffic["unit"], traffic["capacity_s"]) == ("Modbus RTU", "ns", 1e9)
    assert arrays.whole(traffic["weight"]) == [round(n * 11 / 115_200 * S) for n in (8, 5)]
    assert traffic["labels"] == ["unit 1 03h request", "unit 1 03h response"]
    ((_, severity, _, place, text),) = document["incidents"]["list"]
    assert (severity, place) == (1, "rs485")
    assert "exception 2, illegal data address" in text


def test_lock_timeline_shows_waiting_and_death(tmp_path, report_of):
    one = Recorded(tmp_path / "a.mcap")
    topic = "/motor/left_wheel/lock"
    first = {"owner": "start()", "pid": 11, "program": "arm.py", "token": 1}
    second = {"owner": "start()", "pid": 12, "program": "leg.py", "token": 2, "purpose": "a walk"}
    one.message(0, topic, MOTOR_LOCK, {"action": 1, **first})
    one.message(2 * S, topic, MOTOR_LOCK, {"action": 3, "holder": "arm.py", **second})
    one.message(5 * S, topic, MOTOR_LOCK, {"action": 5, **second})
    one.message(7 * S, topic, MOTOR_LOCK, {"action": 2, "held_s": 2.0, **second})
    _, document, arrays = report_of(one.close())
    timeline = document["timelines"][1]
    (row,) = timeline["rows"]
    tick_s = document["time"]["tick_s"]
    bars = [
        (timeline["words"][word], bool(waits), round(begin * tick_s, 6), round(end * tick_s, 6))
        for word, waits, begin, end in zip(
            *(arrays.whole(row[key]) for key in ("word", "waits", "from", "to")), strict=True
        )
    ]
    assert bars == [
        ("arm.py [11]", False, 0.0, 5.0),
        ("leg.py [12]", True, 2.0, 5.0),
        ("leg.py [12]", False, 5.0, 7.0),
    ]
    texts = [row["texts"][number] for number in arrays.whole(row["text"])]
    assert "died as the owner" in texts[0]
    assert "leg.py [12] has left_wheel for a walk" in texts[2]
    ((_, severity, kind, place, _),) = document["incidents"]["list"]
    assert (severity, document["incidents"]["kinds"][kind], place) == (
        1,
        "lock of a dead owner",
        "left_wheel",
    )


def test_unannounced_wait_is_drawn_from_waited_s(tmp_path, report_of):
    one = Recorded(tmp_path / "a.mcap").event(0, "begins")
    taken = {"action": 1, "owner": "start()", "token": 1, "waited_s": 2.5}
    one.message(4 * S, "/motor/left_wheel/lock", MOTOR_LOCK, taken).event(6 * S, "ends")
    _, document, arrays = report_of(one.close())
    (row,) = document["timelines"][1]["rows"]
    tick_s = document["time"]["tick_s"]
    begins = [round(tick * tick_s, 6) for tick in arrays.whole(row["from"])]
    ends = [round(tick * tick_s, 6) for tick in arrays.whole(row["to"])]
    assert list(zip(arrays.whole(row["waits"]), begins, ends, strict=True)) == [
        (1, 1.5, 4.0),
        (0, 4.0, 6.0),
    ]


def test_non_finite_numbers_do_not_break_the_page(tmp_path, report_of):
    one = Recorded(tmp_path / "a.mcap")
    one.position(0, "left_wheel", float("nan")).position(S, "left_wheel", float("inf"))
    sync = {"phase": 1, "motor": ["left_wheel"], "offset_s": [float("nan")], "skew_s": float("nan")}
    one.message(2 * S, "/group/drive/sync", GROUP_SYNC, sync)
    path = one.close()
    page = tmp_path / "page.html"
    assert main(["report", path, "-o", str(page)]) == 0
    assert "NaN" not in page.read_text().partition('id="document">')[2].partition("<")[0]


@pytest.mark.parametrize(
    "name",
    [
        "rdm_inverter_bench_PV1.4.asc",
        "canopen_machine_pcan1.trc",
        "moteus_dynamometer_canfd_candump.txt",
        "roboteq_mbl1660_node12_candump.txt",
        "canopenlens_sample_amr_2wheel.log",
        "modbus_quickdraw_part1.pcap",
    ],
)
@pytest.mark.data
def test_real_traffic_gives_a_page(shared, tmp_path, report_of, name):
    source, path = shared / "data" / "traffic" / name, tmp_path / "a.mcap"
    assert main(["convert", str(source), "-o", str(path)]) == 0
    found, document, _ = report_of(path)
    assert sum(found.messages.values()) == sum(t["frames"] for t in document["traffic"])
    assert main(["report", str(path)]) == 0


# -------------------------------------------------------------------------------- reduction


SERIES = st.lists(
    st.tuples(st.integers(0, 10_000), st.floats(-1e6, 1e6, allow_nan=False)),
    min_size=30,
    max_size=200,
)


@given(SERIES, st.integers(4, 40))
def test_extremes_keep_first_last_lowest_and_highest(series, points):
    series.sort(key=lambda one: one[0])
    times = np.array([at for at, _ in series], dtype=np.int64)
    values = np.array([value for _, value in series])
    kept_times, kept_values = extremes(times, values, points)
    kept = list(zip(kept_times.tolist(), kept_values.tolist(), strict=True))
    assert len(kept) <= max(points, 4)
    if len(series) <= points:
        assert kept == series
        return
    width = max(1, -(-(series[-1][0] - series[0][0] + 1) // max(1, points // 4)))
    stretches = {}
    for at, value in series:
        stretches.setdefault((at - series[0][0]) // width, []).append((at, value))
    for own in stretches.values():
        inside = [one for one in kept if own[0][0] <= one[0] <= own[-1][0]]
        assert min(v for _, v in own) == min(v for _, v in inside)
        assert max(v for _, v in own) == max(v for _, v in inside)
        assert own[0] in inside
        assert own[-1] in inside


@given(
    st.lists(
        st.tuples(st.integers(0, 10**6), st.integers(0, 5), st.integers(1, 200)), max_size=200
    ),
    st.integers(1, 10**6),
)
def test_cells_keep_the_sums(told, width_ns):
    told.sort()
    columns = [np.array([one[n] for one in told], dtype=np.int64) for n in range(3)]
    columns.append(np.ones(len(told), dtype=np.int64))
    ends, keys, weights, counts = (one.tolist() for one in cells(*columns, width_ns))
    assert ends == sorted(ends)
    assert sum(counts) == len(told)
    for key in range(6):
        assert sum(w for k, w in zip(keys, weights, strict=True) if k == key) == sum(
            w for _, k, w in told if k == key
        )
    assert len(set(zip(ends, keys, strict=True))) == len(ends)


def test_reduction_beyond_the_budget_is_noted(demo, report_of):
    _, document, arrays = report_of(demo, points_max=2_000, frames_max=3_000)
    notes = " ".join(document["notes"])
    assert "points of quantities are reduced to about 2,000" in notes
    assert "drawn as sums over short stretches" in notes
    for traffic in document["traffic"]:
        assert traffic["cell_s"] > 0
        assert len(arrays.whole(traffic["t"])) < 3_000
        assert sum(arrays.whole(traffic["count"])) == traffic["frames"]
    _, whole, _ = report_of(demo)
    assert [m["summary"] for m in document["motors"]] == [m["summary"] for m in whole["motors"]]


@given(SERIES, st.integers(0, 8), st.booleans())
def test_remarkable_points_keep_all_extremes(series, power, twice):
    """A second reduction, to stretches of double duration, loses none of them either."""
    series.sort(key=lambda one: one[0])
    track = track_of(series)
    for width in (1 << power, 2 << power) if twice else (2 << power,):
        reduce_rows([track], (), width)
    kept = list(zip(track.times_ns, track.values, strict=True))
    assert len(kept) + track.omitted == len(series)
    stretches = {}
    for at, value in series:
        stretches.setdefault(at >> (power + 1), []).append((at, value))
    for own in stretches.values():
        inside = [one for one in kept if own[0][0] <= one[0] <= own[-1][0]]
        assert len(inside) <= 8
        assert min(v for _, v in own) == min(v for _, v in inside)
        assert max(v for _, v in own) == max(v for _, v in inside)
        assert own[0] in inside
        assert own[-1] in inside


def track_of(series, held=False):
    track = Track(held)
    for at, value in series:
        track.add(at, value)
    return track


@given(SERIES, SERIES, st.integers(4, 14))
def test_reduced_pair_invents_no_difference(one, other, power):
    """Demand and actual position in different PDOs: the following error is their difference."""
    pair = []
    for series in (one, other):
        series.sort(key=lambda point: point[0])
        pair.append(track_of(series, held=True))
    whole = dict(zip(*(each.tolist() for each in difference(*pair)), strict=True))
    reduce_held(pair, 1 << power)
    times, values = difference(*pair)
    assert set(zip(times.tolist(), values.tolist(), strict=True)) <= set(whole.items())
    assert max(values) == max(whole.values())
    assert min(values) == min(whole.values())


def test_largest_slope_remains_with_both_its_points():
    times = np.arange(100, dtype=np.int64)
    values = np.arange(100.0)
    values[41:] += 5.0
    rates = np.append(np.diff(values), 0.0)
    kept = remarkable(times, [values], [rates], 1_000).tolist()
    assert kept == [0, 40, 41, 99]


def test_long_recording_is_kept_in_bounds(demo):
    """The limits apply while the recording is read: here they are those of a short one."""
    with read_trace(demo) as trace:
        whole, found = collect(trace), collect(trace)
        for _ in range(2):  # the second time nothing exceeds them
            found.bound(kept_max=8_000, frames_max=4_000)
        wholes, _ = document_of(trace, whole, "a title")
        document, _ = document_of(trace, found, "a title")
    tracks = [track for truth in found.truths.values() for track in truth.values()]
    assert 0 < sum(len(track) for track in tracks) <= 4_000
    assert sum(len(one.times_ns) for one in found.traffics()) <= 2_000
    for one, other in zip(found.traffics(), whole.traffics(), strict=True):
        assert sum(one.weights) == sum(other.weights)
        assert one.frames == other.frames == sum(one.counts)
    for one, other in zip(document["motors"], wholes["motors"], strict=True):
        for quantity in ("position", "velocity"):
            assert one["summary"][quantity]["value"] == other["summary"][quantity]["value"]
        assert [line["points"] for plot in one["plots"] for line in plot["lines"]] == [
            line["points"] for plot in other["plots"] for line in plot["lines"]
        ]
    notes = " ".join(document["notes"])
    assert "points of quantities are reduced to about" in notes
    assert f"{sum(one.frames for one in found.traffics()):,} frames are drawn as sums" in notes


def test_frequent_incidents_cover_the_whole_recording(tmp_path, report_of):
    """The row of Modbus exceptions ended at the 2,000th."""
    one = Recorded(tmp_path / "a.mcap")
    for n in range(5_000):
        for data, received in (("01030001000295CB", False), ("018302C0F1", True)):
            values = {"direction": 1 if received else 2, "data": bytes.fromhex(data)}
            one.message((2 * n + received) * MS, "/modbus/rs485", MODBUS_ADU, values)
    found, document, _ = report_of(one.close())
    assert document["incidents"]["counts"] == [5_000]
    times = [incident.time_ns for incident in found.incidents.kept()]
    assert 1_000 <= len(times) <= 2_000
    assert len({after - before for before, after in pairwise(times)}) == 1
    assert times[0] == 1 * MS
    assert times[-1] >= 9_980 * MS
    (note,) = [note for note in document["notes"] if "incidents" in note]
    assert note == "of 5000 incidents of kind “Modbus exception” one in 4 is shown"


# ------------------------------------------------------------- nodes that are no longer heard


def operational(count=10):
    """Return a drive's heartbeats every 100 ms, and its statusword "operation enabled"."""
    told = []
    for n, data in enumerate(("2F001A0000", "23001A0110004160", "2F001A0001")):
        told.append((2 * n * MS, frame(0x601, data.ljust(16, "0"))))
        told.append(((2 * n + 1) * MS, frame(0x581, "60" + data[2:8] + "00000000")))
    told += [(10 * MS + n * 100 * MS, frame(0x701, "05")) for n in range(count)]
    told += [(11 * MS + n * 100 * MS, frame(0x181, "3702")) for n in range(count)]
    return sorted(told, key=lambda one: one[0])


SYNC_ONLY = [(n * 100 * MS, frame(0x080)) for n in range(1, 51)]


def states_of(tmp_path, report_of, frames):
    path = plain(tmp_path / "a.mcap", sorted(frames, key=lambda one: one[0]))
    _, document, arrays = report_of(path)
    name = "can0 node 1"
    told = []
    for title in ("NMT", "PDS FSA"):
        row = rows(document, title)[name]
        begins = [round(tick * document["time"]["tick_s"], 3) for tick in arrays.whole(row["from"])]
        told.append(list(zip(begins, words(document, arrays, title, name), strict=True)))
    return told


def test_node_without_heartbeat_is_not_operational(tmp_path, report_of):
    nmt, pds = states_of(tmp_path, report_of, operational() + SYNC_ONLY)
    assert nmt == [(0.010, "operational"), (1.010, "no heartbeat")]
    assert pds == [(0.011, "operation enabled"), (1.010, "no state")]


def test_node_that_is_heard_again_is_operational(tmp_path, report_of):
    later = [(at + 3 * S, data) for at, data in operational()]
    nmt, pds = states_of(tmp_path, report_of, operational() + SYNC_ONLY + later)
    assert [word for _, word in nmt] == [
        *("operational", "no heartbeat", "operational", "no heartbeat"),
    ]
    assert [word for _, word in pds][:3] == ["operation enabled", "no state", "operation enabled"]


def test_two_missing_heartbeats_are_not_drawn(tmp_path, report_of):
    told = [one for one in operational() if not 500 * MS < one[0] < 700 * MS]
    nmt, pds = states_of(tmp_path, report_of, told)
    assert [word for _, word in nmt] == ["operational"]
    assert [word for _, word in pds] == ["operation enabled"]


def test_statuswords_without_heartbeat_keep_the_state(tmp_path, report_of):
    words_only = [(at, frame(0x181, "3702")) for at, _ in SYNC_ONLY]
    nmt, pds = states_of(tmp_path, report_of, operational() + words_only)
    assert nmt[-1] == (1.010, "no heartbeat")
    assert pds == [(0.011, "operation enabled")]


@pytest.mark.parametrize("node", ["01", "00"])
def test_reset_node_is_not_operational(tmp_path, report_of, node):
    """A drive without heartbeat: the command alone tells that it is not operational."""
    told = [*operational(1), (500 * MS, frame(0x000, "81" + node)), (900 * MS, frame(0x080))]
    nmt, pds = states_of(tmp_path, report_of, told)
    assert nmt == [(0.010, "operational"), (0.500, "reset")]
    assert pds == [(0.011, "operation enabled"), (0.500, "no state")]


def test_booted_drive_has_no_state_until_it_says(tmp_path, report_of):
    told = [*operational(3), (500 * MS, frame(0x701, "00")), (700 * MS, frame(0x701, "7F"))]
    nmt, pds = states_of(tmp_path, report_of, told)
    assert nmt == [(0.010, "operational"), (0.500, "boot-up"), (0.700, "pre-operational")]
    assert pds == [(0.011, "operation enabled"), (0.500, "no state")]
