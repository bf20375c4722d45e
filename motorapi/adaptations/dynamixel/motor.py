"""The logical motor of a Dynamixel servo, and its builder."""

from dataclasses import dataclass
from typing import Final, final

from motorhil.motorapi.adaptations.dynamixel.hardware import MODES, DynamixelHwMotor
from motorhil.motorapi.api import (
    REQUIRED,
    ControlMode,
    ControlVariable,
    LineBuilder,
    Motion,
    PeerError,
    PolledMotor,
    SyncLevel,
    SyncOffer,
    Trigger,
    adaptation,
    number,
    text,
    whole,
    word,
)


@final
class DynamixelMotor(PolledMotor[DynamixelHwMotor]):
    """A logical motor on a servo; any number of them may share one hardware object."""

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable.value == self.hardware.mode

    def _sync_offer(self) -> SyncOffer:
        line = self.hardware.registers.line
        firing, unbounded = line.start_bound(has_answer=False)
        return SyncOffer(
            SyncLevel.TRIGGERED,
            ("dynamixel", line.name, self.hardware.mode),
            None,
            "one sync write starts all servos of one mode on the line",
            firing,
            no_firing_bound=unbounded,
            no_start_bound="the servo's own cycle is not known",
            no_end_bound="the servo's own clock is not known",
        )

    def _arm(self, motion: Motion, *, together: bool) -> Trigger:
        alone = super()._arm(motion, together=together)
        if not together:
            return alone
        trigger = self.hardware.registers.group(self.hardware.mode)
        trigger.armed[self.hardware] = self.fired
        return trigger

    def _disarm(self) -> None:
        hardware = self.hardware
        hardware.registers.group(hardware.mode).armed.pop(hardware, None)

    def _confirm(self, motion: Motion) -> None:
        super()._confirm(motion)
        if not self.hardware.was_started():
            raise PeerError(
                f"{self.name}: its registers do not hold the motion after the start; expected those"
                " of the sync write, which is not acknowledged; start() again"
            )


@final
@dataclass(frozen=True, kw_only=True)
class DynamixelTable:
    """A motor behind a Dynamixel servo of the X series on a serial line."""

    unit: int = whole(REQUIRED, 0, 252, "", "Id of the servo.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    mode: str = word("position", MODES, "mode", "Control variable; the servo has one at a time.")
    timeout_s: float = number(0.1, 0.001, 60.0, "s", "Response timeout.", plausible=(0.002, 5.0))
    watchdog_s: float | None = number(
        *(None, 0.02, 2.54, "s", "Bus watchdog: without any instruction so long, it stops."),
        plausible=(0.04, 2.54),
    )


build: Final = adaptation(api=1, bus_kinds=("serial",))(
    LineBuilder(DynamixelTable, DynamixelHwMotor, DynamixelMotor, "servo")
)
