"""CPU time per recorded frame, compared with peers in the same run.

The frames are those of twelve drives on two buses: SYNC, set-points, and two kinds of feedback of
moving motors. Times are CPU times of the whole process; each figure is the best of several.
"""

import random
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import can
from mcap.writer import IndexType, Writer

from motorhil.harness.recording.recorder import Recorder
from motorhil.traces.digest import digest
from motorhil.traces.mcap.chunk import Entry
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.writer import TraceWriter
from motorhil.traces.schema import CAN_FRAME, Direction, Schema, encode_can_frame

FRAMES = 100_000
ROUNDS = 3
Told = tuple[str, int, str, bytes]  # bus, time, sender, frame


def traffic() -> list[Told]:
    """Return frames, 8,000 per second, in the form in which a world delivers them."""
    draw = random.Random("bench_traces")
    frame = struct.Struct("<IB3x8s").pack
    position, velocity = [0] * 12, [0] * 12
    told: list[Told] = []
    for number in range(FRAMES):
        drive, kind = number % 12, number // 12 % 4
        bus, sender = f"can{drive % 2}", f"wheel_{drive}"
        if kind == 0:
            velocity[drive] += draw.randrange(-5, 6)
            position[drive] += velocity[drive]
            data = struct.pack("<Hi", 0x1637, position[drive])
            one = frame(0x181 + drive, len(data), data)
        elif kind == 1:
            data = struct.pack("<Hi", 0x1F, position[drive] + 13)
            sender, one = "host", frame(0x201 + drive, len(data), data)
        elif kind == 2:
            data = struct.pack("<ii", velocity[drive], velocity[drive] + draw.randrange(-3, 3))
            one = frame(0x281 + drive, len(data), data)
        else:
            sender, one = "host", frame(0x80, 0, b"")
        told.append((bus, number * 125_000 + draw.randrange(10) * 1000, sender, one))
    return told


def cpu_us(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Return the CPU time per frame [us], the best of `rounds`."""
    best = float("inf")
    for _ in range(rounds):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return best / FRAMES * 1e6


def by_recorder(told: list[Told], path: Path, compact: bool) -> None:
    """Record with everything: tap, packing, compression, file."""
    recorder = Recorder(
        TraceWriter(path, compact=compact), {f"wheel_{i}": "cia402" for i in range(12)}
    )
    on_frame = recorder.frame
    for bus, time_ns, sender, frame in told:
        on_frame(bus, time_ns, sender, frame)
    recorder.close()


def entries(told: list[Told]) -> tuple[list[tuple[str, str]], list[Entry]]:
    """Return (senders, entries) in the form in which the recorder passes them on."""
    senders: dict[tuple[str, str], int] = {}
    out: list[Entry] = []
    for bus, time_ns, sender, frame in told:
        number = senders.setdefault((bus, sender), len(senders))
        out.append((number, time_ns, frame))
    return list(senders), out


def by_writer(senders: list[tuple[str, str]], batch: list[Entry], path: Path) -> None:
    """Write with the writer alone, in batches of 4096 frames."""
    with TraceWriter(path) as writer:
        channels = {bus: writer.channel(f"/can/{bus}", Schema.of(CAN_FRAME)) for bus, _ in senders}
        for bus, sender in senders:
            writer.source(channels[bus], sender, Direction.RECEIVED)
        for start in range(0, len(batch), 4096):
            writer.extend(batch[start : start + 4096])


def by_mcap(told: list[Told], path: Path, index: IndexType, payloads: list[bytes]) -> None:
    """Write packed payloads with the stock writer."""
    with path.open("wb") as file:
        writer = Writer(file, index_types=index)
        writer.start()
        schema = Schema.of(CAN_FRAME)
        number = writer.register_schema(schema.name, schema.encoding, schema.data)
        channels = {
            f"can{i}": writer.register_channel(f"/can/{i}", "protobuf", number) for i in (0, 1)
        }
        for (bus, time_ns, _, _), payload in zip(told, payloads, strict=True):
            writer.add_message(channels[bus], time_ns, payload, time_ns)
        writer.finish()


def by_python_can(messages: list[can.Message], path: Path) -> None:
    """Write with python-can's loggers."""
    with can.Logger(str(path)) as logger:
        for message in messages:
            logger.on_message_received(message)


def read(path: Path) -> None:
    """Read all messages, one by one."""
    with read_trace(path) as trace:
        for _ in trace.messages():
            pass


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    told = traffic()
    senders, batch = entries(told)
    payloads = [encode_can_frame(f, s, Direction.RECEIVED) for _, _, s, f in told]
    messages = [
        can.Message(
            timestamp=time_ns / 1e9,
            arbitration_id=int.from_bytes(frame[:4], "little"),
            is_extended_id=False,
            data=frame[8 : 8 + frame[4]],
            channel=bus,
        )
        for bus, time_ns, _, frame in told
    ]
    figures: list[tuple[str, float, str]] = []
    with tempfile.TemporaryDirectory() as folder:
        ours, stock = Path(folder) / "ours.mcap", Path(folder) / "stock.mcap"

        def add(name: str, work: Callable[[], object], path: Path | None = None) -> float:
            cost = cpu_us(work)
            figures.append((name, cost, "us CPU/frame"))
            if path is not None:
                figures.append((f"{name}, file", path.stat().st_size / FRAMES, "B/frame"))
            return cost

        add("recorder, tap to file, compact", lambda: by_recorder(told, ours, True), ours)
        whole = add("recorder, tap to file", lambda: by_recorder(told, ours, False), ours)
        add("digest of a recording", lambda: digest(ours))
        add("reading a recording", lambda: read(ours))
        own = add("trace writer alone", lambda: by_writer(senders, batch, ours))
        no_index = IndexType.ALL & ~IndexType.MESSAGE
        peer = add(
            "mcap.Writer, payloads ready",
            lambda: by_mcap(told, stock, IndexType.ALL, payloads),
            stock,
        )
        add(
            "mcap.Writer without message index, payloads ready",
            lambda: by_mcap(told, stock, no_index, payloads),
            stock,
        )
        best = float("inf")
        for kind in ("csv", "log", "blf"):
            path = Path(folder) / f"peer.{kind}"
            best = min(
                best,
                add(f"python-can {kind}", lambda path=path: by_python_can(messages, path), path),
            )
    figures.append(("trace writer against mcap.Writer", peer / own, "times faster"))
    figures.append(("recorder against python-can's fastest logger", whole / best, "of its CPU"))
    return figures


if __name__ == "__main__":
    for name, figure, unit in run():
        print(f"{name:55s} {figure:10.3f} {unit}")
