"""Stops that come from another program: whoever has the motor is told, and does not go on.

A stop takes nobody's permission, of whatever process. The drive obeys, and says nothing of it: in
pp it stands short of its target, in pv it shows *target reached* as it comes to rest. So the
controlwords that others put on the bus are heard. Those that come by SDO are not.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final
from weakref import WeakMethod

from motorapi.adaptations.cia402_objects import ENABLE_OPERATION, HALT
from motorapi.adaptations.motion_watch import RestWatch

if TYPE_CHECKING:
    from motorapi.adaptations.drive_control import DriveControl
    from motorapi.adaptations.drive_node import DriveNode
    from motorapi.sharing import PhysicalMotor

_GOES_ON: Final = ENABLE_OPERATION
_LOOKED_AT: Final = ENABLE_OPERATION | HALT


@final
class ForeignStops:
    """Hears the controlwords of other programs for one drive."""

    def __init__(
        self,
        physical: "PhysicalMotor",
        node: "DriveNode",
        control: "DriveControl",
        end_stream: "WeakMethod[Callable[[int], None]]",
    ) -> None:
        self._physical = physical
        self._node = node
        self._control = control
        self._end_stream = end_stream

    def heard(self, frame: bytes, time_ns: int) -> None:
        """A frame of somebody else brought the drive a controlword."""
        word = int.from_bytes(frame[8:10], "little")
        if frame[4] < 2 or word & _LOOKED_AT == _GOES_ON:
            return
        if isinstance(self._node.watch, RestWatch):
            return  # it is being stopped already
        physical = self._physical
        run = physical.run
        if run is not None:
            physical.ownership.notice(run.owner)  # who took the motor over is told by name
        by = f"another program, which told the drive to stop (controlword {word:04X}h)"
        if not physical.stopped_elsewhere(by, time_ns):
            return
        self._control.is_halted = True
        end_stream = self._end_stream()
        if end_stream is not None:
            end_stream(word)


def heed_stops(
    physical: "PhysicalMotor",
    node: "DriveNode",
    control: "DriveControl",
    end_stream: Callable[[int], None],
) -> None:
    """Stops of other programs end what goes on here; `end_stream` (a method) ends set-points."""
    node.on_control = ForeignStops(physical, node, control, WeakMethod(end_stream)).heard
