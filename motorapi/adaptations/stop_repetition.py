"""Repetition of a stop until the drive obeys, against lost frames."""

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
    """Return a function that sends the controlword at once, without waiting.

    Args:
        node: the drive.
        physical: its motor; low-level access of another thread prevents sending (MotorBusyError).
        control_id: the identifier of the RPDO for it; None: there is none, and SDO is used.
        word: the controlword of the stop.
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
    """A repeated stop, sent until `watch` sees its end or it is cancelled.

    Any program may stop a drive without owning it. But a former owner that stopped the drive and
    has lost it since must not stop its new owner unknowingly.

    Args:
        node: the received state of the drive.
        watch: observes the deceleration.
        fence: the fence of the drive; None: no other process can take it over.
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
            with suppress(MotorBusyError):  # the drive is already lost
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
        """End the repetition."""
        self._registration.cancel()
