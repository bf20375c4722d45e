"""A stop is commanded again while the drive does not show that it has it: a frame may be lost."""

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.cia402_objects import PdsState
from motorapi.errors import LinkError, MotorBusyError

if TYPE_CHECKING:
    from motorapi.adaptations.drive_node import DriveNode
    from motorapi.adaptations.motion_watch import MotionWatch
    from motorapi.fencing import BoundFence, Fence, NodeFence
    from motorapi.sharing import PhysicalMotor

_REPEAT_S: Final = 0.1
_REPEATS: Final = 10
_CONTROL: Final = struct.Struct("<IB3xH6x")


def stop_sender(
    node: "DriveNode", physical: "PhysicalMotor", control_id: int | None, word: int
) -> "Callable[[Fence | None], None]":
    """What puts the controlword on its way, whatever else goes on; it does not wait.

    Args:
        node: of the drive.
        physical: whose low-level access keeps it from being sent (MotorBusyError).
        control_id: of the RPDO that brings it; None: there is none, so that it goes by SDO.
        word: stops the drive.
    """

    def send(fence: "Fence | None") -> None:
        with physical.passage(node.label, of_holder=True):
            if control_id is None:
                node.sdo.send_at_once(0x6040, 0, word.to_bytes(2, "little"), fence)
            else:
                node.link.send_tracked(_CONTROL.pack(control_id, 2, word), fence)

    return send


@final
class StopRepetition:
    """Sends a stop while `watch` sees no end of it, until it is cancelled.

    To stop takes nobody's permission. But who owned the drive when he stopped it, and has lost it
    since, does not stop its new owner without knowing it.

    Args:
        node: what is heard of the drive.
        watch: follows how it comes to rest.
        fence: of the drive; None: nobody can take it over.
        send: sends the stop once, through a fence if there is one.
    """

    def __init__(
        self,
        node: "DriveNode",
        watch: "MotionWatch",
        fence: "NodeFence | None",
        send: "Callable[[Fence | None], object]",
    ) -> None:
        self._node = node
        self._watch = watch
        self._send = send
        self._left = _REPEATS
        self._fence: BoundFence | None = None
        if fence is not None and fence.is_owned:
            with suppress(MotorBusyError):  # it is lost already
                self._fence = fence.bound("a stop")
        self._registration = node.link.runtime.every(_REPEAT_S, self._again)

    def _again(self) -> None:
        node, watch = self._node, self._watch
        enabled = node.state is PdsState.OPERATION_ENABLED
        if node.watch is not watch or watch.ended_ns is not None or not enabled or not self._left:
            self.cancel()
            return
        self._left -= 1
        try:
            self._send(self._fence)
        except (LinkError, MotorBusyError):
            self.cancel()

    def cancel(self) -> None:
        """It is not sent again."""
        self._registration.cancel()
