"""Coordination of processes that use the same drive.

Two locks coordinate them. The lock of the drive grants its command (class `Ownership`). The second
lock is held briefly, for one SDO transfer or one set-up, so that each process receives only its own
answers. A process that is paused inside it keeps all others from the drive's objects; their errors
name it.

The drive watches the heartbeat of the host, not of one process. While any process sends the host's
heartbeat, a drive keeps moving for a process that died. So the remaining processes watch the drive:
when its owner has died and it moves, they halt it (`Guard`).

*Foreign stops*: any process may stop a motor without owning it, and so may another master on the
bus. The drive obeys, but does not report the stop. In pp it stands short of its target; in pv it
shows *target reached* as it comes to rest. So the controlwords that other programs put on the bus,
by RPDO or by SDO, are monitored, and the owner's motion is ended with an error. A new set-point of
another master ends it too.
"""

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Final, final
from weakref import WeakMethod

from motorhil.motorapi.adaptations.cia402.motion_status import RestWatch
from motorhil.motorapi.adaptations.cia402.objects import (
    ENABLE_OPERATION,
    HALT,
    NEW_SET_POINT,
    Mode,
    PdsState,
)
from motorhil.motorapi.errors import MotorBusyError, MotorError
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.ownership.fencing import NodeFence, announce
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.adaptations.canopen.sdo import SdoChannel
    from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts
    from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
    from motorhil.motorapi.adaptations.cia402.node import DriveNode
    from motorhil.motorapi.runtime.api import Registration, Runtime

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

    def heard(self, word: int, time_ns: int) -> None:
        """Handle a controlword of another program for the drive."""
        told = "to stop"
        if word & _LOOKED_AT == _GOES_ON:
            if not word & NEW_SET_POINT or not self._control.is_in(Mode.PROFILE_POSITION):
                return
            told = "to move elsewhere"
        if isinstance(self._node.watch, RestWatch):
            return  # a stop is already in progress
        physical = self._physical
        run = physical.run
        if run is not None:
            physical.ownership.notice(run.owner)  # so that an error names a new owner
        by = f"another program, which told the drive {told} (controlword {word:04X}h)"
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
    heard = ForeignStops(physical, node, control, WeakMethod(end_stream)).heard
    node.on_control = node.sdo.on_control = heard


LOOK_PERIOD_S: Final = 0.1
_AGAIN_S: Final = 0.02
"""The time between two attempts of a reader to find a drive set up by its owner [s]."""
_STILL_INC: Final = 2
_LOG: Final = logging.getLogger("motorapi")


@final
class SharedNode:
    """One drive, shared with other processes.

    Attributes:
        sdo_lock: the lock of its SDO channel; None: no other process is on its bus.
    """

    def __init__(
        self, physical: PhysicalMotor, sdo_lock: ProcessLock | None, runtime: "Runtime"
    ) -> None:
        self.sdo_lock: Final = sdo_lock
        self._physical = physical
        self._runtime = runtime
        self._absences = 0

    def attach(self, node: "DriveNode", bus: "can.BusABC") -> NodeFence | None:
        """Share the node's SDO channel, and return the fence for commands to the drive."""
        sdo, ownership = node.sdo, self._physical.ownership
        sdo.physical = self._physical
        sdo.process_lock = self.sdo_lock
        if ownership.lock is None:
            return None
        fence = NodeFence(ownership.lock, ownership, self._runtime, bus, node.node_id)
        sdo.fence = node.bus.fences[node.node_id] = fence
        announce(ownership, bus, node.node_id)
        ownership.refusal_check = fence.check
        return fence

    @property
    def is_as_we_left_it(self) -> bool:
        """True if no other process has owned the drive since it was set up here."""
        return self._absences == self._physical.ownership.absences

    def set_up(
        self, sdo: "SdoChannel", timeout_s: float, bring_up: "Callable[[], DriveFacts]"
    ) -> "DriveFacts":
        """Return the result of `bring_up`, which sets the drive up for all processes.

        A reader, or a stop, of a drive that its owner has not set up yet waits for the owner: only
        the owner may write.

        Args:
            sdo: the SDO channel of the drive.
            timeout_s: timeout for the owner [s], and four times of it for other readers.
            bring_up: reads the drive, and writes where its settings differ.

        Raises:
            MotorBusyError: the owner, another process, has not set the drive up in time.
        """
        runtime = self._runtime
        end_ns = runtime.now_ns() + round(timeout_s * 1e9)
        while True:
            try:
                with self._setting_up(sdo, 4 * timeout_s):
                    return bring_up()
            except MotorBusyError:
                if self._physical.ownership.is_here or runtime.now_ns() >= end_ns:
                    raise
            runtime.wait_until(lambda: False, _AGAIN_S)

    @contextmanager
    def _setting_up(self, sdo: "SdoChannel", timeout_s: float) -> Iterator[None]:
        """Exclude other processes from setting up the drive, and permit the block to write.

        Raises:
            MotorBusyError: another process sets it up for longer than `timeout_s` [s], or a write
                is necessary while another process owns the drive.
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
    """A guard that halts a drive moving for a process that died, while it has no new owner.

    The guard is active only once this process has brought the drive up.
    """

    def __init__(self, physical: PhysicalMotor, node: "DriveNode", control: "DriveControl") -> None:
        self._physical = physical
        self._node = node
        self._control = control
        self._before_inc: int | None = None
        self._told = 0
        self._rested = 0  # token of an owner whose drive is at rest

    def look(self) -> None:
        """Check the drive; called every `LOOK_PERIOD_S`."""
        ownership = self._physical.ownership
        if ownership.lock is None or ownership.is_here:
            return
        before_inc, now_inc = self._before_inc, self._node.position_inc
        self._before_inc = now_inc
        is_on = self._node.state is PdsState.OPERATION_ENABLED
        if before_inc is None or not is_on or self._control.facts is None:
            return
        with suppress(MotorError):  # Lock and bus errors are reported elsewhere.
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
    """Heed foreign stops, and start a guard of the drive if other processes can have it."""
    heed_stops(physical, node, control, end_stream)
    if physical.ownership.lock is None:
        return None
    return runtime.every(LOOK_PERIOD_S, Guard(physical, node, control).look)
