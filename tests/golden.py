"""The golden recordings: short runs of one rig of every kind of hardware, kept in traces/golden.

    make golden     makes them again, and their index, where the digest is another

A test holds that they are what the rigs do today, and replays each of them in all three ways.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.rig import Rig, installed_plugins
from harness.rig_file import RigDescription, parse_rig
from harness.settings import Source
from motorapi import ControlMode, Motor, MotorGroup, TrapezoidalTrajectory
from tests.architecture.checkout import CHECKOUT
from tests.motorapi.kinds import EVERY
from traces.digest import digest
from traces.reader import read_trace

FOLDER = CHECKOUT / "traces" / "golden"
INDEX = FOLDER / "INDEX.md"
LOAD_N_M = 20.0


def algorithms(rig: Rig) -> None:
    """The paper's two: a set-point and a profile, then two motors together."""
    left = rig.motors["left"]
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint(1.0)
    left.start()
    left.wait_until_done(timeout_s=5)
    group = MotorGroup(left, rig.motors["right"])
    group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
    group.set_trajectory(TrapezoidalTrajectory(-0.5), TrapezoidalTrajectory(1.0))
    group.start()
    group.wait_until_done(timeout_s=5)
    group.for_each(Motor.disable)


def overload(rig: Rig) -> None:
    """A load that the motor cannot hold: following error, fault, reset, and it moves again."""
    left = rig.motors["left"]
    left.enable()
    load(rig, LOAD_N_M)
    assert rig.runtime.wait_until(lambda: left.fault() is not None, 2.0)
    load(rig, 0.0)
    rig.runtime.run_for(0.5)
    left.reset_fault()
    left.set_control_mode(ControlMode.SETPOINT)
    left.set_setpoint(0.2)
    left.start()
    left.wait_until_done(timeout_s=5)
    left.disable()


def load(rig: Rig, torque_n_m: float) -> None:
    """The load changes; a recorded drive has its own story."""
    if rig.description.controllers["left"].kind != "recorded":
        rig.controllers["left"].stimulate("load_torque_n_m", torque_n_m)


def on_tcp(text: str) -> str:
    """The same drives behind a gateway."""
    line = 'kind = "modbus_rtu"\nbaud_bit_s = 115_200\nparity = "N"'
    assert line in text
    return text.replace(line, 'kind = "modbus_tcp"')


GOLDEN: dict[str, tuple[str, str, Callable[[Rig], None]]] = {
    "cia402": ("two CiA 402 drives", EVERY["cia402"].rig(), algorithms),
    "overload": ("a CiA 402 drive that loses its position", EVERY["cia402"].rig(), overload),
    "software": (
        "an I/O node with two channels, servo on the host",
        EVERY["software"].rig(),
        algorithms,
    ),
    "leadshine": ("two PR-mode drives on a serial line", EVERY["leadshine"].rig(), algorithms),
    "leadshine_tcp": ("the same behind a gateway", on_tcp(EVERY["leadshine"].rig()), algorithms),
    "oriental_az": ("two AZ drivers on a serial line", EVERY["oriental_az"].rig(), algorithms),
}
"""By name: what it is, the rig, the application."""


def described(name: str) -> RigDescription:
    """The rig of a golden recording."""
    return parse_rig(Source(Path(f"{name}.toml"), GOLDEN[name][1]), installed_plugins())


def record(name: str, path: Path) -> None:
    """What the rig does today is recorded."""
    with Rig(described(name), record=path) as rig:
        GOLDEN[name][2](rig)


@contextmanager
def golden(name: str) -> Iterator[Path]:
    """The file, which must be there."""
    path = FOLDER / f"{name}.mcap"
    assert path.is_file(), f"{path} is missing: make golden"
    yield path


def rows() -> Iterator[str]:
    """The index: a row a recording."""
    yield "# Golden recordings"
    yield "Made by `make golden` (tests/golden.py), each of one run in virtual time.\n"
    yield "| file | what | s | messages | digest |"
    yield "| --- | --- | --- | --- | --- |"
    for name, (what, _, _) in GOLDEN.items():
        path = FOLDER / f"{name}.mcap"
        with read_trace(path) as trace:
            count = sum(1 for _ in trace.messages())
            _, last_ns = trace.span_ns() or (0, 0)
        yield f"| {path.name} | {what} | {last_ns / 1e9:.3f} | {count} | `{digest(path)[:16]}` |"


def main() -> int:
    """Those whose digest is another are written anew."""
    FOLDER.mkdir(exist_ok=True)
    sys.argv = ["make", "golden"]  # what a recording says of its command line, on any machine
    for name in GOLDEN:
        path, fresh = FOLDER / f"{name}.mcap", FOLDER / f"{name}.new"
        record(name, fresh)
        same = path.is_file() and digest(path) == digest(fresh)
        if same:
            fresh.unlink()
        else:
            fresh.replace(path)
        print(f"{path.name}: {'as it was' if same else 'written'}, {path.stat().st_size} bytes")
    INDEX.write_text("\n".join(rows()) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
