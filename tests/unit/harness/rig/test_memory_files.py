"""Nonvolatile memory files of drives, and their contents in the record."""

import os
import struct
from pathlib import Path

import can
import pytest

from motorhil.emulators.canopen.files.parameter_storage import StoredParameters
from motorhil.harness.replay.rig import own_rig
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.traces.mcap.reader import read_trace

RIG = """\
[bus.can0]
bitrate_bit_s = 500_000
[controller.left]
kind = "cia402"
bus = "can0"
node_id = 5
nonvolatile_memory = "left.parameters"
[controller.io]
kind = "cia401"
bus = "can0"
node_id = 6
"""
SAVE, LOAD = b"save", b"load"


def written(folder: Path, text: str = RIG) -> Path:
    path = folder / "rig.toml"
    path.write_text(text)
    return path


def sdo(rig: Rig, node_id: int, request: bytes) -> bytes:
    """Send an SDO request and return its response."""
    bus = rig.bus("can0")
    bus.send(can.Message(arbitration_id=0x600 + node_id, data=request, is_extended_id=False))
    while True:
        answer = bus.recv(1.0)
        assert answer is not None
        if answer.arbitration_id == 0x580 + node_id:
            return bytes(answer.data)


def write(rig: Rig, index: int, subindex: int, data: bytes, node_id: int = 5) -> int:
    """Write an object; return the abort code, or 0."""
    command = 0x23 | (4 - len(data)) << 2
    answer = sdo(rig, node_id, struct.pack("<BHB4s", command, index, subindex, data))
    return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0


def read(rig: Rig, index: int, subindex: int = 0, node_id: int = 5) -> int:
    answer = sdo(rig, node_id, struct.pack("<BHB4x", 0x40, index, subindex))
    return int.from_bytes(answer[4:], "little")


def booted(path: Path, **options: object) -> Rig:
    rig = Rig.open(path, **options)
    rig.runtime.wait_until(lambda: False, 0.5)
    return rig


def store(folder: Path) -> Path:
    path = written(folder)
    with booted(path) as rig:
        assert write(rig, 0x6083, 0, struct.pack("<I", 4321)) == 0
        assert write(rig, 0x1010, 1, SAVE) == 0
    return path


def test_next_run_starts_with_the_saved_values(tmp_path):
    path = store(tmp_path)
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["left.parameters", "rig.toml"]
    with booted(path) as rig:
        assert read(rig, 0x6083) == 4321
        assert any("stored values, of left.parameters (CRC " in note for note in rig.notes)
        assert write(rig, 0x1011, 1, LOAD) == 0
    with booted(path) as rig:
        assert read(rig, 0x6083) != 4321


def test_memory_without_a_file_lasts_as_long_as_the_rig(tmp_path):
    path = written(tmp_path)
    for _ in range(2):
        with booted(path) as rig:
            assert read(rig, 0x1017, node_id=6) == 0
            assert write(rig, 0x1017, 0, struct.pack("<H", 900), node_id=6) == 0
            assert write(rig, 0x1010, 1, SAVE, node_id=6) == 0
            rig.bus("can0").send(can.Message(data=[129, 6], is_extended_id=False))  # NMT reset node
            rig.runtime.wait_until(lambda: False, 0.5)
            assert read(rig, 0x1017, node_id=6) == 900
    assert [file.name for file in tmp_path.iterdir()] == ["rig.toml"]


def test_recording_contains_the_loaded_values(tmp_path):
    path = store(tmp_path)
    loaded = (tmp_path / "left.parameters").read_bytes()
    record = tmp_path / "run.mcap"
    with booted(path, record=record) as rig:
        assert write(rig, 0x6083, 0, struct.pack("<I", 1)) == 0
        assert write(rig, 0x1010, 1, SAVE) == 0
    with read_trace(record) as trace:
        attached = {one.name: one.data for one in trace.attachments}
        told = [one for one in trace.attachments if one.name == "left.parameters"]
    assert attached["left.parameters"] == loaded
    assert len(told) == 1
    again = own_rig(record, installed_plugins(), tmp_path / "again")
    assert again is not None
    with Rig(again) as rig:
        rig.runtime.wait_until(lambda: False, 0.5)
        assert read(rig, 0x6083) == 4321
    assert (
        tmp_path / "left.parameters"
    ).read_bytes() != loaded  # the file of this run is not attached


