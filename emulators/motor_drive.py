"""The part of an emulated drive with one motor that no protocol changes.

A drive derives from `MotorDrive`, and adds frames, times and states. The rest of `Controller` is
here: the queues, the physical inputs, and the true values of the motor.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import Final

from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.plant.dc_motor import RANGES

_INPUTS: Final = ("load_torque_n_m", "supply_v", "power", "fault")


class MotorDrive(ABC):
    """A drive without its protocol; see `motorhil.emulators.api.Controller`.

    Args:
        axis: its motor.
        faults: the codes that the input "fault" accepts.

    Attributes:
        axis: its motor.
        is_powered: whether it has power.
    """

    def __init__(self, axis: Axis, faults: Collection[int]) -> None:
        self.axis: Final = axis
        self.is_powered: bool = False
        self._faults: Final = faults
        self._out: list[bytes] = []
        self._events: list[tuple[str, str]] = []

    # --- what a drive adds

    @abstractmethod
    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time, before an input changes."""
        self.axis.at(now_ns)

    @abstractmethod
    def inject(self, fault: int) -> None:
        """Cause a fault."""

    @abstractmethod
    def go_dark(self) -> None:
        """Lose the power: no current, no frames, no deadlines."""

    def truth(self) -> Mapping[str, float]:
        """Return true values of its own."""
        return {}

    # --- queues

    def queue(self, frame: bytes) -> None:
        """Queue a frame."""
        self._out.append(frame)

    def note(self, level: str, message: str) -> None:
        """Add an event: "info", "warning" or "error"."""
        self._events.append((level, message))

    def warn(self, message: str) -> None:
        """Add an event of level "warning"."""
        self.note("warning", message)

    def take_output(self) -> Sequence[bytes]:
        """Return the frames to queue now."""
        out, self._out = self._out, []
        return out

    def take_events(self) -> Sequence[tuple[str, str]]:
        """Return (level, text) of the events since the last call."""
        events, self._events = self._events, []
        return events

    def sent(self, data: bytes, now_ns: int) -> bool | None:
        """Handle a transmitted frame of this drive; nothing follows from it."""
        return False

    def wants_sent(self) -> bool:
        """Return False: calls of `sent` are not needed."""
        return False

    def identifiers_revision(self) -> int:
        """Return 0: the identifiers never change."""
        return 0

    # --- physical inputs, and the truth

    def start(self, now_ns: int) -> None:
        """Switch the power on."""
        self.axis.at(now_ns)
        self.is_powered = True
        self.boot(now_ns)

    def stimulate(self, name: str, value: float, now_ns: int) -> None:
        """Set load [N·m] at the output, supply [V] or power (1, 0), or cause a fault.

        Raises:
            ValueError: there is no such input, or the value is out of range.
        """
        if name not in _INPUTS:
            raise ValueError(f"there is no stimulus {name!r}; known: {', '.join(_INPUTS)}")
        low, high = RANGES["load_torque_n_m"]
        if name == "load_torque_n_m" and not low <= value <= high:
            raise ValueError(f"{name} = {value}: out of range; expected {low:g} to {high:g}")
        if name == "fault" and not (float(value).is_integer() and int(value) in self._faults):
            codes = _listed(self._faults)
            raise ValueError(f"{name} = {value}: out of range; expected {codes}")
        if name == "power" and value not in (0, 1):
            raise ValueError(f"{name} = {value}: out of range; expected 0 or 1")
        self.advance(now_ns)
        if name == "load_torque_n_m":
            self.axis.set_load(value)
        elif name == "supply_v":
            self.axis.set_supply(value)
        elif name == "fault":
            self.inject(int(value))
        elif value and not self.is_powered:
            self.start(now_ns)
        elif not value:
            self.is_powered = False
            self.go_dark()

    def snapshot(self, now_ns: int) -> Mapping[str, float]:
        """Return the true values at `now_ns`; those in rad and N·m are at the gear's output."""
        axis = self.axis
        axis.at(now_ns)
        return {**axis.truth(), **self.truth(), **axis.truth_of_extras()}


def _listed(codes: Collection[int]) -> str:
    if isinstance(codes, range):
        return f"{codes.start} to {codes.stop - 1}"
    return ", ".join(map(str, codes)) or "none"
