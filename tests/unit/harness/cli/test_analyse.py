"""The verb `analyse`: rigs and recordings, tables and JSON, exit status and errors."""

import json
import os
import random
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import jsonschema
import pytest

from motorhil import harness
from motorhil.emulators.can.frame import pack
from motorhil.harness.analysis.advice import more_errors_probability, propose
from motorhil.harness.analysis.subject import reserves_nothing
from motorhil.harness.cli.main import main
from motorhil.motorapi.synchronization.can_response_time import (
    NO_ERRORS,
    BusLoad,
    Effort,
    Message,
    response_times,
)
from motorhil.traces.can_frame import BRS, flexible
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema, encode_can_frame
from tests.support.golden import golden

SCHEMA = json.loads((Path(harness.__file__).parent / "analyse.schema.json").read_text())
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
MS = 1_000_000
EXAMPLES = Path(harness.__file__).parent / "examples"

# The counter-example of Davis, Burns, Bril & Lukkien 2007.
DAVIS = "[bus.can0]\nbitrate_bit_s = 125_000\n" + "".join(
    f"[[bus.can0.message]]\nidentifier = {number}\nlength = 7\nperiod_s = {period_s}\n"
    f"deadline_s = {deadline_s}\n"
    for number, period_s, deadline_s in (
        (1, 2.5e-3, 2.5e-3),
        (2, 3.5e-3, 3.25e-3),
        (3, 3.5e-3, 3.25e-3),
    )
)


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A rig with declared messages only."""
    path = tmp_path / "rig.toml"
    path.write_text(DAVIS)
    return path


def as_json(capsys, *words: str) -> tuple[int, dict]:
    status = main(["analyse", *words, "--json"])
    told = json.loads(capsys.readouterr().out)
    VALIDATOR.validate(told)
    return status, told


def recorded(path: Path, periods: dict[int, int], until_ns: int = 400 * MS) -> Path:
    """Write a recording of periodic 4-byte messages; periods [ns] by identifier."""
    frames = sorted(
        Frame(time_ns, "can0", pack(identifier, bytes(4)), Direction.UNKNOWN, "")
        for identifier, period_ns in periods.items()
        for time_ns in range(identifier, until_ns, period_ns)
    )
    record_frames(path, frames, {})
    return path


def test_late_message_is_reported_with_remedies(rig, capsys):
    assert main(["analyse", str(rig)]) == 1
    told = capsys.readouterr().out.splitlines()
    (row,) = [line.split() for line in told if line.startswith("003h")]
    assert row == ["003h", "declared", "7", "3.500", "0.000", "3.250", "3.500", "NO", "-"]
    assert "can0: may be late: 003h" in told
    assert "can0: no order of identifiers helps (proved level by level)" in told
    assert not any("errors" in one for one in told[2:])  # it may be late even without errors
    assert "can0: all are in time at 250000 bit/s" in told
    assert told[-1] == f"{rig}: 1 message may be late"


def test_json_conforms_to_schema(rig, capsys):
    status, told = as_json(capsys, str(rig), "--bit-error-rate", "1e-6")
    assert status == 1
    (bus,) = told["buses"]
    assert [one["response_s"] for one in bus["messages"]] == [0.002, 0.003, 0.0035]
    assert [one["in_time"] for one in bus["messages"]] == [True, True, False]
    assert [one["late_probability"] for one in bus["messages"]][2] == 1.0
    assert bus["remedy"]["is_impossible"] is True
    assert bus["remedy"]["bitrate_bit_s"] == 250_000
    assert bus["late"] == ["003h"]


def test_bitrate_option_replaces_bit_rate(rig, capsys):
    status, told = as_json(capsys, str(rig), "--bitrate", "can0=250k")
    assert (status, told["verdict"]) == (0, "all messages are in time")
    assert told["buses"][0]["remedy"] is None


def test_errors_can_make_messages_late(rig, capsys):
    rate = ("--bitrate", "can0=250k")
    status, told = as_json(capsys, str(rig), *rate, "--errors", "1", "--error-interval", "1")
    assert status == 0
    status, late = as_json(capsys, str(rig), *rate, "--errors", "9")
    assert status == 1
    assert late["buses"][0]["errors"] == {"burst": 9, "interval_s": None}
    fine_s = told["buses"][0]["shortest_error_interval_s"]
    assert as_json(capsys, str(rig), *rate, "--error-interval", str(fine_s))[0] == 0
    assert (
        as_json(capsys, str(rig), *rate, "--error-interval", f"{fine_s * 0.998 - 1e-6:f}")[0] == 1
    )


def test_messages_of_sender_share_fifo_queue_by_default(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(
        "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
        + "".join(
            f"[[bus.can0.message]]\nidentifier = {number}\nlength = 8\nperiod_s = 0.01\n{sender}"
            for number, sender in ((1, 'sender = "a"\n'), (2, ""), (3, 'sender = "a"\n'))
        )
    )
    one_queue = as_json(capsys, str(path))[1]["buses"][0]
    assert one_queue["fifo"] == ["a"]
    assert [one["response_s"] for one in one_queue["messages"]] == [405e-6, 405e-6, 405e-6]
    sorted_queue = as_json(capsys, str(path), "--queue", "priority")[1]["buses"][0]
    assert [one["response_s"] for one in sorted_queue["messages"]] == [270e-6, 405e-6, 405e-6]


def test_queue_order_is_read_from_rig(tmp_path, capsys):
    """Node left sends its most urgent frame first; the other has the default of emulated nodes."""
    path = tmp_path / "rig.toml"
    path.write_text(
        "[bus.can0]\nbitrate_bit_s = 1_000_000\n"
        '[bus.can0.node.left]\nqueue = "priority"\nsilent = true\n'
        + "".join(
            f"[[bus.can0.message]]\nidentifier = {number}\nlength = 8\nperiod_s = 0.01\n"
            f'sender = "{sender}"\n'
            for number, sender in ((1, "left"), (2, "other"), (3, "other"), (4, "left"))
        )
    )
    for words, fifo in (
        ((), ["other"]),
        (("--queue", "fifo"), ["left", "other"]),
        (("--queue", "priority"), []),
    ):
        assert as_json(capsys, str(path), *words)[1]["buses"][0]["fifo"] == fifo
    recording = tmp_path / "some.mcap"
    with TraceWriter(recording) as writer:
        writer.attach("rig.toml", path.read_bytes(), "application/toml")
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for n in range(12):
            for number, sender in enumerate(("left", "other")):
                frame = encode_can_frame(pack(1 + number), sender=sender)
                writer.write(channel, n * 5 * MS + number, frame)
    assert as_json(capsys, str(recording))[1]["buses"][0]["fifo"] == ["other"]


def test_can_fd_message_uses_both_bit_rates(tmp_path, capsys):
    """64 bytes: 33 bits at 500 kbit/s and 679 at 2 Mbit/s, 712 without a switch (can-physics)."""
    path = tmp_path / "rig.toml"
    fd = "length = 64\nperiod_s = 0.01\nfd = true\n"
    path.write_text(
        "[bus.can0]\nbitrate_bit_s = 500_000\ndata_bitrate_bit_s = 2_000_000\n"
        f"[[bus.can0.message]]\nidentifier = 1\nbit_rate_switch = true\n{fd}"
        f"[[bus.can0.message]]\nidentifier = 2\n{fd}"
    )
    first, second = as_json(capsys, str(path))[1]["buses"][0]["messages"]
    assert first["takes_s"] == pytest.approx(33 / 5e5 + 679 / 2e6, abs=1e-12)
    assert second["takes_s"] == pytest.approx(712 / 5e5, abs=1e-12)
    assert second["response_s"] == pytest.approx(first["takes_s"] + second["takes_s"], abs=1e-12)
    assert [one["bit_rate_switch"] for one in (first, second)] == [True, False]


def test_traffic_of_motors_is_included(capsys):
    status, told = as_json(capsys, str(EXAMPLES / "two_wheels.toml"))
    assert status == 0
    messages = {one["label"]: one for one in told["buses"][0]["messages"]}
    assert list(messages) == ["181h", "182h", "701h", "702h", "77Fh"]
    assert messages["181h"]["sender"] == "left"
    assert messages["77Fh"]["sender"] == "host"
    assert messages["181h"]["arrival"] == "sporadic"
    assert messages["181h"]["deadline_s"] == 0.02  # the drive then repeats it
    notes = " ".join(told["buses"][0]["notes"])
    assert "not declared" in notes
    assert "SDO" in notes
    status, streamed = as_json(capsys, str(EXAMPLES / "two_wheels.toml"), "--streamed")
    sent = {one["label"]: one["period_s"] for one in streamed["buses"][0]["messages"]}
    assert (sent["080h"], sent["301h"], sent["302h"]) == (0.005, 0.005, 0.005)


def test_recording_gives_periods_and_jitter(tmp_path, capsys):
    path = recorded(tmp_path / "some.mcap", {0x101: 5 * MS, 0x102: 20 * MS})
    status, told = as_json(capsys, str(path), "--bitrate", "can0=500k")
    assert status == 0
    first, second = told["buses"][0]["messages"]
    assert (first["period_s"], first["jitter_s"], first["frames"]) == (0.005, 0.0, 80)
    assert first["response_s"] == 2 * 95 / 500_000
    assert second["response_s"] == 2 * 95 / 500_000
    assert main(["analyse", str(path), "--bitrate", "can0=500k", "--deadline", "102=0.0003"]) == 1
    assert "NO" in capsys.readouterr().out


def test_plot_has_a_bar_for_each_message(rig, capsys, tmp_path):
    target = tmp_path / "times.svg"
    assert main(["analyse", str(rig), "--plot", str(target)]) == 1
    root = ElementTree.fromstring(target.read_text())
    titles = [one.text for one in root.iter("{http://www.w3.org/2000/svg}title")]
    assert titles == ["001h declared: 2 ms", "002h declared: 3 ms", "003h declared: 3.5 ms"]
    capsys.readouterr()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--bus", "can9"], "there is no CAN bus can9; its buses: can0"),
        (["--bitrate", "can9=500k"], "there is no CAN bus can9"),
        (["--bitrate", "500k"], "'500k' is not BUS=RATE"),
        (["--data-bitrate", "can0=1k"], "--data-bitrate can0=1000 is below 125000 bit/s"),
        (["--deadline", "7FF=1"], "message 7FFh: not in the analysis"),
        (["--deadline", "1"], "'1' is not ID=S, as 181=0.005"),
        (["--deadline", "1=0"], "'0' is not a number from 1e-06 to 1e+06 s"),
        (["--errors", "-1"], "'-1' is not a whole number from 0 to 4096"),
        (["--error-interval", "0"], "'0' is not a number from 1e-06 to 1e+06 s"),
        (["--bit-error-rate", "2"], "'2' is not a number from 0 to 0.5"),
    ],
)
def test_wrong_usage_is_reported(rig, capsys, words, told):
    assert main(["analyse", str(rig), *words]) == 2
    assert told in capsys.readouterr().err


def test_wrong_rig_is_reported_with_line(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(DAVIS.replace("deadline_s = 0.0025", "deadline_s = -1"))
    assert main(["analyse", str(path)]) == 2
    told = capsys.readouterr().err
    assert "rig.toml:7: bus.can0.message[0].deadline_s: -1 s is out of range" in told


def test_recording_without_bit_rate_is_refused(tmp_path, capsys):
    path = recorded(tmp_path / "some.mcap", {0x101: 5 * MS})
    assert main(["analyse", str(path)]) == 2
    assert (
        "does not contain the bit rate of can0; say --bitrate can0=500k" in capsys.readouterr().err
    )
    assert main(["analyse", str(path), "--bitrate", "can0=500k", "--streamed"]) == 2
    assert "--sync and --streamed are for rigs" in capsys.readouterr().err
    assert main(["analyse", str(path), "--bitrate", "nosuch=500k"]) == 2
    assert "has no CAN bus nosuch; its buses: can0" in capsys.readouterr().err


def test_can_fd_recording_is_measured_at_both_bit_rates(tmp_path, capsys):
    path = tmp_path / "fd.log"
    rows = [f"({n * 0.005:.6f}) can0 123##1{'55' * 64}\n" for n in range(40)]
    path.write_text("".join([*rows, f"(0.200000) can0 124##1{'55' * 9}\n"]))
    rates = ("--bitrate", "can0=500k", "--data-bitrate", "can0=2M")
    (bus,) = as_json(capsys, str(path), *rates)[1]["buses"]
    (message,) = [one for one in bus["messages"] if one["label"] == "123h"]
    assert (message["length"], message["fd"], message["bit_rate_switch"]) == (64, True, True)
    # 712 bits at most (can-physics, 6.3), 33 of them before and after the data phase
    assert message["takes_s"] == pytest.approx(33 / 500_000 + 679 / 2_000_000, abs=1e-12)


def test_data_bit_rate_comes_from_rig_or_recorded_rig(tmp_path, capsys):
    rig = "[bus.can0]\nbitrate_bit_s = 500_000\ndata_bitrate_bit_s = 2_000_000\n"
    path = tmp_path / "rig.toml"
    path.write_text(rig + "[[bus.can0.message]]\nidentifier = 1\nlength = 8\nperiod_s = 0.01\n")
    (bus,) = as_json(capsys, str(path))[1]["buses"]
    assert bus["data_bitrate_bit_s"] == 2_000_000
    recording = tmp_path / "fd.mcap"
    with TraceWriter(recording) as writer:
        writer.attach("rig.toml", rig.encode(), "application/toml")
        channel = writer.channel("/can/can0", Schema.of(CAN_FRAME))
        for n in range(12):
            frame = flexible(0x123, BRS, bytes([0x55]) * 64)
            writer.write(channel, n * 5 * MS, encode_can_frame(frame))
    (bus,) = as_json(capsys, str(recording))[1]["buses"]
    assert bus["data_bitrate_bit_s"] == 2_000_000
    assert bus["messages"][0]["takes_s"] == pytest.approx(33 / 5e5 + 679 / 2e6, abs=1e-12)


def test_frames_without_time_are_refused(tmp_path, capsys):
    path = tmp_path / "plain.txt"
    path.write_text("  can0  181   [2]  37 06\n  can0  181   [2]  37 06\n")
    assert main(["analyse", str(path), "--bitrate", "can0=500k"]) == 2
    assert "has 2 frames without a time" in capsys.readouterr().err


def test_recording_without_periods_is_not_judged(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text("[bus.can0]\nbitrate_bit_s = 125_000\nmessage = []\n")
    assert main(["analyse", str(path)]) == 3
    once = recorded(tmp_path / "once.mcap", {0x101: 500 * MS})
    assert main(["analyse", str(once), "--bitrate", "can0=500k"]) == 3
    capsys.readouterr()


def test_demo_rig_and_its_recording_agree(demo, capsys):
    """Only commands are new in the recording; no message is more frequent than in the rig."""
    status, rig = as_json(capsys, str(EXAMPLES / "rover.toml"))
    again, record = as_json(capsys, str(demo))
    assert (status, again) == (0, 0)
    for told, seen in zip(rig["buses"], record["buses"], strict=True):
        assert told["utilisation"] > seen["utilisation"]
        known = {one["label"]: one for one in told["messages"]}
        heard = {one["label"]: one for one in seen["messages"]}
        assert set(known) <= set(heard)
        commands = sorted(set(heard) - set(known))
        assert all(heard[one]["sender"] == "host" for one in commands)
        assert all(heard[one]["arrival"] == "sporadic" for one in commands)
        for label, one in known.items():
            other = heard[label]
            assert (other["length"], other["sender"]) == (one["length"], one["sender"])
            assert other["arrival"] == "periodic"
            assert other["period_s"] >= one["period_s"] * 0.999
            if one["arrival"] == "sporadic":  # stamped at the frames' ends, after waiting
                assert other["distance_s"] >= one["period_s"] - one["response_s"]


def test_recorded_sync_gives_clock_deviation_and_drift(tmp_path, capsys):
    """SYNC is 40 ppm fast on can0 (1006h: 10 ms), and 30 ppm slow on can1 (without 1006h)."""
    path = tmp_path / "two.log"
    rows = [(5 * MS, "can0 601#2306100010270000")]
    for n in range(200):
        rows += [(n * 9_999_600, "can0 080#"), (n * 10_000_300, "can1 080#")]
        rows += [(n * 100 * MS, f"can{bus} 701#05") for bus in (0, 1) if n < 20]
    path.write_text("".join(f"({at / 1e9:.9f}) {row}\n" for at, row in sorted(rows)))
    rates = ("--bitrate", "can0=1M", "--bitrate", "can1=1M")
    _, told = as_json(capsys, str(path), *rates)
    clocks = [bus["sync"] for bus in told["buses"]]
    assert [one["nominal_is_told"] for one in clocks] == [True, False]
    assert [one["error_ppm"] for one in clocks] == pytest.approx([40.0, -30.0], abs=0.1)
    (drift,) = told["sync_drifts"]
    assert (drift["bus"], drift["from"]) == ("can1", "can0")
    assert drift["drift_ppm"] == pytest.approx(-70.0, abs=0.2)
    assert main(["analyse", str(path), *rates]) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = [one for one in lines if one.startswith("can0: SYNC every")]
    assert "its clock +40.0 ppm off 10 ms (from 1006h); jitter 0.000 us peak to peak" in line
    assert "can1: SYNC drifts by -70.0 ppm from that of can0" in lines


def test_sync_with_other_identifier_is_measured(tmp_path, capsys):
    """1005h of node 1 is read, that of node 2 written: SYNC is 090h, an EMCY by default."""
    path = tmp_path / "moved.log"
    rows = [(1 * MS, "581#4305100090000000"), (2 * MS, "602#2305100090000000")]
    rows += [(n * 10 * MS, "090#") for n in range(40)]
    rows += [(n * 100 * MS + 50, "701#05") for n in range(4)]
    path.write_text("".join(f"({at / 1e9:.9f}) can0 {row}\n" for at, row in sorted(rows)))
    _, told = as_json(capsys, str(path), "--bitrate", "can0=1M")
    (bus,) = told["buses"]
    assert (bus["sync"]["label"], bus["sync"]["period_s"]) == ("090h", 0.01)
    (sync,) = [one for one in bus["messages"] if one["label"] == "090h"]
    assert sync["name"] == "SYNC"
    main(["analyse", str(path), "--bitrate", "can0=1M"])
    assert "can0: SYNC 090h every 10.000000 ms" in capsys.readouterr().out


def test_controller_that_sends_sync_is_counted(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text(
        "[bus.can0]\nbitrate_bit_s = 500_000\nmessage = []\n[controller.left]\nkind = 'cia402'\n"
        "bus = 'can0'\nnode_id = 1\nplant = { preset = 'wheel_60w' }\n"
        'objects = { "1005h" = 0x40000090, "1006h" = 4000 }\n'
    )
    (bus,) = as_json(capsys, str(path))[1]["buses"]
    (sync,) = [one for one in bus["messages"] if one["label"] == "090h"]
    facts = [sync[key] for key in ("name", "sender", "period_s", "arrival")]
    assert facts == ["SYNC", "left", 0.004, "periodic"]


def test_closed_output_exits_silently_with_141(rig):
    """As for any verb: no output, and the status of a program that a broken pipe ends."""
    command = f"{sys.executable} -m motorhil analyse {rig} --json; echo $? >&2"
    read, write = os.pipe()
    os.close(read)
    told = subprocess.run(["sh", "-c", command], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert told.stderr == "141\n"


def test_message_late_without_interference_is_reported(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    text = "[bus.can0]\nbitrate_bit_s = 500_000\n[[bus.can0.message]]\nidentifier = 1\nlength = 8\n"
    path.write_text(f"{text}period_s = 0.01\ndeadline_s = 0.0001\n")
    assert main(["analyse", str(path)]) == 1
    told = capsys.readouterr().out
    assert "can0: 001h: its jitter and its own frame take longer than its deadline" in told
    assert "SDO" not in told  # no CANopen node is there


def test_any_identifier_is_proposed_without_canopen(tmp_path, capsys):
    """300h is late behind 10h and 20h; with CANopen no identifier below 081h would be free."""
    path = tmp_path / "rig.toml"
    path.write_text(
        "[bus.can0]\nbitrate_bit_s = 125_000\n"
        + "".join(
            f"[[bus.can0.message]]\nidentifier = {n}\nlength = {length}\nperiod_s = {period_s}\n"
            for n, length, period_s in ((0x10, 8, 0.1), (0x20, 8, 0.05), (0x300, 1, 0.002))
        )
    )
    remedy = as_json(capsys, str(path))[1]["buses"][0]["remedy"]
    (change,) = remedy["identifiers"]
    assert change["from"] == "300h"
    assert change["to"] < "020h"


def test_car_bus_is_not_canopen_and_coarse_stamps_are_noted(tmp_path, capsys):
    path = tmp_path / "car.log"
    path.write_text("".join(f"({n // 20}.0) can0 7A8#0102\n" for n in range(200)))
    _, told = as_json(capsys, str(path), "--bitrate", "can0=500k")
    (bus,) = told["buses"]
    assert [one["name"] for one in bus["messages"]] == [""]
    assert "time stamps have a resolution of 1000 ms" in bus["notes"]


def test_rig_without_can_bus_is_reported(tmp_path, capsys):
    path = tmp_path / "rig.toml"
    path.write_text('[bus.line]\nkind = "modbus_rtu"\n')
    assert main(["analyse", str(path)]) == 3
    assert capsys.readouterr().out == f"{path}: no CAN bus\n"


# ------------------------------------------------- recordings with absurd stamps end in time


def test_absurd_stamps_end_with_a_note(tmp_path, capsys):
    """Each part of the analysis has a limit of steps; every fourth stamp is damaged."""
    draw = random.Random(3)
    rows = []
    for n in range(12_000):
        at_ns = n * 100_000 if n % 4 else draw.randrange(10 ** draw.randrange(1, 19))
        rows.append(f"({at_ns // 10**9}.{at_ns % 10**9:09d}) can0 {draw.randrange(300):03X}#00\n")
    log = tmp_path / "damaged.log"
    log.write_text("".join(rows))
    status, told = as_json(capsys, str(log), "--bitrate", "can0=500k")
    (bus,) = told["buses"]
    assert status in (1, 3)
    (note,) = [note for note in bus["notes"] if "ended early" in note]
    assert "(steps): response times (1,000,000)" in note


def test_margins_of_queues_are_found_within_the_limit(capsys):
    """Two errors at this distance make no message late; at 3 us less, one is late."""
    with golden("cia402") as path:
        words = (str(path), "--bitrate", "can0=1M")
        _, told = as_json(capsys, *words)
        (bus,) = told["buses"]
        assert not [note for note in bus["notes"] if "ended early" in note]
        interval_s = bus["shortest_error_interval_s"]
        status = {
            more_s: as_json(capsys, *words, "--error-interval", f"{interval_s + more_s:.9f}")[0]
            for more_s in (0, -3e-6)
        }
    assert status == {0: 0, -3e-6: 1}


def test_effort_ends_an_analysis_without_false_bounds():
    """Whatever the limit, a bound that is found is the one of an unlimited analysis."""
    messages = tuple(
        Message(
            identifier, 8, 40 * MS + identifier, irregular_ns=3 * MS, sender=f"n{identifier % 4}"
        )
        for identifier in range(1, 33)
    )
    load = BusLoad("can0", 500_000, messages, fifo=frozenset(("n0", "n1", "n2")))
    whole = response_times(load)
    for steps in (1, 100, 3_000, 30_000, 300_000):
        effort = Effort(steps)
        found = response_times(load, effort=effort)
        assert effort.left > -2_000  # no single step is long
        assert [one.message for one in found] == [one.message for one in whole]
        unknown = [one for one in found if one.response_ns is None]
        assert bool(unknown) == effort.is_over()
        for one, other in zip(found, whole, strict=True):
            assert one.response_ns in (None, other.response_ns)


def test_search_ended_early_proves_nothing():
    """A search that ended early must not claim that no order of identifiers helps."""
    messages = tuple(Message(n, 8, 3 * MS, deadline_ns=1 * MS + n) for n in range(1, 11))
    load = BusLoad("can0", 500_000, messages)
    assert propose(load, NO_ERRORS, reserves_nothing).is_impossible
    proposal = propose(load, NO_ERRORS, reserves_nothing, Effort(50))
    assert (proposal.changes, proposal.is_impossible) == (None, False)
    assert proposal.reason.startswith("the search was ended")


def test_stamps_beyond_64_bits_with_sign_are_left_out(tmp_path, capsys):
    """MCAP has unsigned times; they were an unhandled OverflowError."""
    frames = [Frame(n * 10 * MS, "can0", pack(0x181, bytes(4))) for n in range(20)]
    frames.append(Frame(2**63, "can0", pack(0x181, bytes(4))))
    path = tmp_path / "late.mcap"
    record_frames(path, frames, {})
    assert main(["analyse", str(path), "--bitrate", "can0=500k"]) == 0
    out = capsys.readouterr().out
    assert "1 frames have time stamps beyond the year 2262, and are not counted" in out
    assert "10.000" in out


@pytest.mark.parametrize("bits", [10**7, 10**18])
def test_probability_of_errors_in_a_long_window_ends(bits):
    assert more_errors_probability(99, bits, 0.01) == 1.0
