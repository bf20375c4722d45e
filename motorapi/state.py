"""What can be known of a motor: its state, its fault, and what was measured last."""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, final


@final
class MotorState(Enum):
    """Whether the motor can move, in words common to all drives."""

    OFFLINE = "offline"  # not heard, or not heard any more
    DISABLED = "disabled"  # power stage off
    ENABLED = "enabled"  # power stage on: moving, or holding its position
    STOPPED = "stopped"  # after a quick stop: stopping or at rest, moves only after enable()
    FAULT = "fault"  # moves only after reset_fault()


@final
@dataclass(frozen=True, slots=True, repr=False)
class Fault:
    """What the drive says is wrong: its own error code, in words, and since when [ns]."""

    code: int
    text: str
    since_ns: int

    def __repr__(self) -> str:
        return f"<Fault {self.code:04X}h ({self.text}) since {self.since_ns / 1e9:.6f} s>"


@final
class Measurement(NamedTuple):  # a recorder asks for one 50 times a second and motor
    """What was heard of a motor last, without asking it: time [ns], SI values, None: not heard."""

    time_ns: int
    state: MotorState
    position: float | None = None
    velocity: float | None = None
    torque: float | None = None
    following_error: float | None = None

    def __repr__(self) -> str:
        text = f"<Measurement at {self.time_ns / 1e9:.6f} s: {self.state.value}"
        for name, value in zip(self._fields[2:], self[2:], strict=True):
            if value is not None:
                text += f", {name.replace('_', ' ')} {value:g}"
        return f"{text}>"
