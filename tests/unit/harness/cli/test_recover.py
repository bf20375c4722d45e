import json

from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.recordings.written import write


def test_cut_recording_is_recovered_and_losses_are_reported(say, tmp_path):
    source, target = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    write(source)
    data = source.read_bytes()
    with read_trace(source) as trace:
        last = trace._chunks[-1].offset
    source.write_bytes(data[: last + 100])
    status, out, err = say("recover", str(source), "-o", str(target))
    assert status == 0
    assert f"{target}: 80 messages in 3.950 s; 100 bytes and 0.950 s are lost" in out
    assert f"{source}: 100 bytes at byte {last} are lost: the end of a chunk" in err
    assert "4.000 s to 4.950 s" in err
    with read_trace(target) as trace:
        assert trace.cut is None
        assert len(list(trace.messages())) == 80
    assert say("recover", str(source), "-o", str(target))[0] == 2  # the target exists
    status, out, err = say("recover", str(source), "-o", str(target), "--force", "--json")
    assert json.loads(out)["losses"][0]["bytes"] == 100
    assert err == ""


def test_complete_recording_loses_nothing(say, tmp_path):
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write(source)
    status, out, err = say("recover", str(source), "-o", str(target))
    assert (status, err) == (0, "")
    assert out == f"{target}: 100 messages in 4.950 s; nothing is lost\n"
    assert digest(source) == digest(target)


def test_file_that_is_not_a_recording_is_reported(say, tmp_path):
    file = tmp_path / "a.log"
    file.write_text("(0.0) can0 123#00")
    status, out, err = say("recover", str(file), "-o", str(tmp_path / "b.mcap"))
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "is not an MCAP file" in err
