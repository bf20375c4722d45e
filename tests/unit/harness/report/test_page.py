"""Command `motorhil report`, and the file it writes."""

import re

import pytest
from mcap.reader import make_reader

from motorhil.harness.cli.main import main
from motorhil.harness.report.foxglove import layout_of, path_of
from motorhil.traces.mcap.reader import read_trace
from tests.support.recordings.handmade import Recorded
from tests.unit.harness.report.conftest import document_in


def test_page_has_no_external_address(demo_page):
    """There are no addresses, no links except to its own sections, and nothing to load."""
    text = demo_page.read_text("utf-8")
    markup = re.sub(
        r'<script type="(application/json|text/plain)".*?</script>', "", text, flags=re.S
    )
    addresses = set(re.findall(r"[a-z]+://[^\s\"'<)]+", markup))
    assert addresses == {"http://www.w3.org/2000/svg"}  # a namespace, never loaded
    loads = re.findall(r"""(?:src|href)\s*=\s*["']?([^"'\s>]*)""", markup)
    assert set(loads) <= {"data:,", "#"}
    assert not re.search(r"@import|url\(", markup)


def test_page_is_reproducible(demo, demo_page, tmp_path):
    again = tmp_path / "again.html"
    assert main(["report", str(demo), "-o", str(again)]) == 0
    assert again.read_bytes() == demo_page.read_bytes()
    document, arrays = document_in(again)
    assert document["title"] == "demo.mcap"
    assert len(arrays.times(document["traffic"][0]["t"])) == 10_437
    assert again.stat().st_size < 600_000


def test_page_without_output_option_is_beside_recording(tmp_path, capsys):
    path = Recorded(tmp_path / "a.mcap").frame(1, 0x100, "00").close()
    assert main(["report", path]) == 0
    assert capsys.readouterr().out.startswith(f"{tmp_path / 'a.html'}: 1 messages")
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["absent.mcap"], "absent.mcap: cannot be read: no such file"),
        (["text.txt"], "text.txt: holds no CAN traffic in a format known here"),
        (["a.mcap", "-o", "a.mcap"], "a.mcap: is the recording itself"),
        (["a.mcap", "--foxglove-layout", "a.mcap"], "a.mcap: is the recording itself"),
        (["a.mcap", "-o", "no/folder.html"], "no/folder.html: cannot be written: no such file"),
    ],
)
def test_unusable_input_is_refused_in_one_line(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    content = Recorded("a.mcap").frame(1, 0x100, "00").close()
    (tmp_path / "text.txt").write_text("no recording\n")
    before = (tmp_path / content).read_bytes()
    assert main(["report", *words]) == 2
    err = capsys.readouterr().err
    assert told in err
    assert err.count("\n") == 1
    assert (tmp_path / content).read_bytes() == before


# ------------------------------------------------------------------------------- Foxglove


def panels_in(layout):
    """Return the identifiers of panels in a mosaic, in order."""
    if isinstance(layout, str):
        return [layout]
    assert set(layout) == {"direction", "first", "second", "splitPercentage"}
    assert layout["direction"] in ("row", "column")
    assert 0 < layout["splitPercentage"] < 100
    return panels_in(layout["first"]) + panels_in(layout["second"])


def test_foxglove_layout_shows_recorded_topics(demo):
    """Each panel appears once; each path has a topic and a field of the file's schemas."""
    from mcap_protobuf.decoder import DecoderFactory

    with read_trace(demo) as trace:
        layout = layout_of(trace)
    fields = {}
    with demo.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, decoded in reader.iter_decoded_messages():
            fields.setdefault(channel.topic, set(decoded.DESCRIPTOR.fields_by_name))
    configs = layout["configById"]
    placed = panels_in(layout["layout"])
    for name in [name for name in placed if name.startswith("Tab!")]:
        for tab in configs[name]["tabs"]:
            placed += panels_in(tab["layout"])
    assert sorted(placed) == sorted(configs)
    shown = set()
    for name, config in configs.items():
        if name.startswith("RawMessages!"):
            assert config["topicPath"] in fields
        for path in config.get("paths", ()):
            topic, _, field = path["value"].rpartition(".")
            assert field in fields[topic], path["value"]
            shown.add(topic)
    assert {f"/motor/{name}/state" for name in ("drive_fl", "steer_rr", "pan", "tilt")} <= shown
    assert {"/group/mast/sync", "/controller/pan/truth", "/motor/pan/lock"} <= shown
    kinds = {name.partition("!")[0] for name in configs}
    assert kinds == {"Plot", "StateTransitions", "RawMessages", "Tab"}


def test_foxglove_layout_of_minimal_recording_is_written(tmp_path, capsys):
    path = Recorded(tmp_path / "a.mcap").event(1, "hot", "left").frame(2, 0x100, "00").close()
    layout = tmp_path / "layout.json"
    assert main(["report", path, "--foxglove-layout", str(layout)]) == 0
    assert '"RosOut!motorhil1"' in layout.read_text()
    assert "a layout for Foxglove" in capsys.readouterr().out


def test_path_of_quotes_unusual_topics():
    assert path_of("/motor/pan/state", "position") == "/motor/pan/state.position"
    assert path_of("/motor/my arm.1/state", "position") == '"/motor/my arm.1/state".position'
    assert path_of('/a"b', "x") == '"/a\\"b".x'
