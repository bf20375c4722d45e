"""Adaptation to drives with a path table (Leadshine, StepperOnline).

| command                                  | request to the drive                                  |
| ---------------------------------------- | ----------------------------------------------------- |
| set-point or simple trajectory, position | path 0, absolute, interrupting; one request starts it |
| set-point or simple trajectory, velocity | path 0, velocity                                      |
| stop, halt, quick stop                   | trigger 40h, with the ramp of the motion              |
| homing                                   | here (35, 37), limit (17, 18) or home switch (19, 21) |
| parameters                               | peak current (0191h), before the start                |
"""

from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.modbus.polled_builder import BUS_KINDS, PolledTable
from motorhil.motorapi.api.line_builder import LineBuilder
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import adaptation
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError

_PEAK_MAX_A: Final = 70.0


@final
@frozen(kw_only=True)
class LeadshineParameters:
    """The tunable parameters of a drive; None leaves the drive's own value.

    Attributes:
        peak_current_a: the largest current of the motor [A], in steps of 0.1 A (0191h).

    Raises:
        UsageError: the current is not 0.1 A to 70 A.
    """

    peak_current_a: float | None = None

    def __post_init__(self) -> None:
        current = self.peak_current_a
        if current is not None and not 0.1 <= as_number(current) <= _PEAK_MAX_A:
            raise UsageError(
                f"LeadshineParameters: peak_current_a = {current!r}: must be 0.1 to"
                f" {_PEAK_MAX_A:g} A"
            )


@final
class LeadshineMotor(PolledMotor[LeadshineHwMotor]):
    """A logical motor on a PR-mode drive; any number of them may share one hardware object."""

    _tuned = LeadshineParameters()

    @property
    def parameters(self) -> LeadshineParameters:
        """The parameters of this motor; None leaves the drive's own value."""
        return self._tuned

    def set_parameters(self, parameters: LeadshineParameters) -> None:
        """Set the parameters that are written to the drive from the next `start` on.

        Raises:
            UsageError: `parameters` is not a LeadshineParameters.
        """
        if not isinstance(parameters, LeadshineParameters):
            raise UsageError(f"{self.name}: {parameters!r} is not a LeadshineParameters")
        self._tuned = parameters

    def _apply_parameters(self) -> None:
        current = self._tuned.peak_current_a
        self.hardware.limit_current(None if current is None else int(current * 10.0 + 1e-9))


build: Final = adaptation(api=1, bus_kinds=BUS_KINDS)(
    LineBuilder(PolledTable, LeadshineHwMotor, LeadshineMotor)
)
