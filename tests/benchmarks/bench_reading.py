"""CPU time per frame of reading, converting, showing and comparing recordings, with peers.

The frames are those of `bench_traces`. Times are CPU times of the process, the best of several.
"""

import contextlib
import io
import struct
import tempfile
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import can
from mcap.reader import make_reader

from motorhil.harness.cli.main import main as motorhil
from motorhil.harness.recording.conversion import convert
from motorhil.traces.can_frame import classic
from motorhil.traces.columns import read_can_arrays
from motorhil.traces.formats.blf import write_blf
from motorhil.traces.formats.frames import Findings, Frame
from motorhil.traces.formats.registry import open_source, record_frames
from motorhil.traces.schema import Direction
from tests.benchmarks.bench_traces import FRAMES, by_python_can, by_writer, cpu_us, entries, traffic

LAST_S = 1.0
SPANS = 20  # repetitions of the frames in the recording whose end is shown


def by_mcap_reader(path: Path, from_ns: int | None = None) -> int:
    """Count messages read by the stock reader, with payloads left packed."""
    with path.open("rb") as file:
        reader = make_reader(file)
        return sum(1 for _ in reader.iter_messages(start_time=from_ns, log_time_order=False))


def by_can_reader(path: Path) -> int:
    """Count messages read by python-can."""
    with can.LogReader(str(path)) as reader:
        return sum(1 for _ in reader)


def by_source(path: Path) -> int:
    """Count frames read by our reader, one by one."""
    return sum(1 for _ in open_source(path).frames(Findings()))


def by_our_blf(frames: list[Frame], path: Path) -> None:
    """Write a BLF file with our writer."""
    with path.open("wb") as file:
        write_blf(file, ["can0", "can1"], frames[0].time_ns, iter(frames))


def obey(*words: str) -> None:
    """Run a verb of the command line and discard its output."""
    with contextlib.redirect_stdout(io.StringIO()):
        motorhil([*words])


def mapped(source: Path, target: Path) -> None:
    """Copy a recording behind the SDO traffic that maps its PDOs, so that all are decoded."""
    maps = [
        Frame(0, f"can{drive % 2}", mapping, Direction.UNKNOWN, "")
        for drive in range(12)
        for mapping in _mappings(drive + 1)
    ]
    frames = chain(maps, open_source(source).frames(Findings()))
    record_frames(target, frames, {})


def _mappings(node: int) -> Iterator[bytes]:
    """Yield the SDO downloads, with answers, that map the node's PDOs as `traffic` uses them."""
    for index, objects in (
        (0x1A00, (0x60410010, 0x60640020)),
        (0x1600, (0x60400010, 0x607A0020)),
        (0x1A01, (0x606C0020, 0x606C0020)),
    ):
        rows = (*enumerate(objects, 1), (0, len(objects)))
        for subindex, value in rows:
            head = struct.pack("<HB", index, subindex)
            size = b"\x23" if subindex else b"\x2f"
            yield classic(0x600 + node, size + head + struct.pack("<I", value))
            yield classic(0x580 + node, b"\x60" + head + bytes(4))


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    told = traffic()
    senders, batch = entries(told)
    span_ns = told[-1][1] + 125_000
    messages = [
        can.Message(
            timestamp=1e9 + time_ns / 1e9,
            arbitration_id=int.from_bytes(frame[:4], "little"),
            is_extended_id=False,
            data=frame[8 : 8 + frame[4]],
            channel=int(bus[3:]),
        )
        for bus, time_ns, _, frame in told
    ]
    figures: list[tuple[str, float, str]] = []

    def add(name: str, work: Callable[[], object]) -> float:
        cost = cpu_us(work)
        figures.append((name, cost, "us CPU/frame"))
        return cost

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        ours, theirs = folder / "ours.mcap", folder / "theirs.blf"
        by_writer(senders, batch, ours)
        by_python_can(messages, theirs)
        arrays = add("reading into arrays", lambda: read_can_arrays(ours))
        stock = add("mcap's reader, payloads left packed", lambda: by_mcap_reader(ours))
        blf = add("python-can's BLFReader", lambda: by_can_reader(theirs))
        figures.append(("frames into arrays", 1 / arrays, "million/s of CPU"))
        figures.append(
            ("reading into arrays against mcap's reader", stock / arrays, "times faster")
        )
        figures.append(("reading into arrays against BLFReader", blf / arrays, "times faster"))
        story = folder / "mapped.mcap"
        mapped(ours, story)
        verbs = {"show": (str(story),), "diff": (str(story), str(story))}
        for verb, files in verbs.items():
            cost = add(f"{verb}, all PDOs mapped", lambda verb=verb: obey(verb, *verbs[verb]))
            ratio = cost / stock / len(files)
            figures.append((f"{verb} against mcap's reader, each file", ratio, "of its CPU"))
        frames = list(open_source(ours).frames(Findings()))
        own = add("writing BLF", lambda: by_our_blf(frames, folder / "a.blf"))
        peer = add("python-can's BLFWriter", lambda: by_python_can(messages, theirs))
        figures.append(("writing BLF against python-can", own / peer, "of its CPU"))
        ratio = (folder / "a.blf").stat().st_size / theirs.stat().st_size
        figures.append(("BLF file against python-can's", ratio, "of its size"))
        for kind, form in (("blf", "blf"), ("log", "candump"), ("trc", "trc"), ("asc", "asc")):
            path = folder / f"peer.{kind}"
            convert(ours, path, form, True)
            cost = cpu_us(lambda path=path: by_source(path))
            against = cpu_us(lambda path=path: by_can_reader(path))
            figures.append((f"reading {form} against python-can", cost / against, "of its CPU"))
        long = folder / "long.mcap"
        many = [(s, t + k * span_ns, f) for k in range(SPANS) for s, t, f in batch]
        by_writer(senders, many, long)
        size = long.stat().st_size / 1e6
        from_ns = SPANS * span_ns - int(LAST_S * 1e9)
        end = cpu_us(lambda: obey("show", str(long), "--last", str(LAST_S))) * FRAMES / 1e3
        mine = cpu_us(lambda: by_mcap_reader(long, from_ns)) * FRAMES / 1e3
        figures.append((f"showing the last second of {size:.0f} MB", end, "ms CPU"))
        figures.append((f"mcap's reader, the last second of {size:.0f} MB, packed", mine, "ms CPU"))
    return figures


if __name__ == "__main__":
    for name, figure, unit in run():
        print(f"{name:60s} {figure:10.3f} {unit}")
