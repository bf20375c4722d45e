"""Random programs in virtual time: parties of one process, or programs that share a clock.

A program of the second kind is a thread here, with a connection of its own: it has all of a
program in another process but the process.
"""

import json
import socket
import threading
from functools import partial
from random import Random

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.frame import pack as pack_frame
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.remote_runtime import RemoteLink, RemoteRuntime
from motorhil.harness.shared_time.remote_world import RemotePort, RemoteWorld
from motorhil.harness.shared_time.shared_clock import SharedClock
from motorhil.harness.virtual_time.runtime import VirtualRuntime

ECHOED = 0x400
"""Frames with lower identifiers are answered by each program, with this number added."""


class PortBus:
    """A bus object of a program: listeners, and a queue of received identifiers."""

    def __init__(self, world):
        self.listeners = []
        self.received = []
        self.port = world.add_host("can0", "host", self._hear, self._hear)

    def _hear(self, frame, time_ns, transmitted):
        for listener in self.listeners:
            listener(frame, time_ns, transmitted)

    def subscribe(self, listener, fd=False):
        self.listeners.append(listener)

    def transmit(self, frame):
        self.port.send(frame)


def steps(random, depth=0):
    """Return the steps of a random program."""
    made = []
    for _ in range(random.randint(2, 8)):
        kinds = ("wait", "sleep", "send", "send", "receive", "every", "poll", "spawn")
        kind = random.choice(kinds if depth < 2 else kinds[:-1])
        if kind == "spawn":
            made.append((kind, steps(random, depth + 1)))
        elif kind == "every":
            made.append((kind, random.choice((1e-4, 3e-4, 1e-3)), random.randint(1, 4)))
        else:
            made.append((kind, random.choice((0.0, 1e-4, 5e-4, 1e-3)), random.randrange(0x80)))
    return made


def act(runtime, bus, name, program, log):
    """Run a program; `log` gets what it saw."""
    spawned = []
    for kind, *facts in program:
        match kind:
            case "wait":
                runtime.wait_until(lambda: False, facts[0])
            case "sleep":
                runtime.run_for(facts[0])
            case "send":
                runtime.send(bus, pack_frame(facts[1], bytes([len(log) & 0xFF])))
            case "receive":
                if facts[1] % 2:
                    bus.received.clear()
                got = runtime.wait_until(lambda: bool(bus.received), facts[0])
                log.append((name, runtime.now_ns(), bus.received.pop(0) if got else None))
            case "every":
                _repeat(runtime, bus, *facts)
            case "spawn":
                work = partial(act, runtime, bus, name, facts[0], log)
                spawned.append(runtime.spawn(f"{name}.", work))
            case "poll":
                runtime.wait_until(lambda: False, 0.0)
        log.append((name, runtime.now_ns(), kind))
    for party in spawned:
        party.join()
    runtime.wait_until(lambda: False, 0.01)  # its periods have ended


def _repeat(runtime, bus, period_s, count):
    left = [count]

    def expire():
        left[0] -= 1
        runtime.send(bus, pack_frame(0x700 + left[0], b""))
        if not left[0]:
            period.cancel()

    period = runtime.every(period_s, expire)


def begin(runtime, world, name, program, log):
    """Open the bus, answer what is heard, and run the program.

    A program whose first step sleeps only keeps what it hears, and one whose last step does, only
    what others send. The rig is told so where it can be.
    """
    bus = PortBus(world)
    keeps, own = program[0][0] == "sleep", program[-1][0] != "sleep"

    def hear(frame, time_ns, transmitted):
        can_id = int.from_bytes(frame[:2], "little")
        if own or not transmitted:
            bus.received.append((can_id, time_ns, transmitted))
        if can_id < ECHOED and not transmitted and not keeps:
            runtime.send(bus, pack_frame(can_id + ECHOED, frame[8:9]))

    runtime.listen(bus, hear)
    if isinstance(bus.port, RemotePort):
        bus.port.note_use(keeps=keeps, own=own)
    act(runtime, bus, name, program, log)


def new_world():
    """Return a world with a bus, its runtime, and the list of frames on the bus."""
    queue = EventQueue()
    world = World(queue)
    world.add_bus(CanBus("can0", 500_000, FaultPlan([], Random(1).random)))
    world.add_silent("can0", "listener")  # acknowledges
    frames = []
    world.tap_frames(lambda *told: frames.append(told))
    return world, VirtualRuntime(queue), frames


def in_one_process(programs):
    """Run the programs as parties; return the frames of the bus and what each program saw."""
    world, runtime, frames = new_world()
    logs = {name: [] for name in programs}
    parties = [
        runtime.spawn(name, lambda n=name, p=own: begin(runtime, world, n, p, logs[n]))
        for name, own in programs.items()
    ]
    for party in parties:
        party.join()
    runtime.close()
    return frames, logs


def guest(path, name, body):
    """Join as a program, run `body(runtime, world)` and leave."""
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(str(path))
    link = RemoteLink(connection)
    link.send(records.numbered(records.JOIN, records.VERSION, name))
    head = link.receive()
    _, _, now_ns, _ = records.WELCOMED.unpack_from(head)
    runtime = RemoteRuntime(link, now_ns)
    world = RemoteWorld(json.loads(head[records.WELCOMED.size :]), {}, link, runtime)
    runtime.begin()
    try:
        body(runtime, world)
    finally:
        runtime.close()
        link.close()


def shared_clock(world, runtime, path, told, stalls_s):
    """Return a clock that appends what it tells to `told`, and can end nothing."""
    return SharedClock(
        *(world, runtime, path),
        seed=1,
        tell=lambda *words: told.append(words),
        stalls_s=stalls_s,
        end=lambda name: None,
        await_end=lambda name: None,
    )


def with_shared_clock(programs, path, names=None):
    """Run the programs with connections of their own; return as `in_one_process`."""
    world, runtime, frames = new_world()
    logs = {name: [] for name in programs}
    clock = shared_clock(world, runtime, path, [], dict.fromkeys(programs, 60.0))
    threads = [
        threading.Thread(
            target=guest,
            args=(path, name, lambda r, w, n=name: begin(r, w, n, programs[n], logs[n])),
        )
        for name in names or programs
    ]
    try:
        for thread in threads:
            thread.start()
        clock.await_programs(list(programs), lambda name: True)
        runtime.wait_for_parties(clock.are_gone)
        for thread in threads:
            thread.join()
    finally:
        clock.close()
        runtime.close()
    return frames, logs
