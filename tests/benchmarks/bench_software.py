"""Central servo: twelve moving motors whose loops are closed on the host.

In every cycle a motor costs two messages (count and output), exact frames on the bus, a trajectory
sample, a PID step, and the plant. Times are CPU times of one thread. Figures grow with the number
of motors and the rate.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.trajectory import TrapezoidalTrajectory
from tests.support.motors.software_rigs import motor, node

ROUNDS = 3
SECONDS = 2.0
BUS = "[bus.can{n}]\nbitrate_bit_s = 1_000_000\n"


def _text(buses: int, cycle_ms: float) -> str:
    """Return a rig of twelve motors: three nodes with four channels, or four with three."""
    parts = ['[rig]\nname = "central"\n', *(BUS.format(n=n) for n in range(buses))]
    nodes, channels = (3, 4) if buses == 1 else (4, 3)
    for number in range(nodes):
        where = f"can{number * buses // nodes}"
        name = f"io{number}"
        parts.append(node(name, number + 1, channels).replace('"can0"', f'"{where}"'))
        for channel in range(1, channels + 1):
            settings = f"cycle_ms = {cycle_ms}"
            bandwidth = 60.0 / cycle_ms
            parts.append(
                motor(f"{name}_{channel}", name, channel, motor=settings, bandwidth=bandwidth)
            )
    return "".join(parts)


def _run(buses: int, cycle_ms: float) -> tuple[float, float, int]:
    """Return (real-time factor, load of the first bus, cycles missed) while all motors move."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rig.toml"
        path.write_text(_text(buses, cycle_ms))
        with Rig.open(path) as rig:
            group = MotorGroup(*rig.motors.values())
            group.for_each(Motor.enable)
            group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
            best = 0.0
            for round_ in range(ROUNDS):
                way = 5.0 if round_ % 2 == 0 else -5.0  # rad, 1.97 s at most
                group.set_trajectory(*(TrapezoidalTrajectory(way) for _ in group))
                group.start()
                begin_ns = rig.runtime.now_ns()
                begun = time.process_time()
                rig.runtime.run_for(SECONDS - 0.1)
                best = max(best, (SECONDS - 0.1) / (time.process_time() - begun))
                load = rig.world.bus("can0").statistics.load(begin_ns, rig.runtime.now_ns())
                group.wait_until_done(5)
            missed = sum(chosen.hardware.report().missed for chosen in group)
            return best, load, missed


def run() -> list[tuple[str, float, str]]:
    """Return the figures as (name, figure, unit)."""
    figures: list[tuple[str, float, str]] = []
    for buses, cycle_ms, what in ((1, 2.0, "500 Hz, one bus"), (2, 1.0, "1 kHz, two buses")):
        factor, load, missed = _run(buses, cycle_ms)
        figures += [
            (f"12 servos on the host at {what}: times real time, CPU", factor, "x"),
            (f"12 servos on the host at {what}: load of a bus", 100 * load, "%"),
            (f"12 servos on the host at {what}: cycles missed", float(missed), ""),
        ]
    return figures
