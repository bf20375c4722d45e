"""Devices and ordered groups of devices."""

from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Concatenate, Generic, ParamSpec, Self, TypeVar, final

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.runtime.api import Runtime

P = ParamSpec("P")
R = TypeVar("R")
D = TypeVar("D", bound="Device")


class Device:
    """A named object that lives in a runtime. Leaving a `with` block closes it."""

    def __init__(self, name: str, runtime: Runtime) -> None:
        self.__name = name
        self.__runtime = runtime

    @property
    @final
    def name(self) -> str:
        """The name in messages and recordings."""
        return self.__name

    @property
    @final
    def runtime(self) -> Runtime:
        """The runtime in which this device waits."""
        return self.__runtime

    def close(self) -> None:
        """Release the device; closing again does nothing."""

    @final
    def __enter__(self) -> Self:
        return self

    @final
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.__name!r}>"


class DeviceGroup(Generic[D]):
    """A container of devices in the order of appending."""

    def __init__(self, *devices: D) -> None:
        self._devices: list[D] = []
        for device in devices:
            self.append(device)

    @final
    def append(self, device: D) -> None:
        """Append `device` to the group.

        Raises:
            UsageError: it is a member already, or another member has its name.
        """
        _require_device(device)
        for member in self._devices:
            if member is device:
                raise UsageError(f"{device.name} is in the group already")
            if member.name == device.name:
                raise UsageError(f"the group has a device named {device.name} already")
        self._check_member(device)
        self._devices.append(device)

    @final
    def remove(self, device: D) -> None:
        """Remove `device` from the group.

        Raises:
            UsageError: it is not a member.
        """
        _require_device(device)
        for place, member in enumerate(self._devices):
            if member is device:
                del self._devices[place]
                return
        raise UsageError(f"{device.name} is not in the group")

    @final
    def for_each(
        self, method: Callable[Concatenate[D, P], R], *args: P.args, **kwargs: P.kwargs
    ) -> list[R]:
        """Call `method(device, *args, **kwargs)` for every device, in order.

        Returns:
            The result of each call, in the order of the group. The first error ends the calls; a
            note on the error names the member.

        Raises:
            UsageError: `method` is not callable.
        """
        if not callable(method):
            raise UsageError(f"for_each({method!r}): not callable; give a method, as Motor.enable")
        results: list[R] = []
        for place, device in enumerate(self._devices):
            try:
                results.append(method(device, *args, **kwargs))
            except Exception as error:
                error.add_note(f"from {device.name}, member {place + 1} of {len(self._devices)}")
                raise
        return results

    def _check_member(self, device: D) -> None:
        """Raise an error if the device cannot be a member."""

    def __len__(self) -> int:
        return len(self._devices)

    def __iter__(self) -> Iterator[D]:
        return iter(tuple(self._devices))

    def __getitem__(self, place: int) -> D:
        return self._devices[place]

    def __repr__(self) -> str:
        names = ", ".join(device.name for device in self._devices)
        return f"<{type(self).__name__} of {len(self._devices)}: {names}>"


def _require_device(device: object) -> None:
    if not isinstance(device, Device):
        raise UsageError(f"{device!r} is not a device: a group holds devices")
