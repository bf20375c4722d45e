"""CPU time per frame of `motorhil record`, compared with python-can's loggers.

There are two kinds of traffic: twelve moving drives (as in bench_traces), and eight buses of 1
Mbit/s full of the shortest frames, 170,000 frames/s. Rounds of all candidates alternate, and the
best of each counts, so that other load on the machine affects all alike.
"""

import random
import socket
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import can
from can.interfaces.socketcan.socketcan import capture_message

from motorhil.harness.recording.socketcan import DatagramReader
from motorhil.harness.recording.writer import Pump, Series, opener
from motorhil.traces.mcap.chunk import Entry
from tests.benchmarks.bench_traces import FRAMES, by_python_can, traffic

ROUNDS = 7
FULL_FRAMES_S = 170_000
LOGGERS = ("csv", "log", "blf", "asc", "trc")
Figures = list[tuple[str, float, str]]


def moving_drives() -> list[Entry]:
    """Return frames of twelve drives on two buses."""
    return [(2 * (bus == "can1"), time_ns, frame) for bus, time_ns, _, frame in traffic()]


def full_buses() -> list[Entry]:
    """Return the shortest frames on eight full buses, with identifiers of 40 nodes each."""
    draw = random.Random("bench_record")
    pack = struct.Struct("<IB3x8s").pack
    step_ns = 10**9 / FULL_FRAMES_S
    return [
        (2 * (k % 8), round(k * step_ns), pack(0x180 + draw.randrange(40), 0, b""))
        for k in range(FRAMES)
    ]


def by_us(entries: list[Entry], round_frames: int, path: Path, compact: bool) -> None:
    """Record frames in portions as the loop delivers them: 3 ms, pump, file."""
    buses = [f"can{k}" for k in range(8)]
    series = Series(str(path), opener(buses, {}, compact), overwrite=True)
    pump = Pump(buses[:1], series)
    for start in range(0, len(entries), round_frames):
        pump.take([entries[start : start + round_frames]], 0)
    pump.close({})


def messages_of(entries: list[Entry]) -> list[can.Message]:
    """Return the same frames as python-can messages."""
    return [
        can.Message(
            timestamp=time_ns / 1e9,
            arbitration_id=int.from_bytes(frame[:4], "little"),
            is_extended_id=False,
            data=frame[8 : 8 + frame[4]],
            channel=f"can{source // 2}",
        )
        for source, time_ns, frame in entries
    ]


def best_us(candidates: dict[str, Callable[[], object]], frames: int) -> dict[str, float]:
    """Return the CPU time per frame [us] of each candidate, the best of alternating rounds."""
    best = dict.fromkeys(candidates, float("inf"))
    for _ in range(ROUNDS):
        for name, work in candidates.items():
            start = time.process_time()
            work()
            best[name] = min(best[name], time.process_time() - start)
    return {name: seconds / frames * 1e6 for name, seconds in best.items()}


def in_memory(kind: str, entries: list[Entry], round_frames: int, folder: Path) -> Figures:
    """Measure frames that are in memory already, in the form that each side needs."""
    messages = messages_of(entries)
    files = {name: folder / f"{kind}.{name}" for name in ("mcap", "compact", *LOGGERS)}

    def ours(name: str) -> Callable[[], None]:
        return lambda: by_us(entries, round_frames, files[name], compact=name == "compact")

    def theirs(name: str) -> Callable[[], None]:
        return lambda: by_python_can(messages, files[name])

    candidates = {name: ours(name) for name in ("mcap", "compact")}
    candidates |= {f"python-can {name}": theirs(name) for name in LOGGERS}
    cost = best_us(candidates, len(entries))
    figures = [(f"{kind}: {name}", us, "us CPU/frame") for name, us in cost.items()]
    peer = min(us for name, us in cost.items() if name.startswith("python-can"))
    blf = files["blf"].stat().st_size
    for name in ("mcap", "compact"):
        size = files[name].stat().st_size
        figures += [
            (f"{kind}: {name} against the fastest of python-can", cost[name] / peer, "of its CPU"),
            (f"{kind}: {name} against BLF", size / blf, "of its size"),
        ]
    return figures


def from_sockets(entries: list[Entry], folder: Path) -> Figures:
    """Measure frames from a socket with kernel time stamps into a file."""
    frames = [frame for _, _, frame in entries]
    cost = {name: float("inf") for name in ("mcap", "python-can csv")}
    for _ in range(ROUNDS // 2):
        for name in cost:
            reader = _from_socket_by_us if name == "mcap" else _from_socket_by_python_can
            cost[name] = min(cost[name], reader(frames, folder) / len(frames) * 1e6)
    ours, peer = cost.values()
    return [
        ("socket to file: mcap", ours, "us CPU/frame"),
        ("socket to file: python-can csv", peer, "us CPU/frame"),
        ("socket to file: mcap against python-can", ours / peer, "of its CPU"),
        (f"socket to file: {FULL_FRAMES_S} frames/s", ours * FULL_FRAMES_S / 1e4, "% of a core"),
    ]


def _filled(sender: socket.socket, frames: list[bytes], start: int) -> int:
    """Fill the socket; return the index of the next frame."""
    try:
        while start < len(frames):
            sender.send(frames[start])
            start += 1
    except BlockingIOError:
        pass
    return start


def _pair() -> tuple[socket.socket, socket.socket]:
    sender, receiver = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    sender.setblocking(False)
    return sender, receiver


def _from_socket_by_us(frames: list[bytes], folder: Path) -> float:
    """Return the CPU time [s] without the filling of the socket."""
    sender, receiver = _pair()
    spent, sent = 0.0, 0
    with sender, receiver:
        reader = DatagramReader(receiver)
        series = Series(str(folder / "socket.mcap"), opener(["can0"], {}, False), overwrite=True)
        pump = Pump(["can0"], series)
        while sent < len(frames):
            sent = _filled(sender, frames, sent)
            start = time.process_time()
            entries: list[Entry] = []
            while more := reader.read(0, 1, 0):
                entries += more
            pump.take([entries], 0)
            spent += time.process_time() - start
        start = time.process_time()
        pump.close({})
        return spent + time.process_time() - start


def _from_socket_by_python_can(frames: list[bytes], folder: Path) -> float:
    """Return the CPU time [s] of python-can's SocketCAN bus and its fastest logger."""
    sender, receiver = _pair()
    spent, sent = 0.0, 0
    with sender, receiver, can.Logger(str(folder / "socket.csv")) as logger:
        receiver.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        receiver.setblocking(False)
        while sent < len(frames):
            sent = _filled(sender, frames, sent)
            start = time.process_time()
            try:
                while True:
                    message = capture_message(receiver)
                    if message is not None:
                        logger.on_message_received(message)
            except can.CanOperationError:  # the socket is empty
                pass
            spent += time.process_time() - start
    return spent


def run() -> Figures:
    """Return the figures as (name, figure, unit)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drives, shortest = moving_drives(), full_buses()
        figures = in_memory("moving drives", drives, 24, folder)
        figures += in_memory("full buses", shortest, 510, folder)
        full_us = next(us for what, us, _ in figures if what == "full buses: mcap")
        share = full_us * FULL_FRAMES_S / 1e4
        figures.append((f"full buses, in memory: {FULL_FRAMES_S} frames/s", share, "% of a core"))
        return figures + from_sockets(shortest, folder)
