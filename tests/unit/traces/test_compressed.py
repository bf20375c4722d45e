"""Files compressed by gzip and in UTF-16 are read as their content; strangers are named."""

import gzip
import zlib

import pytest

from motorhil.harness.recording.conversion import convert
from motorhil.traces.errors import TraceError
from motorhil.traces.files import open_content
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import open_source, record_frames
from motorhil.traces.mcap.reader import read_trace
from tests.support.recordings.formats import WRITTEN
from tests.unit.traces.formats.test_formats import BASE

ROW = b"(1.000000) can0 123#0102\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def read(path):
    findings = Findings()
    return list(open_source(path).frames(findings)), findings


@pytest.mark.parametrize("form", WRITTEN)
def test_compressed_file_has_the_same_frames(form):
    record_frames("frames.mcap", BASE, {})
    convert("frames.mcap", "plain", form.name)
    with open("plain", "rb") as file, open("packed", "wb") as target:
        target.write(gzip.compress(file.read()))
    assert read("packed")[0] == read("plain")[0] != []


def test_compressed_recording_has_the_same_messages():
    record_frames("plain", BASE, {"run": {}})
    with open("plain", "rb") as file, open("packed", "wb") as target:
        target.write(gzip.compress(file.read()))
    with read_trace("packed") as packed, read_trace("plain") as plain:
        assert list(packed.messages()) == list(plain.messages()) != []
        assert packed.metadata == plain.metadata


def test_members_and_padding_are_one_content():
    with open("packed", "wb") as file:  # RFC 1952, 2.2: a series of members
        file.write(gzip.compress(ROW, mtime=0) + gzip.compress(ROW * 2) + bytes(512))
    found, findings = read("packed")
    assert (len(found), findings.problems) == (3, [])


@pytest.mark.parametrize(
    ("end", "tail", "words"), [(-9, b"", "cut short"), (-8, b"wrong CRC", "damaged")]
)
def test_damaged_data_is_read_up_to_the_damage(end, tail, words):
    rows = b"".join(b"(%d.0) can0 123#%04X\n" % (n, n * 40503 % 65536) for n in range(30_000))
    with open("packed", "wb") as file:
        file.write(gzip.compress(rows, mtime=0)[:end] + tail)
    found, findings = read("packed")
    assert len(found) > 29_000
    assert words in findings.problems[-1].text


def test_content_beyond_the_ratio_is_refused():
    packer = zlib.compressobj(9, wbits=31)
    with open("bomb", "wb") as file:
        file.write(packer.compress(ROW))
        for _ in range(16):
            file.write(packer.compress(bytes(1 << 20)))
        file.write(packer.flush())
    refusal = r"bomb: unpacks to more than \d+ bytes; --max-memory allows more"
    with pytest.raises(TraceError, match=refusal):
        list(open_source("bomb", 1 << 20).frames(Findings()))
    assert len(list(open_source("bomb", 1 << 25).frames(Findings()))) == 1


@pytest.mark.parametrize("size", [5, 12, 20])
def test_data_cut_before_its_first_row_is_told(size):
    with open("packed", "wb") as file:
        file.write(gzip.compress(ROW * 100, mtime=0)[:size])
    with pytest.raises(TraceError) as caught:
        read("packed")
    assert caught.value.what.startswith("its gzip data is cut short, ")
    assert caught.value.remedy.startswith("copy the file again")


def test_content_below_the_free_size_is_accepted():
    with open("zeros", "wb") as file:
        file.write(gzip.compress(bytes(63_000_000), 1))
    with open_content("zeros") as content:
        assert content.seek(0, 2) == 63_000_000


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_text_with_byte_order_mark_is_read(encoding):
    with open("text", "wb") as file:
        file.write((ROW * 2).decode().encode(encoding))
    found, findings = read("text")
    assert (len(found), findings.problems) == (2, [])


@pytest.mark.parametrize(
    ("head", "what", "remedy"),
    [
        (b"", "is empty", "record again"),
        (gzip.compress(b"", mtime=0), "is empty", "record again"),
        (bytes(100), "begins with 100 bytes of nothing", "record again"),
        (b"PK\x03\x04rest", "is a ZIP archive", "unzip it"),
        (b"(\xb5/\xfdrest", "is compressed by zstd", "unzstd"),
        (b"#ROSBAG V2.0\n", "is a ROS 1 bag", "mcap convert"),
        (b"SQLite format 3\0", "is a SQLite database", "mcap convert"),
        (b"MDF     3.30    ", "is an MDF file of version 3", "asammdf"),
        (b"\x89HDF\r\n\x1a\n", "is an HDF5 file", "export"),
        (b"\x7fELF\2\1", "is a program (ELF)", "give a recording"),
        (b"\n<!doctype html>", "is a page of the web", "download"),
        (
            b"version https://git-lfs.github.com/spec/v1\n",
            "is a pointer of Git LFS",
            "git lfs pull",
        ),
        (b"; comment\n[FileInfo]\nFileName=a.eds\n", "is an EDS, without traffic", "--eds"),
    ],
)
def test_known_stranger_is_named_with_a_remedy(head, what, remedy):
    with open("other", "wb") as file:
        file.write(head)
    with pytest.raises(TraceError) as caught:
        open_source("other")
    assert what in caught.value.what
    assert remedy in caught.value.remedy
