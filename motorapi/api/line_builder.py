"""The builder of motors behind polled drives on lines."""

from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, TypeVar, final

from motorhil.motorapi.api.polled_hardware import PolledHardware
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import MotorBuilder

if TYPE_CHECKING:
    from motorhil.motorapi.api.line_exchanges import ByteLine
    from motorhil.motorapi.runtime.api import Runtime

HardwareT = TypeVar("HardwareT", bound=PolledHardware[Any])


@final
class LineBuilder(MotorBuilder[HardwareT]):
    """The `build` of a kind of polled drives; see `MotorBuilder`.

    Args:
        table: the class of settings, a dataclass with `unit` and `name`; all others are arguments
            of the hardware.
        hardware: makes the hardware: its class.
        motor: the class of the motor.
        noun: the word for the drive in messages.
    """

    def __init__(
        self,
        table: type[Any],
        hardware: Callable[..., HardwareT],
        motor: "type[PolledMotor[HardwareT]]",
        noun: str = "drive",
    ) -> None:
        super().__init__(table, motor, noun)
        self._hardware = hardware

    def _share(
        self, bus: "ByteLine", own: Any, runtime: "Runtime"
    ) -> tuple[HardwareT, Callable[[], None]]:
        settings = asdict(own)
        unit, _ = settings.pop("unit"), settings.pop("name")

        def make() -> HardwareT:
            made = self._hardware(bus, unit, runtime=runtime, **settings)
            made.settings = settings
            return made

        hardware = self._shared.get(bus, unit, make, lambda built: built.settings == settings)
        return hardware, lambda: self._shared.give_back(hardware)
