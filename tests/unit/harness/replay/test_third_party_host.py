"""Recordings of a host written with canopen, replayed against rigs and counted by hand."""

import re

import pytest

from motorhil.harness.cli.main import main

RIG = """\
[bus.can0]
bitrate_bit_s = 500_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 2
plant = { preset = "wheel_60w" }
[controller.right]
kind = "cia402"
bus = "can0"
node_id = 3
plant = { preset = "wheel_60w" }
"""
HOST = """\
import time
import canopen
network = canopen.Network()
network.connect(interface="socketcan", channel="can0")
network.send_periodic(0x701, b"\\x05", 0.2)  # the master's own heartbeat
time.sleep(1.0)
left, right = (
    network.add_node(canopen.RemoteNode(n, canopen.ObjectDictionary())) for n in (2, 3)
)
for index in (0x1000, 0x6081, 0x6502, 0x6064):
    right.sdo.upload(index, 0)
left.sdo.upload(0x1000, 0)
left.nmt.send_command(1)
left.sdo.download(0x6060, 0, b"\\1")
for word in (0x06, 0x07, 0x0F):
    network.send_message(0x202, bytes((word, 0)))
    time.sleep(0.05)
left.sdo.download(0x607A, 0, (20_000).to_bytes(4, "little"))
network.send_message(0x202, b"\\x1f\\0")
time.sleep(1.0)
left.sdo.upload(0x6064, 0)
network.send_message(0x202, b"\\0\\0")
time.sleep(0.3)
network.disconnect()
"""
REPORTS = 17
"""Left: boot-up, 1000h, 6061h, 6064h and 8 statuswords. Right: boot-up and 4 objects.

The statuswords are those of CiA 402-2 on the way: switch on disabled, ready to switch on, switched
on, operation enabled, target reached, set-point acknowledge, target reached, switch on disabled.
"""
SUMMARY = re.compile(r"(\S+) % of what they tell agrees; (\d+) differences, (\d+) times waited")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a folder with the recording and its exports."""
    folder = tmp_path_factory.mktemp("host")
    (folder / "rig.toml").write_text(RIG)
    (folder / "host.py").write_text(HOST)
    path = str(folder / "bench.mcap")
    assert main(["run", str(folder / "rig.toml"), str(folder / "host.py"), "-o", path]) == 0
    for name, form in (("bench.log", "candump-x"), ("bench.csv", "csv")):
        assert main(["convert", path, "-o", str(folder / name), "--to", form]) == 0
    log = (folder / "bench.log").read_text()
    plain = re.sub(r" [RT]$", "", log, flags=re.MULTILINE)
    (folder / "plain.log").write_text(plain)
    (folder / "monitor.log").write_text(re.sub(r" T$", " R", log, flags=re.MULTILINE))
    table = (folder / "bench.csv").read_text()
    (folder / "plain.csv").write_text(re.sub(r"(transmitted|received),\w*,", "unknown,,", table))
    rows = (line.split() for line in plain.splitlines())
    frames = ((bus, *frame.split("#")) for _, bus, frame in rows)
    told = ((bus, one, bytes.fromhex(data)) for bus, one, data in frames)
    unstamped = (f"  v{bus}  {one}   [{len(data)}]  {data.hex(' ')}\n" for bus, one, data in told)
    (folder / "unstamped.txt").write_text("".join(unstamped))
    late = [line for line in plain.splitlines() if not line.startswith("(0000000000")]
    (folder / "late.log").write_text("\n".join(late) + "\n")
    return folder


@pytest.fixture
def replayed(recorded, say, tmp_path):
    """Return a function that replays a file against a rig: status, output, error, summary."""

    def run(name, *changes, words=()):
        text = RIG
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        rig = tmp_path / "rig.toml"
        rig.write_text(text)
        options = ("--as", "host", "--rig", str(rig), *words)
        status, out, err = say("replay", str(recorded / name), *options)
        found = SUMMARY.search(out)
        assert found is not None, err
        return status, out, err, found.groups()

    return run


@pytest.mark.parametrize(
    "name", ["bench.mcap", "bench.log", "plain.log", "monitor.log", "plain.csv", "unstamped.txt"]
)
def test_same_rig_agrees_completely_in_any_format(replayed, name):
    status, out, err, summary = replayed(name)
    assert (status, summary) == (0, ("100.00", "0", "0")), out
    is_inferred = name in ("plain.log", "monitor.log", "plain.csv", "unstamped.txt")
    assert ("node 1 is taken as the host's own" in err) is is_inferred


def test_recording_after_boot_up_agrees_completely(replayed):
    """Its first device frame is an answer; the rig's drives boot later than their first request."""
    status, out, err, summary = replayed("late.log")
    assert (status, summary) == (0, ("100.00", "0", "0")), out
    assert "the recording begins after its devices had booted; the host waited 0.300 s" in err


