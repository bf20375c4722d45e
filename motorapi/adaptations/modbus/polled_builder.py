"""Settings and builder of motors behind polled drives on Modbus lines."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, final

from motorhil.motorapi.api.polled_hardware import PolledHardware
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import Shared, read_settings
from motorhil.settings import REQUIRED, number, text, whole

if TYPE_CHECKING:
    from motorhil.motorapi.api.line_exchanges import ByteLine
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

HardwareT = TypeVar("HardwareT", bound=PolledHardware[Any])


@final
@dataclass(frozen=True, kw_only=True)
class PolledTable:
    """A motor behind a drive on a Modbus line."""

    unit: int = whole(REQUIRED, 1, 247, "", "Server address of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    timeout_s: float = number(0.2, 0.001, 60.0, "s", "Response timeout.", plausible=(0.005, 30.0))


@final
class PolledBuilder(Generic[HardwareT]):
    """The `build` of one make of polled drives (entry point `motorhil.adaptations`).

    Args:
        hardware: makes the hardware: its class.
        motor: the class of the motor.
    """

    bus_kinds: Final = ("modbus_rtu", "modbus_tcp")

    def __init__(
        self, hardware: Callable[..., HardwareT], motor: "type[PolledMotor[HardwareT]]"
    ) -> None:
        self._hardware = hardware
        self._motor = motor
        self._shared: Shared[HardwareT] = Shared("drive")

    def __call__(
        self,
        bus: "ByteLine",
        settings: Mapping[str, object],
        model: "MotorModel",
        runtime: "Runtime",
    ) -> PolledMotor[HardwareT]:
        """Return the motor described by a settings table.

        Args:
            bus: the line of the drive.
            settings: `unit`; `name` (None: the model's); `timeout_s`, the response timeout [s].
            model: the motor model; its gear ratio must be given.
            runtime: the runtime to wait with.

        Raises:
            UsageError: a setting is unknown, missing or invalid.
        """
        own = read_settings(PolledTable, settings)
        hardware = self._shared.get(
            bus,
            own.unit,
            lambda: self._hardware(bus, own.unit, runtime=runtime, timeout_s=own.timeout_s),
            lambda built: built.registers.timeout_s == own.timeout_s,
        )
        return self._motor(
            hardware,
            model,
            name=own.name,
            on_close=lambda: self._shared.give_back(hardware),
        )
