"""The trigger that starts servos on the host at the next SYNC."""

from typing import final

from motorapi.adaptations.software_cycle import Axis, Cycle


@final
class ServoTrigger:
    """A trigger for one motor, or for all motors armed together on a bus."""

    def __init__(self, cycle: Cycle, axis: Axis | None) -> None:
        self._cycle = cycle
        self._axis = axis

    def fire(self) -> None:
        """Start the motors, and wait until their SYNC was on the wire."""
        cycle = self._cycle
        if self._axis is not None:
            cycle.start((self._axis,))
            return
        armed, cycle.armed = cycle.armed, []
        cycle.start(armed)

    def __eq__(self, other: object, /) -> bool:
        return (
            isinstance(other, ServoTrigger)
            and other._cycle is self._cycle
            and other._axis is self._axis
        )

    def __hash__(self) -> int:
        return hash((id(self._cycle), id(self._axis)))
