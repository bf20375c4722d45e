"""The logical motor of a drive on a CAN bus, as far as all kinds agree, and its builder."""

from collections.abc import Callable
from dataclasses import replace
from math import floor, tau
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar, final

from motorhil.motorapi.api.can_drive import CanDrive
from motorhil.motorapi.api.can_hardware import CanHardware
from motorhil.motorapi.api.registration import MotorBuilder, OptionsT
from motorhil.motorapi.errors import UnsupportedError, UsageError
from motorhil.motorapi.model import MotionKind
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.synchronization.offer import SyncOffer

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.runtime.api import Runtime

_HERE: Final = (None, 35, 37)
_ROUNDING: Final = 1e-12  # so that rounding twice is safe


class HasDrive(Protocol):
    """A hardware object with a connection on a CAN bus."""

    @property
    def drive(self) -> CanDrive:
        """Its connection."""

    def connect(self) -> None:
        """Wait until the drive is heard; free if it is."""


HardwareT = TypeVar("HardwareT", bound=HasDrive)


class CanMotor(Motor, Generic[HardwareT]):
    """A logical motor on a drive; several of them may share one hardware object.

    A kind adds `_units_of`, the hooks of a motor but `_connect`, and its capabilities.

    Args:
        hardware: the hardware object.
        model: the motor's constants.
        units: as returned by `_units_of`; None: that.
        name: its name in messages and records; None: the model's name and the drive's place.
        on_close: called once when the motor is closed. The hardware object belongs to its creator.

    Attributes:
        hardware: the hardware object, with all abilities of the drive.

    Raises:
        UsageError: the model does not suit the drive.
    """

    def __init__(
        self,
        hardware: HardwareT,
        model: "MotorModel",
        units: float | None = None,
        *,
        name: str | None = None,
        on_close: Callable[[], None] | None = None,
    ) -> None:
        self.hardware: Final = hardware
        self._units: Final = self._units_of(model) if units is None else units
        drive = hardware.drive
        super().__init__(
            name=name,
            model=model,
            runtime=drive.runtime,
            physical=drive.physical,
            on_close=on_close,
        )

    def _units_of(self, model: "MotorModel") -> float:
        """Return units of position of the drive per unit of the model, signed.

        By default 1. Raises UsageError if the model does not suit the drive.
        """
        return 1.0

    def _connect(self) -> None:
        self.hardware.connect()

    def _sync_offer(self) -> SyncOffer:
        offer = self.hardware.drive.own_offer()
        return super()._sync_offer() if offer is None else offer

    def _open_low_level(self) -> HardwareT:
        return self.hardware

    def _close_low_level(self) -> None:
        self.hardware.drive.doubt()


def motor_turns(model: "MotorModel") -> float:
    """Return turns of the motor per unit of the model, signed, for a drive that counts them.

    Raises:
        UsageError: the model does not tell.
    """
    is_rotary = model.kind is MotionKind.ROTARY
    if model.gear_ratio is None:
        key = "gear_ratio" if is_rotary else "motor_turns_per_m"
        raise UsageError(
            f"motor model {model.name}: {key} is missing, and the drive counts turns of its motor;"
            f" expected {key} = 1.0 if there is no gear; add it"
        )
    return model.gear_ratio / (tau if is_rotary else 1.0)


def output_sign(model: "MotorModel") -> float:
    """Return the direction of the model, 1.0 or -1.0, for a drive with angles of its output.

    Raises:
        UsageError: the model is that of a linear motor.
    """
    if model.kind is not MotionKind.ROTARY:
        raise UsageError(f"motor model {model.name}: kind is linear; expected rotary")
    return -1.0 if (model.gear_ratio or 1.0) < 0.0 else 1.0


def require_here(motor: str, method: int | None) -> None:
    """Raise UnsupportedError for homing by another method than setting the zero here."""
    if method not in _HERE:
        feature = f"homing by method {method}"
        raise UnsupportedError(motor=motor, feature=feature, supported="35, 37")


def whole_steps(motion: Motion, steps: float) -> Motion:
    """Return the motion in whole steps of a drive, of so many per unit, and never faster."""
    size = abs(steps)

    def down(value: float) -> float:
        return max(1, floor(value * size * (1.0 + _ROUNDING))) / size

    return replace(
        motion,
        target=round(motion.target * steps) / steps,
        velocity=down(motion.velocity),
        acceleration=down(motion.acceleration),
        deceleration=down(motion.deceleration),
    )


class NodeTable(Protocol):
    """The table of a motor in a rig: the options of its hardware, and these keys."""

    @property
    def node_id(self) -> int:
        """The number of the drive."""

    @property
    def name(self) -> str | None:
        """The name of the motor; None: the model's."""

    def part(self, of: type[OptionsT]) -> OptionsT:
        """Return the options of the hardware; see `Options.part`."""


MadeT = TypeVar("MadeT", bound=CanHardware[Any])


@final
class CanBuilder(MotorBuilder[MadeT]):
    """The `build` of a kind of drive on CAN; see `MotorBuilder`.

    Args:
        table: the class of settings, which derives from the options of the hardware.
        hardware: the class of the hardware.
        motor: the class of the motor.
        noun: the word for the drive in messages.
    """

    def __init__(
        self,
        table: type[NodeTable],
        hardware: type[MadeT],
        motor: Callable[..., Motor],
        noun: str = "drive",
    ) -> None:
        super().__init__(table, motor, noun)
        self._hardware = hardware

    def _share(
        self, bus: "can.BusABC", own: NodeTable, runtime: "Runtime"
    ) -> tuple[MadeT, Callable[[], None]]:
        make = self._hardware
        return self._shared.on_can(make, bus, own.node_id, runtime, own.part(make.OPTIONS))
