"""What starts a motion that was armed in a CiA 402 drive."""

from typing import final

from motorapi.adaptations.canopen_link import CanopenLink
from motorapi.adaptations.cia402_hardware import Cia402HwMotor
from motorapi.adaptations.motion_watch import SetpointWatch


@final
class SyncTrigger:
    """One SYNC for every motor armed on a bus."""

    def __init__(self, link: CanopenLink) -> None:
        self._link = link

    def fire(self) -> None:
        """SYNC was on the wire."""
        self._link.confirmed([self._link.sync()])

    def __eq__(self, other: object, /) -> bool:
        return isinstance(other, SyncTrigger) and other._link is self._link

    def __hash__(self) -> int:
        return id(self._link)


@final
class SetPointTrigger:
    """The controlword that makes one drive's target position count."""

    def __init__(self, hardware: Cia402HwMotor, watch: SetpointWatch) -> None:
        self._hardware = hardware
        self._watch = watch

    def fire(self) -> None:
        """The controlword was on the wire."""
        transmission = self._hardware.control.send_set_point()
        if transmission is not None:
            self._hardware.link.confirmed([transmission])
        now_ns = self._hardware.runtime.now_ns()
        self._watch.begin(now_ns if transmission is None else transmission.time_ns or now_ns)


@final
class VelocityTrigger:
    """One drive's target velocity."""

    def __init__(self, hardware: Cia402HwMotor, watch: SetpointWatch, target: int) -> None:
        self._hardware = hardware
        self._watch = watch
        self._target = target

    def fire(self) -> None:
        """The drive has its target velocity, and no halt holds it."""
        hardware = self._hardware
        hardware.objects.write(0x60FF, self._target)
        transmission = hardware.control.send_holding_word()
        if transmission is not None:
            hardware.link.confirmed([transmission])
        self._watch.begin(hardware.runtime.now_ns())
