"""Movers with the motors of every adaptation that makes relative moves over a bus."""

import re
from collections.abc import Callable
from dataclasses import replace
from math import pi
from pathlib import Path

from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.harness.sharing_tests.relative_moves import Mover, mover_of
from motorhil.motorapi import ControlMode, Motor, TrapezoidalTrajectory
from motorhil.motorapi.trajectory import ComplexTrajectory
from tests.support.motors.drive_rigs import drive
from tests.support.motors.software_rigs import INC_PER_RAD as SERVO_INC_RAD
from tests.support.motors.software_rigs import one as servo_motor
from tests.support.motors.streaming import quintic

HEAD = "[rig]\nseed = {seed}\n[bus.can0]\nbitrate_bit_s = 1_000_000\n"
INC_RAD = 132_000 / (2 * pi)  # 2000 x 66, the default motor and gear of the emulated drive
TIMEOUT_S = 10.0


def rigs_with(*parts: str, folder: Path = Path()) -> Callable[[int], Rig]:
    """Return a function that opens a rig of these parts with a seed."""

    def opened(seed: int) -> Rig:
        text = HEAD.format(seed=seed) + "".join(parts)
        return Rig(parse_rig(Source(folder / "rig.toml", text), installed_plugins()))

    return opened


def demand(rig: Rig) -> float:
    """Return the left drive's demand [rad], which cannot overshoot."""
    return rig.controllers["left"].snapshot()["demand_inc"] / INC_RAD


def counted(rig: Rig) -> float:
    """Return the position of the I/O node's motor [rad]."""
    return rig.controllers["io"].snapshot()["position_inc"] / SERVO_INC_RAD


def by_rpdo() -> Mover:
    """Return a CiA 402 drive in pp: the target by SDO, the controlword by RPDO."""
    return replace(mover_of("left", rigs_with(drive("left", 1)), demand), name="pp by RPDO")


def by_sdo(folder: Path) -> Mover:
    """Return a drive without PDOs, which is operated by SDO only."""
    (folder / "sdo_only.eds").write_text(without_pdos(OWN_EDS.read_text()))
    make_rig = rigs_with(drive("left", 1, 'eds = "sdo_only.eds"'), folder=folder)
    return replace(mover_of("left", make_rig, demand), name="pp by SDO")


def in_a_group() -> Mover:
    """Return two drives in pp that are started together by a SYNC: the target is latched."""

    def ready(rig: Rig) -> None:
        rig.groups["both"].for_each(Motor.enable)

    def move(rig: Rig, distance: float) -> None:
        group = rig.groups["both"]
        group.for_each(Motor.set_control_mode, ControlMode.TRAJECTORY)
        group.set_trajectory(TrapezoidalTrajectory(distance), TrapezoidalTrajectory(-distance))
        group.start()
        group.wait_until_done(TIMEOUT_S)

    both = '[group.both]\nmotors = ["left", "right"]\n'
    make_rig = rigs_with(drive("left", 1), drive("right", 2), both)
    return Mover(name="pp by SYNC", make_rig=make_rig, ready=ready, move=move, truth=demand)


def streamed() -> Mover:
    """Return a drive in csp that follows a function, one set-point at each SYNC."""

    def move(rig: Rig, distance: float) -> None:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(ComplexTrajectory(quintic(distance, 1.0), relative=True))
        motor.start()
        motor.wait_until_done(TIMEOUT_S)

    made = mover_of("left", rigs_with(drive("left", 1)), demand)
    return replace(made, name="csp", move=move)


def by_servo() -> Mover:
    """Return a servo on the host with its amplifier and encoder on an I/O node."""

    def move(rig: Rig, distance: float) -> None:
        motor = rig.motors["left"]
        motor.set_control_mode(ControlMode.TRAJECTORY)
        motor.set_trajectory(TrapezoidalTrajectory(distance))
        motor.start()
        motor.wait_until_done(TIMEOUT_S)

    made = mover_of("left", rigs_with(servo_motor(motor="misses_max = 20")), counted)
    return replace(
        made,
        name="servo",
        move=move,
        distance_max=2.0,
        tolerance=110 / SERVO_INC_RAD,
        overshoot=0.1,
        delays_ns=(500_000, 1_500_000),  # a cycle: on CAN no count overtakes another
        coast=1.0,  # from 3 rad/s without a servo: slowed by friction only
    )


def without_pdos(eds: str) -> str:
    """Return the EDS file without PDOs."""
    gone = re.compile(r"\[1[4-7A8-9]..(sub[0-9A-F]+)?\]\n(?:[^\[\n].*\n|\n)*", re.IGNORECASE)
    text = gone.sub("", eds)
    kept: list[str] = []
    place = 0
    for line in text.splitlines():
        entry = re.fullmatch(r"(\d+)=(0x[0-9A-F]{4})", line, re.IGNORECASE)
        if line.startswith("["):
            place = 0
        if entry is None:
            kept.append(line)
        elif not re.match("0x1[4-9A]", entry[2], re.IGNORECASE):
            place += 1
            kept.append(f"{place}={entry[2]}")
    return "\n".join(kept) + "\n"
