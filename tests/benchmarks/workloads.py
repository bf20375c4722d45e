"""Workloads of `bench_system`, run in processes of their own, pure and compiled.

    python -P tests/benchmarks/workloads.py NAME

prints one line per figure: name, tab, figure, tab, unit. It imports only the project, so that it
measures the motorhil of the Python that runs it. Times are CPU times, the best of several runs,
because other load only adds time.
"""

import gc
import math
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

MS = 1_000_000
PERIOD_S = 0.001
CYCLES = 2_000
ROUNDS = 3
SETPOINT = struct.Struct("<IB3xHi2x")
SYNC = struct.pack("<IB3x8x", 0x080, 0)
BUS_FRAMES = 5_000
FAR_POINT_M = (1_000.0, 100.0, 0.5)
BUS_ROUNDS = 15
TARGETS = [round(8_000 - 8_000 * math.cos(2 * math.pi * k / 1_000)) for k in range(1_000)]

Figures = list[tuple[str, float, str]]


def best(action: Callable[[], float], rounds: int = ROUNDS) -> float:
    """Return the least CPU time [s] that `action` returns."""
    return min(action() for _ in range(rounds))


# --- the demo


def demo() -> Figures:
    """Measure the rover manoeuvre: open the rig, drive, record, close."""
    imported = time.process_time()
    from motorhil.harness.cli.demo import POINT_M, RIG
    from motorhil.harness.examples.rover import Rover, manoeuvre
    from motorhil.harness.rig.rig import Rig

    with TemporaryDirectory() as folder:
        frames = simulated_s = 0.0

        def drive(record: Path | None) -> float:
            nonlocal frames, simulated_s
            begun = time.process_time()
            with Rig.open(RIG, record=record) as rig:
                rover = Rover(rig.groups["wheels"], rig.groups["steering"], rig.groups["mast"])
                manoeuvre(rover, rig.runtime, POINT_M, lambda text: None)
                simulated_s = rig.runtime.now_ns() / 1e9
            frames = sum(rig.world.bus(name).statistics.frames for name in rig.world.bus_names())
            return time.process_time() - begun

        first = drive(Path(folder) / "demo.mcap")
        whole = time.process_time() - imported
        rounds = [
            (drive(Path(folder) / "demo.mcap"), drive(None)) for _ in range(2 * ROUNDS)
        ]  # alternately, so that both meet the same disturbances
    recorded, silent = min(r for r, _ in rounds), min(s for _, s in rounds)
    return [
        ("demo, recorded", simulated_s / recorded, "x real time"),
        ("demo, recorded, for the first time in a process", simulated_s / first, "x real time"),
        ("demo, with start-up and imports of the process", simulated_s / whole, "x real time"),
        ("demo, not recorded", simulated_s / silent, "x real time"),
        ("recording, all channels, per frame on the bus", (recorded - silent) / frames * 1e6, "us"),
        ("demo, CPU per frame on the bus", recorded / frames * 1e6, "us"),
    ]


# --- a long run that repeats nothing


def long(simulated_s: float = 600.0) -> Figures:
    """Measure the rover on ever new legs, recorded, in one process, imports not counted."""
    from motorhil.harness.cli.demo import RIG
    from motorhil.harness.examples.rover import Rover
    from motorhil.harness.examples.rover_kinematics import Leg
    from motorhil.harness.rig.rig import Rig

    draw = Random("long run")

    def new_legs() -> list[Leg]:
        sign = draw.choice((-1, 1))
        arc = Leg.arc(draw.uniform(0.8, 2.5), sign * draw.uniform(0.3, 1.2))
        crab = Leg.crab(draw.uniform(0.3, 1.0), draw.uniform(-0.9, 0.9))
        return [arc, crab, Leg.turn(-sign * draw.uniform(0.3, 1.2))]

    with TemporaryDirectory() as folder:
        begun = time.process_time()
        with Rig.open(RIG, record=Path(folder) / "long.mcap") as rig:
            runtime = rig.runtime
            rover = Rover(rig.groups["wheels"], rig.groups["steering"], rig.groups["mast"])
            rover.switch_on()
            arrived = False
            looking = runtime.spawn(
                "mast", lambda: rover.keep_looking(runtime, FAR_POINT_M, lambda: arrived)
            )
            legs = 0
            while runtime.now_ns() < simulated_s * 1e9:
                for leg in new_legs():
                    rover.drive(leg)
                    legs += 1
            arrived = True
            looking.join()
            assert looking.error is None, looking.error
            rover.switch_off()
            simulated_s = runtime.now_ns() / 1e9
        spent = time.process_time() - begun
        frames = sum(rig.world.bus(name).statistics.frames for name in rig.world.bus_names())
        size = (Path(folder) / "long.mcap").stat().st_size
    return [
        ("rover on ever new legs, recorded", simulated_s / spent, "x real time"),
        ("rover on ever new legs, CPU per frame on the bus", spent / frames * 1e6, "us"),
        ("rover on ever new legs: legs", legs, ""),
        ("rover on ever new legs: bytes a frame in the record", size / frames, "B"),
    ]


