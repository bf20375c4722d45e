"""The logical motor of an igus dryve D1, and its builder.

| command                                  | telegrams to the drive                               |
| ---------------------------------------- | ---------------------------------------------------- |
| set-point or simple trajectory, position | target and profile; then bit 4 and 5 of 6040h        |
| set-point or simple trajectory, velocity | profile; then 60FFh, in mode 3                       |
| stop, halt, quick stop                   | halt (bit 8 of 6040h), with the ramp of the motion   |
| homing                                   | 6098h, mode 6, bit 4 of 6040h                        |
"""

from dataclasses import dataclass
from typing import Final, final

from motorhil.motorapi.adaptations.dryve.hardware import VELOCITY_UNITS, DryveHwMotor
from motorhil.motorapi.api import (
    LineBuilder,
    Measurement,
    PeerError,
    PolledMotor,
    adaptation,
    number,
    text,
    whole,
    word,
)


@final
class DryveMotor(PolledMotor[DryveHwMotor]):
    """A logical motor on a drive; any number of them may share one hardware object."""

    def _latest(self) -> Measurement | None:
        """Return the last status, without a following error: its demand cannot be read."""
        heard = super()._latest()
        return None if heard is None else heard._replace(following_error=None)

    def _stop(self) -> None:
        self.hardware.is_homing = False
        super()._stop()

    def _quick_stop(self) -> None:
        self.hardware.is_homing = False
        super()._quick_stop()

    def _is_done(self) -> bool:
        if self.hardware.homing_failed and self.hardware.is_homing:
            raise PeerError(
                f"{self.name}: homing failed (statusword bit 13); expected bit 12; check its switch"
                " and method (6098h), then home() again"
            )
        return super()._is_done()


@final
@dataclass(frozen=True, kw_only=True)
class DryveTable:
    """A motor behind an igus dryve D1."""

    unit: int = whole(0, 0, 247, "", "Unit identifier to send; the drive ignores it.")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    velocity_unit: str = word(
        "position",
        VELOCITY_UNITS,
        "unit",
        "Unit of the drive's velocities: position units per second, or 0.01 rpm.",
    )
    timeout_s: float = number(0.2, 0.001, 60.0, "s", "Response timeout.", plausible=(0.005, 30.0))


build: Final = adaptation(api=1, bus_kinds=("modbus_tcp",))(
    LineBuilder(DryveTable, DryveHwMotor, DryveMotor)
)
