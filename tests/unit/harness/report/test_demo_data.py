"""Demo data on the page against independent readings of the same file.

The other readings use mcap's reader with protobuf's decoder, and frames built bit by bit.
"""

import struct
from collections import Counter, defaultdict

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from tests.support.can.frame_bits import INTERMISSION, Fields, on_the_wire

MOTORS = [
    *("drive_fl", "drive_fr", "drive_ml", "drive_mr", "drive_rl", "drive_rr"),
    *("steer_fl", "steer_fr", "steer_ml", "steer_mr", "steer_rl", "steer_rr", "pan", "tilt"),
]
NODES = {name: ("can0" if name[:5] != "steer" else "can1") for name in MOTORS}
# CiA 402-2, statusword: mask, value, state.
STATES = (
    (0x4F, 0x40, "switch on disabled"),
    (0x6F, 0x21, "ready to switch on"),
    (0x6F, 0x23, "switched on"),
    (0x6F, 0x27, "operation enabled"),
)


@pytest.fixture(scope="module")
def others(demo):
    """Return (log time, message) by topic from another reader and decoder."""
    found = defaultdict(list)
    with demo.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found[channel.topic].append((message.log_time, decoded))
    return found


@pytest.fixture(scope="module")
def made(demo, report_of):
    return report_of(demo)


def test_motors_are_listed_in_the_rigs_order(made):
    _, document, _ = made
    assert [motor["name"] for motor in document["motors"]] == MOTORS
    assert document["notes"] == []
    assert document["time"]["kind"] == "rig"


def test_frames_and_bits_equal_another_reading(made, others):
    _, document, arrays = made
    assert [traffic["name"] for traffic in document["traffic"]] == ["can0", "can1"]
    for traffic in document["traffic"]:
        counts, bits = Counter(), Counter()
        for _, frame in others[f"/can/{traffic['name']}"]:
            fields = Fields(frame.id, frame.extended, frame.remote, len(frame.data), frame.data)
            counts[f"{frame.id:03X}h"] += 1
            bits[f"{frame.id:03X}h"] += len(on_the_wire(fields)) + INTERMISSION
        drawn, weights = Counter(), Counter()
        keys, amounts = arrays.whole(traffic["key"]), arrays.whole(traffic["weight"])
        for key, amount in zip(keys, amounts, strict=True):
            drawn[traffic["labels"][key]] += 1
            weights[traffic["labels"][key]] += amount
        assert drawn == counts
        assert weights == bits
        assert traffic["labels"] == sorted(traffic["labels"])
        assert traffic["capacity_s"] == 1_000_000


def test_frame_times_equal_log_times(made, others):
    _, document, arrays = made
    tick_ns = round(document["time"]["tick_s"] * 1e9)
    begin_ns = int(document["time"]["begin_ns"])
    for traffic in document["traffic"]:
        logged = [at - begin_ns for at, _ in others[f"/can/{traffic['name']}"]]
        drawn = arrays.times(traffic["t"])
        assert len(drawn) == len(logged)
        assert all(
            0 <= at - tick * tick_ns < tick_ns for at, tick in zip(logged, drawn, strict=True)
        )


def line_of(document, motor, quantity, role):
    found = next(one for one in document["motors"] if one["name"] == motor)
    for plot in found["plots"]:
        for line in plot["lines"]:
            if (plot["quantity"], line["role"]) == (quantity, role):
                return plot["unit"], line
    raise AssertionError(f"{motor} has no {role} {quantity}")


@pytest.mark.parametrize("motor", MOTORS)
def test_positions_equal_application_and_plant(made, others, motor):
    _, document, arrays = made
    unit, line = line_of(document, motor, "position", "actual")
    told = [one for _, one in others[f"/motor/{motor}/state"]]
    state = [one.position for one in told if one.HasField("position")]  # else unknown
    assert unit == "rad"
    # A number is a float32 relative to the first one: 1e-7 of the travel, 30 rad at most.
    assert arrays.numbers(line["v"]) == pytest.approx(state, abs=3e-6)
    _, line = line_of(document, motor, "position", "truth")
    truth = [one.position_rad for _, one in others[f"/controller/{motor}/truth"]]
    assert arrays.numbers(line["v"]) == pytest.approx(truth, abs=3e-6)