# --- short rigs, as a suite of tests has them


def suite(rigs: int = 50) -> Figures:
    """Measure the rigs of a suite: each is opened, moves two wheels, and is closed."""
    from motorhil.harness import examples
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory

    path = Path(examples.__file__).parent / "two_wheels.toml"
    draw = Random("suite")

    def one() -> None:
        with Rig.open(path) as rig:
            both = rig.groups["both"]
            both.for_each(Motor.enable)
            both.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
            both.set_trajectory(*(TrapezoidalTrajectory(draw.uniform(-3.0, 3.0)) for _ in "12"))
            both.start()
            both.wait_until_done(10.0)
            both.for_each(Motor.disable)

    begun = time.process_time()
    one()
    first = time.process_time() - begun
    begun = time.process_time()
    for _ in range(rigs):
        one()
    spent = time.process_time() - begun
    return [
        ("a short rig of two wheels, opened, moved, closed", spent / rigs * 1e3, "ms"),
        ("the first of them in a process", first * 1e3, "ms"),
    ]


# --- growth with the number of drives


def _controllers(drives: int, each_bus: int, keys: str = "") -> list[str]:
    """Return the lines of drives d1, d2, ..., so many on each bus, each with these keys."""
    lines: list[str] = []
    for number in range(drives):
        bus, place = divmod(number, each_bus)
        if place == 0:
            lines += [f"[bus.can{bus}]", "bitrate_bit_s = 1_000_000"]
        lines += [f"[controller.d{number + 1}]", 'kind = "cia402"', f'bus = "can{bus}"']
        lines += [f"node_id = {place + 1}", 'plant = { preset = "wheel_60w" }', keys]
    return lines


def _rig(folder: str, lines: list[str]) -> Path:
    """Write a rig with these lines."""
    path = Path(folder) / "rig.toml"
    path.write_text("\n".join(['rig = { name = "rig" }', *lines]) + "\n")
    return path


def _motors(drives: int) -> list[str]:
    """Return the lines of a motor for each drive, all in one group."""
    from motorhil.harness import examples

    model = Path(examples.__file__).parent / "wheel_model.toml"
    names = [f"d{number + 1}" for number in range(drives)]
    lines = ["[group.all]", f"motors = {names}"]
    for name in names:
        lines += [f"[motor.{name}]", "adaptation = 'cia402'", f"controller = '{name}'"]
        lines += [f"model = '{model}'"]
    return lines


def _per_drive_ms(drives: int, simulated_s: float = 4.0) -> float:
    """Return the CPU time [ms] for a drive and a simulated second, while all go there and back."""
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory

    lines = [*_controllers(drives, 10), *_motors(drives)]
    with TemporaryDirectory() as folder, Rig.open(_rig(folder, lines)) as rig:
        group, runtime = rig.groups["all"], rig.runtime
        group.for_each(Motor.enable)
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        gc.collect()
        begun_ns, begun = runtime.now_ns(), time.process_time()
        sign = 1.0
        while runtime.now_ns() - begun_ns < simulated_s * 1e9:
            group.set_trajectory(*(TrapezoidalTrajectory(sign * 2.0) for _ in range(drives)))
            group.start()
            group.wait_until_done(10.0)
            sign = -sign
        spent = time.process_time() - begun
        return spent / drives / (runtime.now_ns() - begun_ns) * 1e12


def drives() -> Figures:
    """Measure the cost of a moving drive among 1, 10 and 100."""
    counts = (1, 10, 100)
    costs = {count: best(lambda count=count: _per_drive_ms(count)) for count in counts}
    return [
        *(
            (f"a moving drive of {count}, CPU for a simulated second", cost, "ms")
            for count, cost in costs.items()
        ),
        ("a moving drive of 100 against one of 10", costs[100] / costs[10], "x"),
    ]


# --- cyclic synchronous position


