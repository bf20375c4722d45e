"""Oracle of fault confinement: the reported states of CAN controllers."""

from typing import Final, final

from harness.oracles.finding import Violation
from harness.oracles.oracle import Oracle
from harness.oracles.scene import Scene
from traces.bus_errors import BusError, ControllerState

_WARNING: Final = 96
_PASSIVE: Final = 128
_TOLD_MAX: Final = 255  # a message has 8 bits for a counter
_ORDER: Final = (
    *(ControllerState.ACTIVE, ControllerState.WARNING),
    *(ControllerState.PASSIVE, ControllerState.BUS_OFF),
)
_RANGES: Final = {  # of the greater counter
    ControllerState.ACTIVE: (0, _WARNING - 1),
    ControllerState.WARNING: (_WARNING, _PASSIVE - 1),
    ControllerState.PASSIVE: (_PASSIVE, _TOLD_MAX),
    ControllerState.BUS_OFF: (_TOLD_MAX, _TOLD_MAX),
    ControllerState.RESTARTED: (0, 0),
}
_DRIVERS: Final = "hardware drivers report counters in different ways"


@final
class Confinement(Oracle):
    """The oracle `error-states`."""

    id = "error-states"
    promise = (
        "The states of a CAN controller follow one another as its counters allow: active, "
        "warning (96), passive (128), bus-off, restarted; in bus-off it sends nothing"
    )
    source = "ISO 11898-1, fault confinement; linux/can/error.h"
    needs = "the recording has no error message (SocketCAN error frame) with a controller state"
    needs_canopen = False

    def __init__(self, scene: Scene) -> None:
        """Set up the oracle; see `Oracle`."""
        super().__init__(scene)
        self._states: dict[tuple[str, str], ControllerState] = {}

    def error(self, time_ns: int, bus: str, sender: str, told: BusError) -> None:
        """Compare the state with its counters and with the previous state.

        Counters without a state may be ahead of the next message, which has the state.
        """
        if told.state is None:
            return
        self.look(time_ns, bus)
        key = (bus, sender)
        before = self._states.get(key)
        if told.counters is not None:
            self._counters(time_ns, key, told.text, told.state, told.counters)
        if before is not None and not _may_follow(before, told.state):
            text = f"{told.state.value}{told.counted}, but was {before.value}"
            self.absent(self._violation(time_ns, key, text))
        is_new = told.state is ControllerState.RESTARTED
        self._states[key] = ControllerState.ACTIVE if is_new else told.state

    def sent_while_off(self, time_ns: int, bus: str, sender: str, identifier: int) -> None:
        """Report a frame sent in bus-off."""
        text = f"sends {identifier & 0x1FFF_FFFF:X}h while it is bus-off"
        self.broken(self._violation(time_ns, (bus, sender), text))

    def _counters(
        self,
        time_ns: int,
        key: tuple[str, str],
        text: str,
        state: ControllerState,
        counters: tuple[int, int],
    ) -> None:
        low, high = _RANGES[state]
        if low <= max(counters) <= high:
            return
        tec, rec = counters
        text = f"{text} (TEC {tec}, REC {rec}): the greater counter should be {low} to {high}"
        violation = self._violation(time_ns, key, text)
        if key[1]:
            self.broken(violation)
        else:
            self.doubt(violation, _DRIVERS)

    def _violation(self, time_ns: int, key: tuple[str, str], text: str) -> Violation:
        bus, sender = key
        names = self.scene.names.nodes
        node = next((n for (b, n), name in names.items() if (b, name) == key), 0)
        whose = f"the CAN controller of {sender}" if sender else "the CAN controller"
        return Violation(time_ns, f"{whose}: {text}", bus, node)


def _may_follow(before: ControllerState, state: ControllerState) -> bool:
    """Return True if no state is skipped; counters rise by 8 at most, and fall by 1 or to 127."""
    if state is ControllerState.RESTARTED:
        return before is ControllerState.BUS_OFF
    if before is ControllerState.BUS_OFF:
        return state is ControllerState.ACTIVE
    return abs(_ORDER.index(state) - _ORDER.index(before)) <= 1
