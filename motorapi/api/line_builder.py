"""The builder of motors behind polled drives on lines."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Generic, TypeVar, final

from motorhil.motorapi.api.polled_hardware import PolledHardware
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import Shared, read_settings

if TYPE_CHECKING:
    from motorhil.motorapi.api.line_exchanges import ByteLine
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

HardwareT = TypeVar("HardwareT", bound=PolledHardware[Any])


@final
class LineBuilder(Generic[HardwareT]):
    """The `build` of a kind of polled drives, to be marked by `adaptation`.

    Motors on one drive share its hardware object.

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
        self.__module__ = table.__module__  # a rig of `adaptation` is beside it
        self._table = table
        self._hardware = hardware
        self._motor = motor
        self._shared: Shared[HardwareT] = Shared(noun)

    def __call__(
        self,
        bus: "ByteLine",
        settings: Mapping[str, object],
        model: "MotorModel",
        runtime: "Runtime",
    ) -> PolledMotor[HardwareT]:
        """Return the motor that a table of settings describes.

        Raises:
            UsageError: a setting is unknown, missing, or wrong.
        """
        own = asdict(read_settings(self._table, settings))
        unit, name = own.pop("unit"), own.pop("name")

        def make() -> HardwareT:
            made = self._hardware(bus, unit, runtime=runtime, **own)
            made.settings = own
            return made

        hardware = self._shared.get(bus, unit, make, lambda built: built.settings == own)
        return self._motor(
            hardware, model, name=name, on_close=lambda: self._shared.give_back(hardware)
        )