def _enabled(rig, drives: int, **options):  # type: ignore[no-untyped-def]
    """Return the hardware objects of all enabled drives; TPDO 1 (6041h, 6064h) is of type 1."""
    from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
    from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor

    bus = rig.bus("can0")
    hardware = []
    for node in range(1, drives + 1):
        hw = Cia402HwMotor(bus, node, options=HwOptions(**options))
        hw.enable()
        cob_id = hw.read(0x1800, 1, "u32")
        hw.write(0x1800, cob_id | 1 << 31, 1, "u32")
        hw.write(0x1800, 1, 2, "u8")
        hw.write(0x1800, cob_id, 1, "u32")
        hardware.append(hw)
    return hardware


def _stream(drives: int) -> tuple[float, int, float, str]:
    """Stream CYCLES set-points; return (CPU [s], late set-points, bus load, message)."""
    from motorhil.harness.rig.rig import Rig

    with (
        TemporaryDirectory() as folder,
        Rig.open(_rig(folder, _controllers(drives, drives))) as rig,
    ):
        told: list[str] = []
        rig.world.tap_events(lambda time_ns, level, name, text: told.append(text))
        hardware = _enabled(rig, drives)
        starts = [hw.position_inc for hw in hardware]
        begins = [0] * drives

        def target(place: int, cycle: int) -> int:
            return starts[place] + TARGETS[(cycle - begins[place]) % 1_000]

        streams = [
            hw.stream_positions(PERIOD_S, lambda cycle, place=place: target(place, cycle))
            for place, hw in enumerate(hardware)
        ]
        rig.runtime.run_for(0.05)
        begun_ns, begun = rig.runtime.now_ns(), time.process_time()
        rig.runtime.run_for(CYCLES * PERIOD_S)
        spent = time.process_time() - begun
        load = rig.world.bus("can0").statistics.load(begun_ns, rig.runtime.now_ns())
        late = sum(stream.late for stream in streams)
        told += [str(stream.error) for stream in streams if stream.error is not None]
        for stream in streams:
            stream.cancel()
        for hw in hardware:
            hw.close()
    return spent, late, load, next((text for text in told if "left the bus" in text), "")


def _bare(drives: int) -> float:
    """Return the CPU time [s] of CYCLES for a host that only packs and unpacks its frames."""
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi.adaptations.cia402.objects import Mode

    with (
        TemporaryDirectory() as folder,
        Rig.open(_rig(folder, _controllers(drives, drives))) as rig,
    ):
        hardware = _enabled(rig, drives, heartbeat_ms=0, connection_loss=None)
        for hw in hardware:
            hw.set_mode(Mode.CYCLIC_SYNC_POSITION)
        starts = [hw.position_inc for hw in hardware]
        for hw in hardware:
            hw.close()
        bus, runtime = rig.bus("can0"), rig.runtime
        heard = 0
        cycle = 0

        def on_frame(frame: bytes, time_ns: int, transmitted: bool) -> None:
            nonlocal heard
            if not transmitted and frame[9:10]:
                heard += 1

        def send() -> None:
            nonlocal cycle
            runtime.send(bus, SYNC)
            step = TARGETS[cycle % 1_000]
            cycle += 1
            for node, start in enumerate(starts, start=1):
                runtime.send(bus, SETPOINT.pack(0x300 + node, 6, 15, start + step))

        runtime.listen(bus, on_frame)
        runtime.every(PERIOD_S, send)
        runtime.run_for(0.05)
        heard = 0
        begun = time.process_time()
        runtime.run_for(CYCLES * PERIOD_S)
        spent = time.process_time() - begun
        positions = [rig.controllers[f"d{node}"].snapshot() for node in range(1, drives + 1)]
        assert heard == drives * CYCLES, heard
        assert all(truth["state"] == positions[0]["state"] for truth in positions)
    return spent


def csp() -> Figures:
    """Measure drives in csp at 1 kHz on one bus of 1 Mbit/s."""
    simulated_s = CYCLES * PERIOD_S
    streams = [_stream(4) for _ in range(ROUNDS)]
    stream_s = min(spent for spent, _, _, _ in streams)
    _, late, load, told = streams[0]
    _, late_six, load_six, told_six = _stream(6)
    bare_s = best(lambda: _bare(4))
    assert not told, told
    assert told_six
    return [
        ("csp, 4 drives at 1 kHz, by the motor interface", simulated_s / stream_s, "x real time"),
        ("csp, 4 drives at 1 kHz, bare host", simulated_s / bare_s, "x real time"),
        ("csp, 4 drives: load of the bus", load * 100, "%"),
        ("csp, 4 drives: set-points that came late", late, ""),
        ("csp, 6 drives: load of the bus", load_six * 100, "%"),
        (f"csp, 6 drives: late set-points ({told_six})", late_six, ""),
    ]


# --- rest


