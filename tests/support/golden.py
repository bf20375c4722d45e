"""Golden recordings: short runs of every kind of hardware, in traces/golden.

    make golden     records them again, and updates the index, if a digest differs

A test compares them with the present rigs, and replays each of them in all three ways.
"""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from motorhil.harness.rig.config.rig_file import RigDescription, parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, Motor, MotorGroup, TrapezoidalTrajectory
from motorhil.traces.digest import digest
from motorhil.traces.mcap.reader import read_trace
from tests.support.checkout import CHECKOUT
from tests.support.kit_benches import RIGS
from tests.support.motors.kinds import EVERY

FOLDER = CHECKOUT / "traces" / "golden"
INDEX = FOLDER / "INDEX.md"
LOAD_N_M = 20.0


def algorithms(rig: Rig) -> None:
    """Run the paper's two algorithms: set-point and profile, then two motors together."""
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
    """Overload a motor: following error, fault, reset, and a further move."""
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
    """Change the load; a recorded drive ignores it."""
    if rig.description.controllers["left"].kind != "recorded":
        rig.controllers["left"].stimulate("load_torque_n_m", torque_n_m)


def on_tcp(text: str) -> str:
    """Return the rig with the same drives behind a gateway."""
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
    "dryve": ("two igus dryve D1", (RIGS / "dryve.toml").read_text(), algorithms),
    "leadshine": ("two PR-mode drives on a serial line", EVERY["leadshine"].rig(), algorithms),
    "leadshine_tcp": ("the same behind a gateway", on_tcp(EVERY["leadshine"].rig()), algorithms),
    **{
        name: (what, (RIGS / f"{name}.toml").read_text(), algorithms)
        for name, what in (
            ("mit", "two Damiao drives with MIT frames"),
            ("robstride", "two RobStride drives"),
            ("vesc", "two VESCs"),
            ("rmd", "two RMDs"),
            ("dynamixel", "two Dynamixel servos on a serial line"),
        )
    },
    "moteus": ("two moteus controllers on CAN FD", (RIGS / "moteus.toml").read_text(), algorithms),
    "oriental_az": ("two AZ drivers on a serial line", EVERY["oriental_az"].rig(), algorithms),
}
"""By name: description, rig, application."""


def described(name: str) -> RigDescription:
    """Return the rig of a golden recording."""
    return parse_rig(Source(Path(f"{name}.toml"), GOLDEN[name][1]), installed_plugins())


def record(name: str, path: Path) -> None:
    """Record a run of the rig as it is today."""
    with Rig(described(name), record=path) as rig:
        GOLDEN[name][2](rig)


@contextmanager
def golden(name: str) -> Iterator[Path]:
    """Yield the path of the file, which must exist."""
    path = FOLDER / f"{name}.mcap"
    assert path.is_file(), f"{path} is missing: make golden"
    yield path


def rows() -> Iterator[str]:
    """Yield the index, one row per recording."""
    yield "# Golden recordings"
    yield "Made by `make golden` (tests/support/golden.py), each of one run in virtual time.\n"
    yield "| file | what | s | messages | digest |"
    yield "| --- | --- | --- | --- | --- |"
    for name, (what, _, _) in GOLDEN.items():
        path = FOLDER / f"{name}.mcap"
        with read_trace(path) as trace:
            count = sum(1 for _ in trace.messages())
            _, last_ns = trace.span_ns() or (0, 0)
        yield f"| {path.name} | {what} | {last_ns / 1e9:.3f} | {count} | `{digest(path)[:16]}` |"


def main() -> int:
    """Rewrite the recordings whose digest differs."""
    FOLDER.mkdir(exist_ok=True)
    sys.argv = ["make", "golden"]  # recorded as the command line, equal on every machine
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
