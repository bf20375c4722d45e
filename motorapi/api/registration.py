"""Helpers for every `build` function: reading settings and sharing hardware.

Third parties may use them for adaptations of their own.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar, cast, final
from weakref import WeakValueDictionary

from motorhil.frozen import frozen
from motorhil.motorapi.bus_context import context_of
from motorhil.motorapi.errors import UsageError
from motorhil.settings import SettingError, check, read

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.motor import Motor
    from motorhil.motorapi.runtime.api import Runtime


class Hardware(Protocol):
    """A hardware object, as far as sharing is concerned.

    Attributes:
        users: the number of motors built on it from settings; the last one closes it.
    """

    users: int

    @property
    def label(self) -> str:
        """The name of the hardware in messages."""

    @property
    def is_closed(self) -> bool:
        """True if the hardware is closed."""

    def close(self) -> None:
        """Close the hardware; no motor can use it afterwards."""


class _WithOptions(Protocol):
    """Hardware made with options."""

    options: object


API_VERSION: Final = 1
"""The version of `motorhil.motorapi.api`."""

HardwareT = TypeVar("HardwareT", bound=Hardware)
BuildT = TypeVar("BuildT", bound=Callable[..., object])


def adaptation(
    *,
    api: int,
    rig: str | None = None,
    bus_kinds: Sequence[str] = ("can",),
    needs_bus: bool = True,
) -> Callable[[BuildT], BuildT]:
    """Mark a function as the builder of an adaptation: build(bus, settings, model, runtime).

    Args:
        api: the version of `motorhil.motorapi.api` that the adaptation was written for.
        rig: the rig for its conformance check, a path relative to the folder of its module.
        bus_kinds: the kinds of buses that it builds for: can, modbus_rtu, modbus_tcp, serial.
        needs_bus: False if its motors are on no bus; `build` then gets None for it.
    """
    marks = {"api_version": api, "bus_kinds": tuple(bus_kinds), "needs_bus": needs_bus}
    if rig is not None:
        marks["conformance_rig"] = rig

    def mark(build: BuildT) -> BuildT:
        vars(build).update(marks)
        return build

    return mark


@final
class _Built:
    """The hardware objects on one bus that were built from settings, by kind and place."""

    def __init__(self) -> None:
        self.hardware: Final[WeakValueDictionary[Hashable, Hardware]] = WeakValueDictionary()


@final
class Shared(Generic[HardwareT]):
    """One kind of hardware built from settings; motors on the same hardware share one object.

    The objects are kept with their bus, line or runtime.

    Args:
        noun: the word for such hardware in messages ("drive").
    """

    def __init__(self, noun: str) -> None:
        self._noun = noun

    def get(
        self,
        home: object,
        place: Hashable,
        make: Callable[[], HardwareT],
        has_settings: Callable[[HardwareT], bool],
    ) -> HardwareT:
        """Return the hardware object at this place, made on first use, and count one more user.

        Args:
            home: the bus or line of the hardware; its runtime if it has no bus.
            place: identifies the hardware there.
            make: makes the hardware object.
            has_settings: returns whether an existing object has the requested settings.

        Raises:
            UsageError: the existing object has other settings.
        """
        built = context_of(home).medium.part(_Built).hardware
        hardware = cast("HardwareT | None", built.get((self, place)))
        if hardware is None or hardware.is_closed:
            hardware = make()
            built[self, place] = hardware
        elif not has_settings(hardware):
            raise UsageError(
                f"{self._noun} {hardware.label} is used with other settings already; motors "
                "that share it must have the same settings"
            )
        hardware.users += 1
        return hardware

    def on_can(
        self,
        make: Callable[..., HardwareT],
        bus: object,
        node_id: int,
        runtime: object,
        options: object,
    ) -> tuple[HardwareT, Callable[[], None]]:
        """Return the hardware object of a drive on CAN, and the call that gives it back.

        `make` is its class, which takes bus, node_id, `runtime` and `options`, and keeps the
        options as an attribute. Raises as `get`.
        """
        hardware = self.get(
            bus,
            node_id,
            lambda: make(bus, node_id, runtime=runtime, options=options),
            lambda built: cast("_WithOptions", built).options == options,
        )
        return hardware, lambda: self.give_back(hardware)

    def give_back(self, hardware: HardwareT) -> None:
        """Count one user less; the last one closes the hardware."""
        hardware.users -= 1
        if hardware.users == 0:
            hardware.close()


@frozen(kw_only=True)
class Options:
    """Base of options: a class of settings whose objects applications make as well."""

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            UsageError: an option has the wrong type or is out of range.
        """
        try:
            check(self)
            self.check_together()
        except SettingError as error:
            raise UsageError(str(error)) from error

    def check_together(self) -> None:
        """Check what concerns several options (SettingError); none by default."""

    def part(self, of: "type[OptionsT]") -> "OptionsT":
        """Return the options of a class from which that of this object derives."""
        return of(**{one.name: getattr(self, one.name) for one in fields(of)})


OptionsT = TypeVar("OptionsT", bound=Options)
T = TypeVar("T")


def read_settings(of: type[T], table: Mapping[str, object], unit: str = "") -> T:
    """Return the settings in a table.

    Args:
        of: the class of the settings.
        table: the table.
        unit: the unit of positions, "rad" or "m", if keys depend on it.

    Raises:
        UsageError: a setting is unknown, missing or invalid; its cause is the SettingError.
    """
    try:
        return read(of, table, unit=unit)
    except SettingError as error:
        raise UsageError(str(error)) from error


class MotorBuilder(ABC, Generic[HardwareT]):
    """The `build` of a kind of drives, to be marked by `adaptation`.

    Motors on one drive share its hardware object.

    Args:
        table: the class of settings, with `name`.
        motor: the class of the motor.
        noun: the word for the drive in messages.
    """

    def __init__(self, table: type[Any], motor: "Callable[..., Motor]", noun: str) -> None:
        self.__module__ = table.__module__  # a rig of `adaptation` is beside it
        self._table = table
        self._motor = motor
        self._shared: Shared[HardwareT] = Shared(noun)

    @abstractmethod
    def _share(
        self, bus: Any, own: Any, runtime: "Runtime"
    ) -> tuple[HardwareT, Callable[[], None]]:
        """Return the hardware object for these settings, and the call that gives it back."""

    def __call__(
        self, bus: Any, settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
    ) -> "Motor":
        """Return the motor that a table of settings describes.

        Raises:
            UsageError: a setting is unknown, missing, or wrong.
        """
        own = read_settings(self._table, settings)
        hardware, give_back = self._share(bus, own, runtime)
        return self._motor(hardware, model, name=own.name, on_close=give_back)
