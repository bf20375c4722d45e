"""Detection of stops that other programs command on the bus.

Any process may stop a motor without owning it. The drive obeys, but does not report the stop. In pp
it stands short of its target; in pv it shows *target reached* as it comes to rest. So the
controlwords that other programs put on the bus are monitored, and the owner's motion is ended with
an error. Controlwords sent by SDO are not detected.
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
    """A listener for the controlwords that other programs send to one drive."""

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
        """Handle a frame of another program that carries a controlword for the drive."""
        word = int.from_bytes(frame[8:10], "little")
        if frame[4] < 2 or word & _LOOKED_AT == _GOES_ON:
            return
        if isinstance(self._node.watch, RestWatch):
            return  # a stop is already in progress
        physical = self._physical
        run = physical.run
        if run is not None:
            physical.ownership.notice(run.owner)  # so that an error names a new owner
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
    """End the motion here when another program stops the drive.

    `end_stream`, a bound method, ends streamed set-points.
    """
    node.on_control = ForeignStops(physical, node, control, WeakMethod(end_stream)).heard
