"""State, fault and last measurement of a motor."""

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple, final

from motorhil.frozen import frozen
from motorhil.motorapi.errors import DeviceFault


@final
class MotorState(Enum):
    """The state of a motor, in terms common to all drives."""

    OFFLINE = "offline"  # does not respond, or no longer
    DISABLED = "disabled"  # power stage off
    ENABLED = "enabled"  # power stage on: moving, or holding its position
    STOPPED = "stopped"  # after a quick stop: slowing down or at rest, moves only after enable()
    FAULT = "fault"  # moves only after reset_fault()


@final
@frozen(repr=False)
class Fault:
    """A fault reported by the drive: its error code, its text, and its time [ns]."""

    code: int
    text: str
    since_ns: int

    def as_error(self, motor: str) -> DeviceFault:
        """Return the error for an operation of `motor` that this fault ends or prevents."""
        return DeviceFault(motor=motor, code=self.code, text=self.text, since_ns=self.since_ns)

    def __repr__(self) -> str:
        return f"<Fault {self.code:04X}h ({self.text}) since {self.since_ns / 1e9:.6f} s>"


def texts_of(bits: int, texts: Mapping[int, str]) -> str:
    """Return the texts of the bits that are set in an error."""
    return ", ".join(text for bit, text in texts.items() if bits & bit) or "unknown error"


@final
class Measurement(NamedTuple):  # a recorder creates 50 per second and motor
    """The last values received from a motor: time [ns], SI values, None: not received."""

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