def test_unstamped_recording_tells_its_pitch_and_bus(replayed):
    _, _, err, _ = replayed("unstamped.txt")
    assert "the frames have no time stamps; they are taken as 1 ms apart" in err
    assert "bus vcan0 is replayed on can0" in err


RIGHT = 'node_id = 3\nplant = { preset = "wheel_60w" }'


@pytest.mark.parametrize("name", ["bench.mcap", "plain.log", "unstamped.txt"])
@pytest.mark.parametrize(
    ("setting", "label", "told"),
    [
        ('supported_modes = ["pp"]', "6502h supported drive modes", "00000001h"),
        ('objects = { "6081h" = 5000 }', "6081h profile velocity", "5000"),
        ("initial_position_rad = 3.0", "6064h position actual value", None),
    ],
)
def test_one_planted_difference_is_the_only_one(replayed, name, setting, label, told):
    status, out, _, summary = replayed(name, (RIGHT, f"{RIGHT}\n{setting}"))
    share = f"{100 * (REPORTS - 1) / REPORTS:.2f}"
    assert (status, summary) == (1, (share, "1", "0")), out
    (line,) = [line for line in out.splitlines() if ", but " in line]
    assert f"can0, node 3 (right), {label}: " in line
    if told is not None:
        assert f", but {label} = {told} at " in line


def test_late_recording_counts_from_the_hosts_first_frame(replayed):
    """The two boot-ups are not in it."""
    setting = 'objects = { "6081h" = 5000 }'
    _, out, _, summary = replayed("late.log", (RIGHT, f"{RIGHT}\n{setting}"))
    assert summary == (f"{100 * (REPORTS - 3) / (REPORTS - 2):.2f}", "1", "0"), out


def test_device_that_only_the_rig_has_is_not_compared(replayed):
    more = RIG[RIG.index("[controller.right]") :].replace("right", "more").replace("= 3", "= 9")
    status, _, err, summary = replayed("plain.log", (RIGHT, f"{RIGHT}\n{more}"))
    assert (status, summary) == (0, ("100.00", "0", "0"))
    assert "not in the recording, so not compared: can0 node 9" in err


def test_device_that_the_rig_lacks_is_waited_for_once(replayed):
    status, out, err, (_, _, waited) = replayed("plain.log", ("node_id = 3", "node_id = 4"))
    assert (status, waited) == (1, "1"), out
    assert "the rig lacks recorded devices, which count as disagreement: can0 node 3" in err


def test_host_node_option_names_the_hosts_own_node(recorded, replayed):
    """A master with an emergency could be a device."""
    plain = (recorded / "plain.log").read_text()
    emergency = "(0000000000.500000) can0 081#1081010000000000\n"
    head, tail = plain.split("(0000000000.6", 1)
    (recorded / "master.log").write_text(f"{head}{emergency}(0000000000.6{tail}")
    assert "NMT state = operational" in replayed("master.log")[1]
    _, out, _, (share, differences, _) = replayed("master.log", words=("--host-node", "1"))
    assert (share, differences) == (f"{100 * REPORTS / (REPORTS + 1):.2f}", "1"), out
    assert "node 1, emergency" in out