@pytest.mark.parametrize("motor", MOTORS)
def test_following_error_is_demand_minus_actual_in_rad(made, others, motor):
    """Computed from the truth's demand and position with the increments of the motor models."""
    increments_per_rad = {"d": 66, "s": 100}.get(motor[0], 100) * 2000 / 6.283185307179586
    _, document, arrays = made
    unit, line = line_of(document, motor, "following error", "actual")
    told = [one for _, one in others[f"/controller/{motor}/truth"]]
    expected = [(one.demand_inc - one.position_inc) / increments_per_rad for one in told]
    assert unit == "rad"
    assert arrays.numbers(line["v"]) == pytest.approx(expected, abs=1e-9)
    summary = next(one for one in document["motors"] if one["name"] == motor)["summary"]
    assert summary["following error"]["value"] == pytest.approx(max(map(abs, expected)), abs=1e-9)
    assert 0 < max(map(abs, expected)) < 0.01  # it moved and followed


@pytest.mark.parametrize("motor", MOTORS)
def test_demand_follows_the_plant(made, motor):
    _, document, arrays = made
    _, demand = line_of(document, motor, "position", "demand")
    _, true = line_of(document, motor, "position", "truth")
    pairs = zip(arrays.numbers(demand["v"]), arrays.numbers(true["v"]), strict=True)
    # The largest following error of the demo is 19 increments, 0.6 mrad; the backlash is smaller.
    assert max(abs(one - other) for one, other in pairs) < 0.001


def test_states_equal_the_statuswords_on_the_bus(made, others):
    """TPDO 1 starts with 6041h, as in the rig's EDS."""
    _, document, arrays = made
    timeline = document["timelines"][0]
    assert [row["name"] for row in timeline["rows"]] == MOTORS
    numbers = {"can0": [1, 2, 3, 4, 5, 6, 11, 12], "can1": [1, 2, 3, 4, 5, 6]}
    for row, name in zip(timeline["rows"], MOTORS, strict=True):
        bus = NODES[name]
        node = numbers[bus][[m for m in MOTORS if NODES[m] == bus].index(name)]
        expected = []
        for _, frame in others[f"/can/{bus}"]:
            if frame.id == 0x180 + node:
                (word,) = struct.unpack_from("<H", frame.data)
                state = next(text for mask, value, text in STATES if word & mask == value)
                if not expected or expected[-1] != state:
                    expected.append(state)
        drawn = [timeline["words"][word] for word in arrays.whole(row["word"])]
        assert drawn == expected
        assert "operation enabled" in drawn
        begins, ends = arrays.times(row["from"]), arrays.times(row["to"])
        assert begins[1:] == ends[:-1]
        assert ends[-1] == document["time"]["span"]


def test_groups_equal_their_recorded_messages(made, others):
    _, document, _ = made
    assert [group["name"] for group in document["groups"]] == ["wheels", "steering", "mast"]
    for group in document["groups"]:
        told = [one for _, one in others[f"/group/{group['name']}/sync"]]
        assert [m["start"] for m in group["moments"]] == [one.phase == 1 for one in told]
        assert [m["skew_s"] or 0.0 for m in group["moments"]] == [one.skew_s for one in told]
        predicted = [m["predicted_s"] or 0.0 for m in group["moments"]]
        assert predicted == [one.predicted_skew_s for one in told]
        assert max(predicted) > 0


def test_every_ownership_has_a_bar(made, others):
    _, document, arrays = made
    rows = {row["name"]: row for row in document["timelines"][1]["rows"]}
    assert list(rows) == MOTORS
    for motor in MOTORS:
        taken = [at for at, one in others[f"/motor/{motor}/lock"] if one.action == 1]
        waits = arrays.whole(rows[motor]["waits"])
        tick_ns = round(document["time"]["tick_s"] * 1e9)
        assert waits.count(0) == len(taken)
        assert arrays.times(rows[motor]["from"]) == [at // tick_ns for at in taken]


def test_incidents_equal_those_on_the_bus(made, others):
    _, document, _ = made
    told = dict(zip(document["incidents"]["kinds"], document["incidents"]["counts"], strict=True))
    frames = [one for bus in ("can0", "can1") for _, one in others[f"/can/{bus}"]]
    boots = sum(one.id >> 7 == 14 and one.data == b"\0" for one in frames)
    aborts = sum(one.id >> 7 in (11, 12) and one.data[0] == 0x80 for one in frames)
    assert told == {
        "boot-up": boots,
        "NMT command": sum(one.id == 0 for one in frames),
        "SDO abort": aborts,
    }
    assert boots == 14
