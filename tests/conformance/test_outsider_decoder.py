"""The outsider's decoder in `motorhil show`, compared with the vendor's DBC read by cantools."""

import re
import struct
import tomllib

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig
from motorhil.traces.can_frame import classic
from motorhil.traces.formats.frames import Frame
from motorhil.traces.formats.registry import record_frames
from tests.support.outsider_source import OUTSIDER, importable

NODE = 3


@pytest.fixture(autouse=True)
def package(tmp_path, monkeypatch):
    """Install the package's own entry points."""
    importable(monkeypatch)
    project = tomllib.loads((OUTSIDER / "pyproject.toml").read_text())["project"]
    info = tmp_path / "site" / "motorhil_odrive-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    points = [
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in group_points.items())
        for group, group_points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("".join(points))
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def vendor(shared):
    cantools = pytest.importorskip("cantools", reason="needs cantools: pip install cantools")
    path = shared / "data" / "eds" / "odrive_cansimple_0.6.10.dbc"
    if not path.is_file():
        pytest.skip(f"no {path.name}")
    return cantools.database.load_file(path)


def told(capsys, *words):
    assert main(["show", *words]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    return [line.split("can0", 1)[1].strip() for line in said.out.splitlines()]


def test_rig_of_odrives_is_shown_in_words(capsys):
    with Rig.open(OUTSIDER / "src" / "motorhil_odrive" / "rig.toml", record="a.mcap") as rig:
        rig.runtime.wait_until(lambda: False, 0.7)
    said = told(capsys, "a.mcap", "--motor", "left", "--bus", "can0")
    assert "Get_Encoder_Estimates: Pos_Estimate = 0 rev, Vel_Estimate = 0 rev/s" in said
    assert any(text.startswith("Heartbeat: Axis_Error = NONE, Axis_State = ") for text in said)


@pytest.mark.data
def test_all_messages_are_told_as_in_the_dbc(vendor, capsys):
    messages = [
        one
        for one in vendor.messages
        if one.frame_id >> 5 == NODE and not re.search("Sdo|Address", one.name)
    ]
    assert len(messages) == 25
    frames = []
    for one in messages:
        raws = {signal.name: 1.25 if signal.is_float else 1 for signal in one.signals}
        data = one.encode(raws, scaling=False)
        frames.append(Frame(len(frames), "can0", classic(one.frame_id, data)))
    record_frames("b.mcap", frames, {})
    said = told(capsys, "b.mcap", "--decoder", f"{NODE}=odrive")
    for one, frame, text in zip(messages, frames, said, strict=True):
        name, _, signals = text.partition(": ")
        assert f"Axis{NODE}_{name}" == one.name
        told_signals = dict(part.split(" = ") for part in signals.split(", ") if part)
        assert told_signals == expected(one, frame), one.name


def expected(message, frame):
    """Return {signal: value and unit} as cantools reads them.

    A scale's footnote is no unit; names of values are in capitals here.
    """
    values = message.decode(frame.frame[8 : 8 + message.length])
    units = {one.name: (one.unit or "").partition(" (default)")[0] for one in message.signals}
    return {
        name: f"{value:.9g} {units[name]}".rstrip()
        if isinstance(value, float)
        else str(value).upper()
        for name, value in values.items()
    }


def test_estimates_are_told_with_units(capsys):
    data = struct.pack("<ff", 1.25, 0.1)  # position [rev], velocity [rev/s], little endian
    record_frames("c.mcap", [Frame(0, "can0", classic(NODE << 5 | 9, data))], {})
    [text] = told(capsys, "c.mcap", "--decoder", f"{NODE}=odrive")
    assert text.startswith("Get_Encoder_Estimates: Pos_Estimate = 1.25 rev, Vel_Estimate = 0.1")
    assert text.endswith(" rev/s")


def test_frame_too_short_for_its_message_is_told(capsys):
    record_frames("d.mcap", [Frame(0, "can0", classic(NODE << 5 | 9, bytes(3)))], {})
    [text] = told(capsys, "d.mcap", "--decoder", f"{NODE}=odrive")
    assert text == "Get_Encoder_Estimates: not decodable: 3 bytes; 8 are needed"
