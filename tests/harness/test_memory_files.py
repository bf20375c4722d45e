"""What a drive stores goes into the file that the rig names, and its record says what was in it."""

import os
import struct
from pathlib import Path

import can
import pytest

from emulators.canopen.parameter_text import StoredParameters
from harness.replay.recorded_rig import own_rig
from harness.rig import Rig, installed_plugins
from harness.settings import RigError
from traces.reader import read_trace

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
    """One SDO request and the four bytes of its answer; an abort as its code."""
    bus = rig.bus("can0")
    bus.send(can.Message(arbitration_id=0x600 + node_id, data=request, is_extended_id=False))
    while True:
        answer = bus.recv(1.0)
        assert answer is not None
        if answer.arbitration_id == 0x580 + node_id:
            return bytes(answer.data)


def write(rig: Rig, index: int, subindex: int, data: bytes, node_id: int = 5) -> int:
    """The abort code; 0 if there is none."""
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


def test_the_next_run_begins_with_what_the_last_one_saved(tmp_path):
    path = store(tmp_path)
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["left.parameters", "rig.toml"]
    with booted(path) as rig:
        assert read(rig, 0x6083) == 4321
        assert any("stored values, of left.parameters (CRC " in note for note in rig.notes)
        assert write(rig, 0x1011, 1, LOAD) == 0
    with booted(path) as rig:
        assert read(rig, 0x6083) != 4321


def test_without_a_file_it_is_kept_as_long_as_the_rig_is_there(tmp_path):
    path = written(tmp_path)
    for _ in range(2):
        with booted(path) as rig:
            assert read(rig, 0x1017, node_id=6) == 0
            assert write(rig, 0x1017, 0, struct.pack("<H", 900), node_id=6) == 0
            assert write(rig, 0x1010, 1, SAVE, node_id=6) == 0
            rig.bus("can0").send(can.Message(data=[129, 6], is_extended_id=False))  # reset node
            rig.runtime.wait_until(lambda: False, 0.5)
            assert read(rig, 0x1017, node_id=6) == 900
    assert [file.name for file in tmp_path.iterdir()] == ["rig.toml"]


def test_a_recording_holds_what_was_loaded_and_its_rig_begins_with_it(tmp_path):
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
    assert (tmp_path / "left.parameters").read_bytes() != loaded  # the run's own file, untouched


def test_a_torn_file_is_told_and_defaults_are_used(tmp_path):
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
        (RIG.replace('"left.parameters"', '"no/such/folder"'), "there is no folder"),
        (RIG.replace('"left.parameters"', '"."'), "cannot be read"),
        (RIG.replace('"left.parameters"', "5"), "5 is not a path"),
        (RIG + 'nonvolatile_memory = "left.parameters"\n', 'memory of controller "left" already'),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_with_its_line(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(RigError) as refused:
        Rig.open(path)
    assert message in str(refused.value).replace("'", '"')
    assert refused.value.line == (7 if text.count("nonvolatile") == 1 else 12)


def test_what_cannot_be_saved_is_aborted_and_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = store(tmp_path)
    file = tmp_path / "left.parameters"
    before = file.read_bytes()
    with booted(path) as rig:
        monkeypatch.setattr(os, "replace", _fails)
        assert write(rig, 0x1010, 1, SAVE) == 0x0606_0000
    assert file.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["left.parameters", "rig.toml"]


@pytest.mark.parametrize("theirs", ["rig.toml", "drive.py"])
def test_a_file_that_is_something_else_is_told_and_not_overwritten(tmp_path, theirs):
    """A rig that names itself, or a script, would be gone by the first save."""
    (tmp_path / "drive.py").write_text("print('mine')\n")
    path = written(tmp_path, RIG.replace("left.parameters", theirs))
    before = (tmp_path / theirs).read_bytes()
    with booted(path) as rig:
        assert any(f"left: warning: {theirs} is left out, it does not" in one for one in rig.notes)
        assert write(rig, 0x1010, 1, SAVE) == 0x0606_0000
    assert (tmp_path / theirs).read_bytes() == before


def test_a_pipe_is_not_waited_for_and_a_device_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "left.parameters")
    with pytest.raises(RigError, match="cannot be read: it is a folder or a device"):
        Rig.open(written(tmp_path))


def test_a_link_stays_a_link_and_what_it_leads_to_is_written(tmp_path):
    (tmp_path / "kept").mkdir()
    (tmp_path / "left.parameters").symlink_to("kept/of_left")
    store(tmp_path)
    assert (tmp_path / "left.parameters").is_symlink()
    assert (tmp_path / "kept/of_left").read_bytes().startswith(b"motorhil parameters 1")


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    path = written(tmp_path, RIG.replace("left.parameters", "a\\u0000b"))
    with pytest.raises(RigError, match=r":7: controller.left.nonvolatile_memory: .* is no path"):
        Rig.open(path)


def test_ctrl_c_while_it_saves_leaves_the_old_file_and_nothing_beside_it(tmp_path, monkeypatch):
    path = store(tmp_path)
    before = (tmp_path / "left.parameters").read_bytes()
    monkeypatch.setattr(os, "replace", _interrupted)
    with booted(path) as rig, pytest.raises(KeyboardInterrupt):
        write(rig, 0x1010, 1, SAVE)
    assert (tmp_path / "left.parameters").read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["left.parameters", "rig.toml"]


def _interrupted(source: object, target: object) -> None:
    raise KeyboardInterrupt


def test_the_text_of_a_file_is_what_readme_says():
    parameters = StoredParameters((0, 0x402))
    parameters.values[0x6083_00] = struct.pack("<I", 4321)
    assert parameters.write().decode().splitlines()[:3] == [
        "motorhil parameters 1",
        "identity 00000000 00000402",
        "6083:00 E1100000",
    ]


def _fails(source: object, target: object) -> None:
    raise OSError(28, "No space left on device")
