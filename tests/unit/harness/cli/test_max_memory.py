"""`--max-memory`: the bound of what a compressed piece of a file may become."""

import pytest
from mcap.writer import CompressionType, Writer

from motorhil.harness.cli.main import main
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import Source

MIB = 1 << 20
VERBS = (
    *(["show"], ["judge"], ["report", "-o", "page.html"], ["convert", "-o", "a.log", "--force"]),
    *(["diff", "big.mcap"], ["diff", "big.mcap", "--exact"], ["analyse"]),
    ["replay", "--as", "traffic", "--on", "virtual:1"],
)


@pytest.fixture
def big(tmp_path, monkeypatch):
    """Return a recording with a chunk of 3 MiB, written by another library."""
    monkeypatch.chdir(tmp_path)
    with open("big.mcap", "wb") as file:
        writer = Writer(file, chunk_size=8 * MIB, compression=CompressionType.ZSTD)
        writer.start()
        channel = writer.register_channel("/notes", "json", 0)
        writer.add_message(channel, 1, bytes(3 * MIB), 1)
        writer.finish()
    return "big.mcap"


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_chunk_beyond_the_bound_names_the_option(big, words, capsys):
    assert main([words[0], big, *words[1:], "--max-memory", "2"]) == 2
    told = "at most 2097152 bytes are read at once; --max-memory allows more"
    assert told in capsys.readouterr().err
    main([words[0], big, *words[1:], "--max-memory", "4"])
    assert "--max-memory" not in capsys.readouterr().err


def test_recovery_loses_a_chunk_beyond_the_bound(big, capsys):
    words = ["recover", big, "-o", "whole.mcap", "--force", "--max-memory"]
    assert main([*words, "2"]) == 0
    assert "--max-memory allows more" in capsys.readouterr().err
    assert main([*words, "4"]) == 0
    said = capsys.readouterr()
    assert (said.out, said.err) == ("whole.mcap: 1 messages in 0.000 s; nothing is lost\n", "")


@pytest.mark.parametrize(("memory_max", "is_whole"), [(1 << 28, True), (1 << 16, False)])
def test_container_of_blf_beyond_the_bound_is_told(tmp_path, memory_max, is_whole):
    log, blf = tmp_path / "a.log", tmp_path / "a.blf"
    log.write_text("".join(f"({n}.000000) can0 181#0102\n" for n in range(1000)))
    assert main(["convert", str(log), "-o", str(blf)]) == 0
    findings = Findings()
    frames = list(Source(str(blf), "blf", memory_max).frames(findings))
    assert (len(frames) == 1000) is is_whole
    texts = [str(one) for one in findings.problems]
    assert any("--max-memory allows more" in one for one in texts) is not is_whole


@pytest.mark.parametrize("text", ["0", "1.5", "-1", "much"])
def test_bound_that_is_not_a_size_is_refused(text, capsys):
    assert main(["show", "x", "--max-memory", text]) == 2
    assert "is not a whole number from 1 to 1048576 MiB" in capsys.readouterr().err
