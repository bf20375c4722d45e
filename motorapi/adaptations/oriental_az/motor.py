"""Adaptation to AZ drives (Oriental Motor).

| command                                  | request to the drive                               |
| ---------------------------------------- | -------------------------------------------------- |
| set-point or simple trajectory, position | operation type 1, absolute; one request starts it  |
| set-point or simple trajectory, velocity | operation type 16, continuous                      |
| stop, halt, quick stop                   | operation type 0, with the ramp of the motion      |
| homing                                   | here is 0 (35, 37); its encoder is absolute        |
| parameters                               | operating current, in the same request             |
"""

from typing import Final, final

from motorhil.frozen import frozen
from motorhil.motorapi.adaptations.modbus.polled_builder import BUS_KINDS, PolledTable
from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor
from motorhil.motorapi.api.line_builder import LineBuilder
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import adaptation
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import UsageError


@final
@frozen(kw_only=True)
class OrientalAzParameters:
    """The tunable parameters of a drive; None leaves the drive's own value.

    Attributes:
        current_ratio: the operating current, of the drive's base current, in steps of 0.001.

    Raises:
        UsageError: the ratio is not 0.001 to 1.
    """

    current_ratio: float | None = None

    def __post_init__(self) -> None:
        ratio = self.current_ratio
        if ratio is not None and not 0.001 <= as_number(ratio) <= 1.0:
            raise UsageError(f"OrientalAzParameters: current_ratio = {ratio!r}: must be 0.001 to 1")


@final
class OrientalAzMotor(PolledMotor[OrientalAzHwMotor]):
    """A logical motor on an AZ drive; any number of them may share one hardware object."""

    _tuned = OrientalAzParameters()

    @property
    def parameters(self) -> OrientalAzParameters:
        """The parameters of this motor; None leaves the drive's own value."""
        return self._tuned

    def set_parameters(self, parameters: OrientalAzParameters) -> None:
        """Set the parameters that are written to the drive from the next `start` on.

        Raises:
            UsageError: `parameters` is not an OrientalAzParameters.
        """
        if not isinstance(parameters, OrientalAzParameters):
            raise UsageError(f"{self.name}: {parameters!r} is not an OrientalAzParameters")
        self._tuned = parameters

    def _apply_parameters(self) -> None:
        ratio = self._tuned.current_ratio
        self.hardware.limit_current(None if ratio is None else int(ratio * 1000.0 + 1e-9))


build: Final = adaptation(api=1, bus_kinds=BUS_KINDS)(
    LineBuilder(PolledTable, OrientalAzHwMotor, OrientalAzMotor)
)
