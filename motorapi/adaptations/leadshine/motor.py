"""Adaptation to drives with a path table (Leadshine, StepperOnline).

| command                                  | request to the drive                                  |
| ---------------------------------------- | ----------------------------------------------------- |
| set-point or simple trajectory, position | path 0, absolute, interrupting; one request starts it |
| set-point or simple trajectory, velocity | path 0, velocity                                      |
| stop, halt, quick stop                   | trigger 40h, with the ramp of the motion              |
| homing                                   | here (35, 37), limit (17, 18) or home switch (19, 21) |
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.modbus.polled_motor import (
    BUS_KINDS,
    PolledMotor,
    PolledTable,
    shared_hardware,
)
from motorhil.motorapi.adaptations.registration import Shared, read_settings

if TYPE_CHECKING:
    from motorhil.motorapi.adaptations.modbus.client import ByteLine
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime


_SHARED: Final[Shared[LeadshineHwMotor]] = Shared("drive")


@final
class LeadshineMotor(PolledMotor):
    """A logical motor on a PR-mode drive; any number of them may share one hardware object."""

    @property
    def hardware(self) -> LeadshineHwMotor:
        """The hardware object of the drive."""
        assert isinstance(self._polled, LeadshineHwMotor)
        return self._polled


def build(
    bus: "ByteLine", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> LeadshineMotor:
    """Return the motor described by a settings table (entry point `motorhil.adaptations`).

    Args:
        bus: the line of the drive.
        settings: `unit`; `name` (None: the model's); `timeout_s`, the response timeout [s].
        model: the motor model; its gear ratio must be given.
        runtime: the runtime to wait with.

    Raises:
        UsageError: a setting is unknown, missing or invalid.
    """
    own = read_settings(PolledTable, settings)
    hardware = shared_hardware(
        _SHARED,
        bus,
        own,
        lambda unit, timeout_s: LeadshineHwMotor(bus, unit, runtime=runtime, timeout_s=timeout_s),
    )
    return LeadshineMotor(
        hardware,
        model,
        name=own.name,
        on_close=lambda: _SHARED.give_back(hardware),
    )


build.bus_kinds = BUS_KINDS  # type: ignore[attr-defined]  # a plugin's mark
