"""What keeps processes apart that have the same CANopen node on a bus: two locks.

One says who may command the drive (`motorapi.ownership`). The other is short: it is had for one SDO
transfer, or for one set-up, so that the answers to one process are never taken for the answers to
another. A process that is paused inside it keeps all others from the drive's objects; they are told
which one it is.

The drive's dead-man watches the host, not one process of it: as long as any of them sends the
host's heartbeat, a drive goes on moving for a process that died. So those who are left look after
it: when its owner has died, and it moves, they halt it (`Guard`).
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.cia402_objects import PdsState
from motorapi.adaptations.foreign_stops import heed_stops
from motorapi.errors import MotorError
from motorapi.fencing import NodeFence, announce
from motorapi.lock_names import bus_name
from motorapi.process_lock import ProcessLock, can_share_time
from motorapi.sharing import PhysicalMotor

if TYPE_CHECKING:
    import can

    from motorapi.adaptations.drive_control import DriveControl
    from motorapi.adaptations.drive_node import DriveNode
    from motorapi.adaptations.sdo_channel import SdoChannel
    from motorapi.runtime import Registration, Runtime

LOOK_PERIOD_S: Final = 0.1
_STILL_INC: Final = 2
_LOG: Final = logging.getLogger("motorapi")


def node_locks(
    bus: "can.BusABC", runtime: "Runtime", node_id: int, label: str
) -> "tuple[ProcessLock, ProcessLock] | tuple[None, None]":
    """(of the drive, of its SDO channel); none, if no other process can be on this bus."""
    where = bus_name(bus) if can_share_time(runtime) else None
    if where is None:
        return None, None
    name = f"{where}-node{node_id}"
    return ProcessLock(name, label), ProcessLock(f"{name}-sdo", f"the SDO channel of {label}")


@final
class SharedNode:
    """One drive, as a process shares it with others.

    Attributes:
        sdo_lock: of its SDO channel; None: no other process is on its bus.
    """

    def __init__(
        self, physical: PhysicalMotor, sdo_lock: ProcessLock | None, runtime: "Runtime"
    ) -> None:
        self.sdo_lock: Final = sdo_lock
        self._physical = physical
        self._runtime = runtime
        self._absences = 0

    def attach(self, node: "DriveNode", bus: "can.BusABC") -> NodeFence | None:
        """The node's SDO channel is shared as it must be; the fence of what commands the drive."""
        sdo, ownership = node.sdo, self._physical.ownership
        sdo.physical = self._physical
        sdo.process_lock = self.sdo_lock
        if ownership.lock is None:
            return None
        fence = NodeFence(ownership.lock, ownership, self._runtime, bus, node.node_id)
        sdo.fence = node.link.fences[node.node_id] = fence
        announce(ownership, bus, node.node_id)
        return fence

    @property
    def is_as_we_left_it(self) -> bool:
        """Whether no other process has had the drive since it was set up here."""
        return self._absences == self._physical.ownership.absences

    @contextmanager
    def setting_up(self, sdo: "SdoChannel", timeout_s: float) -> Iterator[None]:
        """No other process sets the drive up; what the block writes, it may write.

        Raises:
            MotorBusyError: another process does, for longer than `timeout_s` [s]; or something had
                to be written, and another process owns the drive.
        """
        if self.sdo_lock is None:
            yield
            return
        ownership, label = self._physical.ownership, self._physical.label
        with ExitStack() as held:
            what = f"set-up of {label}"
            held.enter_context(self.sdo_lock.acquire(self._runtime, what, timeout_s, sdo))
            sdo.before_writing = held.enter_context(ownership.owned_to_set_up(self._runtime, label))
            try:
                yield
            finally:
                sdo.before_writing = None
            self._absences = ownership.absences


@final
class Guard:
    """Halts a drive that moves for a process that died, as long as nobody else has it.

    It does so only once this process has brought the drive up, for whatever reason.
    """

    def __init__(self, physical: PhysicalMotor, node: "DriveNode", control: "DriveControl") -> None:
        self._physical = physical
        self._node = node
        self._control = control
        self._before_inc: int | None = None
        self._told = 0
        self._rested = 0  # the token of whom it need not be halted for any more

    def look(self) -> None:
        """Called every `LOOK_PERIOD_S`."""
        ownership = self._physical.ownership
        if ownership.lock is None or ownership.is_here:
            return
        before_inc, now_inc = self._before_inc, self._node.position_inc
        self._before_inc = now_inc
        is_on = self._node.state is PdsState.OPERATION_ENABLED
        if before_inc is None or not is_on or self._control.facts is None:
            return
        with suppress(MotorError):  # the lock cannot be read, or the bus is gone: others tell that
            abandoned = ownership.lock.look().abandoned
            if not abandoned or abandoned == self._rested:
                return
            if abs(now_inc - before_inc) <= _STILL_INC:
                self._rested = abandoned
                return
            if abandoned != self._told:
                _LOG.warning("%s moves for a process that died: it is halted", self._physical.label)
                self._told = abandoned
            self._control.send_halt()


def guarding(
    runtime: "Runtime",
    physical: PhysicalMotor,
    node: "DriveNode",
    control: "DriveControl",
    end_stream: Callable[[int], None],
) -> "Registration | None":
    """A guard looks after the drive, where other processes may have it; their stops are heeded."""
    if physical.ownership.lock is None:
        return None
    heed_stops(physical, node, control, end_stream)
    return runtime.every(LOOK_PERIOD_S, Guard(physical, node, control).look)
