"""Costs of making a report page, and of opening it in Chromium.

The recording has a million frames of twelve drives on two buses with moving motors, and their PDO
mappings. The peer is mcap's own reader, which only reads them, in the same run.
"""

import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader

from motorhil.harness.cli.main import main
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema, encode_can_frame
from tests.benchmarks.bench_traces import traffic
from tests.support.browser import Browser, chromium

FRAMES = 1_000_000
PERIOD_NS = 125_000
# TPDO 1 and RPDO 1 of each drive: 6041h and 6064h, 6040h and 607Ah; TPDO 2: 606Ch and 606Bh.
MAPPINGS = {
    0x1A00: (0x60410010, 0x60640020),
    0x1600: (0x60400010, 0x607A0020),
    0x1A01: (0x606C0020, 0x606B0020),
}


def run():
    """Yield the figures as (name, figure, unit)."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        recording, page = Path(folder) / "million.mcap", Path(folder) / "million.html"
        write(recording)
        begun_s = time.process_time()
        read_by_mcap(recording)
        peer_s = time.process_time() - begun_s
        begun_s = time.process_time()
        if main(["report", str(recording), "-o", str(page)]):
            raise SystemExit("the page was not made")
        made_s = time.process_time() - begun_s
        yield "page of 1e6 frames, CPU a frame", made_s / FRAMES * 1e6, "us"
        yield "  as a multiple of mcap's reader reading them", made_s / peer_s, "x"
        yield "  its size", page.stat().st_size / 1e6, "MB"
        size = recording.stat().st_size / 1e6
        yield "  the recording's", size, "MB"
        yield "page, CPU a MB of the recording", made_s / size, "s"
        for verb, words in (("judge", []), ("convert", ["-o", str(Path(folder) / "a.blf")])):
            begun_s = time.process_time()
            main([verb, str(recording), *words])
            yield f"{verb}, CPU a MB of the recording", (time.process_time() - begun_s) / size, "s"
        if chromium() is not None:
            yield from opened(Path(folder), page)


def opened(folder, page):
    """Measure how long the page takes to load and to redraw, by the page's own clock."""
    with Browser(folder / "profile") as browser:
        browser.open(page)
        if browser.errors:
            raise SystemExit(browser.errors)
        load = "Number(document.documentElement.dataset.loadMs)"
        yield "  in Chromium: from the page's text to all of it drawn", browser.run(load), "ms"
        drawn = "Number(document.documentElement.dataset.drawMs)"
        for name, part in (("a tenth of it", 0.1), ("a thousandth", 0.001)):
            browser.run(f"setRange(SPAN * 0.4, SPAN * (0.4 + {part})); 0")
            browser.settle()
            yield f"  what is in sight drawn anew, {name}", browser.run(drawn), "ms"
        browser.run("whole_range(); 0")
        browser.settle()
        yield "  what is in sight drawn anew, the whole", browser.run(drawn), "ms"
        browser.run("paint(true)")
        browser.run("redraw(true)")
        yield "  every panel drawn anew, the whole", browser.run(drawn), "ms"


def write(path):
    """Write the traffic of `bench_traces` ten times, after its PDO mappings."""
    told = traffic()
    with TraceWriter(path) as writer:
        channels = {
            name: writer.channel(f"/can/{name}", Schema.of(CAN_FRAME)) for name in ("can0", "can1")
        }
        sources = {}
        for drive in range(12):
            bus = f"can{drive % 2}"
            for entry in mappings(drive + 1):
                writer.write(
                    channels[bus], 0, encode_can_frame(entry, "host", Direction.TRANSMITTED)
                )
        for turn in range(FRAMES // len(told)):
            batch = []
            for bus, time_ns, sender, frame in told:
                key = (bus, sender)
                if key not in sources:
                    sources[key] = writer.source(channels[bus], sender, Direction.RECEIVED)
                at_ns = time_ns + turn * len(told) * PERIOD_NS
                batch.append((sources[key], at_ns, frame))
            writer.extend(batch)


def mappings(node):
    """Yield the SDO downloads that map a drive's PDOs, and their responses."""
    for index, entries in MAPPINGS.items():
        values = [
            (0, 0),
            *((sub, value) for sub, value in enumerate(entries, 1)),
            (0, len(entries)),
        ]
        for sub, value in values:
            head = bytes((0x23, index & 0xFF, index >> 8, sub)) + value.to_bytes(4, "little")
            yield can_frame(0x600 + node, head)
            yield can_frame(0x580 + node, bytes((0x60, index & 0xFF, index >> 8, sub, 0, 0, 0, 0)))


def can_frame(identifier, data):
    """Return a Linux can_frame."""
    return identifier.to_bytes(4, "little") + bytes((len(data), 0, 0, 0)) + data.ljust(8, b"\0")


def read_by_mcap(path):
    """Read all messages with the stock reader."""
    with path.open("rb") as file:
        for _ in make_reader(file).iter_messages(log_time_order=False):
            pass