def _rest(folder: str, heartbeat_ms: int) -> float:
    """Return the CPU time [s] of an hour at rest."""
    from motorhil.harness.rig.rig import Rig

    heartbeats = f'objects = {{ "1017h" = {heartbeat_ms} }}' if heartbeat_ms else ""
    path = _rig(folder, _controllers(100, 100, heartbeats))
    with Rig.open(path) as rig:
        gc.collect()  # garbage of the construction
        begun = time.process_time()
        rig.runtime.run_for(3_600.0)
        frames = rig.world.bus("can0").statistics.frames
        assert frames == 100 if not heartbeat_ms else frames > 350_000, frames
        return time.process_time() - begun


def rest() -> Figures:
    """Measure a rig of 100 drives for an hour with the power stage off."""
    with TemporaryDirectory() as folder:
        return [
            ("100 resting drives, 1 h, no heartbeats, CPU", _rest(folder, 0), "s"),
            ("100 resting drives, 1 h, heartbeats of 1 s, CPU", _rest(folder, 1_000), "s"),
        ]


# --- the bus alone


def bus_traffic() -> list[bytes]:
    """Return different TPDOs of 14 nodes with 8 bytes of data."""
    from motorhil.emulators.can.frame import pack

    draw = Random("bench_media")
    return [pack(0x181 + number % 14, draw.randbytes(8)) for number in range(BUS_FRAMES)]


def best_us(work: Callable[[], None]) -> float:
    """Return the fastest of several rounds over `bus_traffic`, per frame [us]."""

    def once() -> float:
        begun = time.process_time()
        work()
        return time.process_time() - begun

    return best(once, BUS_ROUNDS) / BUS_FRAMES * 1e6


def one_by_one(bus, frames: list[bytes]) -> None:  # type: ignore[no-untyped-def]
    """Submit each frame when the one before has been transmitted."""
    port = bus.attach("node")
    bus.attach("host")
    now_ns = 0
    for frame in frames:
        bus.submit(port, frame, now_ns)
        now_ns = _all_gone(bus, now_ns) + 10_000


def _all_at_once(bus, frames: list[bytes]) -> None:  # type: ignore[no-untyped-def]
    """Let 14 nodes answer at the same time, as to a SYNC."""
    for number in range(14):
        bus.attach(f"node {number}")
    now_ns = 0
    for first in range(0, len(frames), 14):
        for port, frame in enumerate(frames[first : first + 14]):
            bus.submit(port, frame, now_ns)
        now_ns = _all_gone(bus, now_ns)


def _all_gone(bus, now_ns: int) -> int:  # type: ignore[no-untyped-def]
    """Run until all frames are transmitted; return the time [ns]."""
    due_ns = bus.next_deadline_ns()
    while due_ns is not None:
        now_ns = due_ns
        bus.expire(now_ns)
        due_ns = bus.next_deadline_ns()
    return now_ns


def bus() -> Figures:
    """Measure frames through the CAN bus without a world."""
    from motorhil.emulators.can.bus.bus import CanBus
    from motorhil.emulators.can.frame_length import frame_bits

    frames = bus_traffic()
    return [
        ("CAN frame length, 8 bytes", best_us(lambda: [*map(frame_bits, frames)].clear()), "us"),
        ("CAN bus: submit to expire", best_us(lambda: one_by_one(CanBus("can0"), frames)), "us"),
        ("CAN bus: of 14 at once", best_us(lambda: _all_at_once(CanBus("can0"), frames)), "us"),
    ]


# --- the conformance kit


def kit() -> Figures:
    """Measure all clauses of the kit on the bench of cia402, without imports."""
    from motorhil.harness.conformance.claims import Claims
    from motorhil.harness.conformance.job import Job
    from motorhil.harness.conformance.kit import all_clauses
    from motorhil.harness.conformance.run import run_clause
    from motorhil.harness.conformance.target import Target

    target = Target(Job("cia402"))
    clauses = all_clauses().values()
    gc.freeze()  # as the kit's worker does
    begun = time.process_time()
    claims = Claims(target.opener())
    for clause in clauses:
        verdict = run_clause(clause, target.opener(None), claims, target.home)
        assert verdict.result.name in ("PASSED", "NOT_APPLICABLE"), verdict
    spent = time.process_time() - begun
    return [("conformance kit, cia402, CPU", spent, "s")]


WORKLOADS = {
    **{"demo": demo, "long": long, "suite": suite, "drives": drives, "csp": csp, "rest": rest},
    **{"bus": bus, "kit": kit},
}

if __name__ == "__main__":
    for name, figure, unit in WORKLOADS[sys.argv[1]]():
        print(f"{name}\t{figure}\t{unit}")
