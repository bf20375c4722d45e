"""Progress of a motion, from the command and received data, without requests."""

# ruff: noqa: SLF001 -- it reads the hooks of a motor, as Motor does its own

from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, final

from motorapi import planning
from motorapi.commands import ControlVariable, Motion

if TYPE_CHECKING:
    from motorapi.shared_motor import SharedMotor
    from motorapi.sharing import Run


@final
@dataclass(frozen=True, slots=True, repr=False)
class Progress:
    """The progress of a motion. U is rad, or m if the motor is linear.

    Attributes:
        operation: the active operation, as in "start() of left".
        elapsed_s: time since its begin [s], as reported by the hardware if it does.
        expected_s: duration of the commanded profile [s]; None: unknown (homing, a stop, an
            argument other than time).
        remaining_s: remaining part of that [s], 0 if it is late.
        fraction: 0 to 1: of the distance, for a direct position motion, else of the expected time;
            None: both unknown.
        position: the last position received [U].
        target: its target, in the unit of its control variable, or None if unknown.
    """

    operation: str
    elapsed_s: float
    expected_s: float | None
    remaining_s: float | None
    fraction: float | None
    position: float | None
    target: float | None

    def __repr__(self) -> str:
        text = f"<Progress of {self.operation}: {self.elapsed_s:.3f} s"
        if self.expected_s is not None:
            text += f" of {self.expected_s:.3f} s"
        if self.fraction is not None:
            text += f", {self.fraction:.1%}"
        if self.position is not None and self.target is not None:
            text += f", at {self.position:g} on the way to {self.target:g}"
        return f"{text}>"


def progress_of(motor: "SharedMotor", run: "Run") -> Progress:
    """Return the progress of `run` of `motor`."""
    motion = run.motion
    times = None if motion is None else motor._call(motor._motion_times)
    began_ns = run.since_ns
    if times is not None and times.started_ns is not None:
        began_ns = max(began_ns, times.started_ns)
    elapsed_s = max(0, motor.runtime.now_ns() - began_ns) / 1e9
    expected_s = None if motion is None else _expected_s(motion)
    latest = motor.latest()
    position = None if latest is None else latest.position
    fraction = None if motion is None else _of_the_way(motion, position)
    if fraction is None and expected_s is not None:
        fraction = 1.0 if expected_s <= elapsed_s else elapsed_s / expected_s
    return Progress(
        operation=run.name,
        elapsed_s=elapsed_s,
        expected_s=expected_s,
        remaining_s=None if expected_s is None else max(0.0, expected_s - elapsed_s),
        fraction=fraction,
        position=position,
        target=None if motion is None else motion.target,
    )


def _expected_s(motion: Motion) -> float | None:
    if motion.argument is not None:
        return None
    expected_s = motion.duration_s
    if expected_s is None:
        expected_s = planning.duration_of(motion)
    return expected_s if isfinite(expected_s) else None


def _of_the_way(motion: Motion, position: float | None) -> float | None:
    if motion.variable is not ControlVariable.POSITION or motion.function is not None:
        return None
    if position is None or not motion.distance:
        return None
    return min(1.0, max(0.0, (position - motion.start) / motion.distance))