def test_truncated_file_is_reported_and_defaults_are_used(tmp_path):
    path = store(tmp_path)
    file = tmp_path / "left.parameters"
    file.write_bytes(file.read_bytes()[:-9])
    with booted(path) as rig:
        assert read(rig, 0x6083) != 4321
        wanted = "left: warning: left.parameters is left out, it ends early; save again (1010h)"
        assert wanted in rig.notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (RIG.replace('"left.parameters"', '"no/such/folder"'), "does not exist; create the folder"),
        (RIG.replace('"left.parameters"', '"."'), "cannot be read"),
        (RIG.replace('"left.parameters"', "5"), "must be a string, but is an integer (5)"),
        (RIG + 'nonvolatile_memory = "left.parameters"\n', 'memory of controller "left" already'),
    ],
)
def test_unusable_file_is_refused_with_its_line(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(RigError) as refused:
        Rig.open(path)
    assert message in str(refused.value).replace("'", '"')
    assert refused.value.line == (7 if text.count("nonvolatile") == 1 else 12)


def test_failed_save_aborts_and_leaves_the_file_unchanged(tmp_path, monkeypatch):
    path = store(tmp_path)
    file = tmp_path / "left.parameters"
    before = file.read_bytes()
    with booted(path) as rig:
        monkeypatch.setattr(os, "replace", _fails)
        assert write(rig, 0x1010, 1, SAVE) == 0x0606_0000
    assert file.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["left.parameters", "rig.toml"]


@pytest.mark.parametrize("theirs", ["rig.toml", "drive.py"])
def test_foreign_file_is_reported_and_not_overwritten(tmp_path, theirs):
    """A rig that names itself, or a script, would lose it on the first save."""
    (tmp_path / "drive.py").write_text("print('mine')\n")
    path = written(tmp_path, RIG.replace("left.parameters", theirs))
    before = (tmp_path / theirs).read_bytes()
    with booted(path) as rig:
        assert any(f"left: warning: {theirs} is left out, it does not" in one for one in rig.notes)
        assert write(rig, 0x1010, 1, SAVE) == 0x0606_0000
    assert (tmp_path / theirs).read_bytes() == before


def test_pipe_as_memory_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "left.parameters")
    with pytest.raises(RigError, match="cannot be read: it is a folder or a device"):
        Rig.open(written(tmp_path))


def test_link_stays_a_link_and_its_target_is_written(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "left.parameters").symlink_to("kept/of_left")
    store(tmp_path)
    assert (tmp_path / "left.parameters").is_symlink()
    assert (tmp_path / "kept/of_left").read_bytes().startswith(b"motorhil parameters 1")


def test_impossible_file_name_is_refused(tmp_path):
    path = written(tmp_path, RIG.replace("left.parameters", "a\\u0000b"))
    told = r":7: controller.left.nonvolatile_memory: .* is not a path"
    with pytest.raises(RigError, match=told):
        Rig.open(path)


def test_ctrl_c_during_a_save_keeps_the_old_file(tmp_path, monkeypatch):
    path = store(tmp_path)
    before = (tmp_path / "left.parameters").read_bytes()
    monkeypatch.setattr(os, "replace", _interrupted)
    with booted(path) as rig, pytest.raises(KeyboardInterrupt):
        write(rig, 0x1010, 1, SAVE)
    assert (tmp_path / "left.parameters").read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["left.parameters", "rig.toml"]


def _interrupted(source: object, target: object) -> None:
    raise KeyboardInterrupt


def test_text_of_a_memory_file_matches_readme():
    parameters = StoredParameters((0, 0x402))
    parameters.values[0x6083_00] = struct.pack("<I", 4321)
    assert parameters.write().decode().splitlines()[:3] == [
        "motorhil parameters 1",
        "identity 00000000 00000402",
        "6083:00 E1100000",
    ]


def _fails(source: object, target: object) -> None:
    raise OSError(28, "No space left on device")
