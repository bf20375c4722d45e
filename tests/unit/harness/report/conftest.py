"""Fixtures: the report of the demo, made once, and of any recording."""

import base64
import json
import re
import zlib

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.report.collect import collect
from motorhil.harness.report.document import document_of
from motorhil.traces.mcap.reader import read_trace


@pytest.fixture(scope="session")
def demo_page(demo):
    page = demo.with_suffix(".html")
    assert main(["report", str(demo), "-o", str(page)]) == 0
    return page


@pytest.fixture(scope="session")
def report_of():
    """Return a function that gives findings, document and arrays of a recording."""

    def report(path, **limits):
        with read_trace(path) as trace:
            found = collect(trace)
            document, packed = document_of(trace, found, "a title", **limits)
        return found, document, Arrays(packed)

    return report


class Arrays:
    """The packed arrays, decoded from their description with plain Python integers."""

    def __init__(self, packed):
        self.bytes = zlib.decompress(base64.b64decode(packed))

    def whole(self, told):
        size, count, at = int(told["type"][1:]) // 8, told["count"], told["offset"]
        planes = [self.bytes[at + n * count : at + (n + 1) * count] for n in range(size)]
        return [int.from_bytes(bytes(parts), "little") for parts in zip(*planes, strict=True)]

    def times(self, told):
        found, total = [], 0
        for step in self.whole(told):
            total = total + step if told.get("delta") else step
            found.append(total)
        return found

    def numbers(self, told):
        import struct

        raw = self.whole(told)
        return [told["base"] + struct.unpack("<f", struct.pack("<I", one))[0] for one in raw]


def document_in(page):
    """Return document and arrays from a page's text, as a browser reads them."""
    text = page.read_text("utf-8")
    found = re.search(r'<script type="application/json" id="document">(.*?)</script>', text, re.S)
    packed = re.search(r'<script type="text/plain" id="packed">(.*?)</script>', text, re.S)
    return json.loads(found[1]), Arrays(packed[1])
