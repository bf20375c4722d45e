"""Hardware class of a CiA 402 drive, in the drive's units.

There is one object per physical motor and process, without inheritance. The object covers all
functions of the drive, and knows nothing about the application's meaning: positions are increments,
velocities the drive's own integers.

Objects are read and written by index or by the standard's name:

    hw.read("position_actual_value"); hw.write(0x6065, 2000); hw.upload(0x2000, 1)
"""

import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.bus import open_bus, release_bus
from motorhil.motorapi.adaptations.canopen.emcy import Emergency
from motorhil.motorapi.adaptations.canopen.node import node_locks
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.canopen.objects import Value
from motorhil.motorapi.adaptations.cia402.bringup import DriveFacts, HwOptions, bring_up
from motorhil.motorapi.adaptations.cia402.controlword import DriveControl
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.cia402.node_sharing import SharedNode, guarding
from motorhil.motorapi.adaptations.cia402.objects import (
    ENABLE_OPERATION,
    HALT,
    QUICK_STOP,
    Mode,
    PdsState,
)
from motorhil.motorapi.adaptations.cia402.parameters import ParameterStore
from motorhil.motorapi.errors import LinkError, StateError, UsageError
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.can_link import (
    CanLink,
    FrameInbox,
    Transmission,
    bus_label,
    raw_frame,
)
from motorhil.motorapi.runtime.turn_lock import TurnLock
from motorhil.motorapi.runtime.wall import runtime_of

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import can
    from canopen.sdo.client import SdoClient

    from motorhil.motorapi.adaptations.cia402.motion_status import MotionWatch
    from motorhil.motorapi.runtime.api import Registration, Runtime


_STREAM_ENDS_CYCLES: Final = 4


@final
class Cia402HwMotor:
    """One drive on one CANopen bus, by node-ID, shared by all logical motors and threads.

    `control` commands the drive, and `objects` is its object dictionary. `node` holds its received
    state, and `physical` is the record that logical motors share.

    Nothing is sent before it is needed; `connect()` sends at once. Use this class directly for
    functions that the motor interface does not cover, inside `with motor.low_level() as hardware:`.
    No logical motor and no other thread can use the drive there.

    Args:
        bus: an open python-can bus, of any interface.
        node_id: the node-ID of the drive, 1..127.
        runtime: the runtime to wait with. None: the one of the bus (virtual time), else wall time.
        options: see HwOptions.

    Attributes:
        facts: the result of `connect`, or None before it.
        stream: the last stream of set-points, made by `stream_positions`, or None.
        fence: the fence for frames that command the drive, or None if no other process can take the
            drive over.
        home_changes: grows when home, or its offset 607Ch, has changed.
        quick_stopped: whether a quick stop was the last command to the power stage.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this drive exists already; the message names it.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        *,
        runtime: "Runtime | None" = None,
        options: HwOptions | None = None,
    ) -> None:
        if not isinstance(node_id, int) or not 1 <= node_id <= 127:
            raise UsageError(f"node_id = {node_id!r}: a node-ID is 1 to 127")
        if not hasattr(bus, "channel_info"):
            raise UsageError(f"{bus!r} is not a bus: give the result of can.Bus(...)")
        if runtime is None:
            runtime = runtime_of(bus)
        self.node_id: Final = node_id
        self.options: Final = options if options is not None else HwOptions()
        self.runtime: Final = runtime
        self.label: Final = f"{bus_label(bus)} node {node_id}"
        if self.options.heartbeat_ms and node_id == self.options.host_node_id:
            raise self._is_the_hosts()
        self.facts: DriveFacts | None = None
        lock, sdo_lock = node_locks(bus, runtime, node_id, self.label)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            bus, node_id, self.label, self, lock
        )
        self._shared = SharedNode(self.physical, sdo_lock, runtime)
        canopen_bus = open_bus(bus, runtime)
        if canopen_bus.is_host(node_id):
            release_bus(canopen_bus)
            release_physical_motor(bus, node_id, self)
            raise self._is_the_hosts()
        self.link: Final[CanLink] = canopen_bus.link
        self.node: Final = DriveNode(canopen_bus, node_id, self.options)
        self.physical.news = self.node.news
        self.node.on_loss.append(self.physical.fail)
        self.fence: Final = self._shared.attach(self.node, bus)
        self.objects: Final = ObjectAccess(self.node, self.physical)
        self._setting_up = TurnLock(runtime)
        self.control: Final = DriveControl(self.node, self.objects, self.fence)
        self.users = 0
        self.quick_stopped = False
        self.stream: CspStream | None = None
        self.parameters: Final = ParameterStore(self.node, self.objects)
        self._homed_at_boot: int | None = None
        self.home_changes: int = 0
        self._is_doubted = False
        guard = guarding(runtime, self.physical, self.node, self.control, self.end_stream)
        self._close = weakref.finalize(self, _let_go, self.node, guard)
        self._close.atexit = False

    def _is_the_hosts(self) -> UsageError:
        return UsageError(
            f"{self.label}: node {self.node_id} is also the host's node-ID;"
            " give the host another with HwOptions(host_node_id=...)"
        )

    def __repr__(self) -> str:
        what = "not connected" if self.facts is None else self.node.describe_status()
        return f"<Cia402HwMotor {self.label}: {'closed' if self.is_closed else what}>"

    def close(self) -> None:
        """Close the drive object; nothing is sent or received afterwards.

        A moving drive is stopped by its own supervision of the host's heartbeat.
        """
        if self._close.alive:
            watch = self.node.watch
            done = watch is None or watch.ended_ns is not None
            status = RunStatus.DONE if done else RunStatus.GOING
            self.physical.end(f"close() of {self.label}", self.runtime.now_ns(), status)
        release_physical_motor(self.link.bus, self.node_id, self)
        if self.stream is not None:
            self.stream.cancel()
        self.facts = None
        self._close()

    @property
    def is_closed(self) -> bool:
        """True if `close` was called."""
        return not self._close.alive

    @property
    def is_homed(self) -> bool:
        """True if a homing succeeded since the last boot-up of the drive."""
        return self._homed_at_boot == self.node.boots

    def was_homed(self) -> None:
        """Record a successful homing."""
        self._homed_at_boot = self.node.boots
        self.home_changes += 1
        self.node.count_anew()

    # --- bringing up ---------------------------------------------------------------------

    def connect(self) -> DriveFacts:
        """Bring the drive up and configure it, unless that was done already; see `bring_up`."""
        facts = self.facts
        if facts is not None and self._close.alive:
            self.node.look_for_restart()
            if self._is_known:
                return facts
        if not self._close.alive:
            raise LinkError(link=self.label, reason="this hardware object is closed")
        options = self.options
        with (
            self.physical.passage(self.label, of_holder=True),
            self._setting_up.turn(4 * options.connect_timeout_s, f"{self.label}: its set-up"),
        ):
            if self.facts is not None and self._is_known:
                return self.facts
            self.node.keep_host_heartbeat()
            if self.node.has_booted:
                self.node.count_anew()
            self.objects.doubt()
            self.control.forget()
            self.facts = self.control.facts = None  # after a failure, the next call tries again
            facts = self._shared.set_up(self.node.sdo, options.connect_timeout_s, self._bring_up)
            self.facts = self.control.facts = facts
            return facts

    def _bring_up(self) -> DriveFacts:
        self._is_doubted = False
        return bring_up(self.node, self.options)

    @property
    def _is_known(self) -> bool:
        return self.node.is_up and not self._is_doubted and self._shared.is_as_we_left_it

    # --- objects -------------------------------------------------------------------------

    def sdo(self) -> "AbstractContextManager[SdoClient]":
        """Return the SDO client of canopen for this drive, for block transfer and streams.

        `with hw.sdo() as sdo: sdo.open(0x1021, block_transfer=True).read()`
        """
        return self.node.sdo.alone()

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object; raises as `ObjectAccess.upload`."""
        return self.objects.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write `data` to an object; raises as `ObjectAccess.upload`, and as `write`."""
        self.physical.require_free()
        self.objects.download(index, subindex, data)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """Return the value of an object, by index or by the standard's name ("target_position").

        Args:
            what: the index or the name.
            subindex: the sub-index, if `what` is an index.
            kind: the data type ("u8" to "i64", "f32", "string", "bytes") of an object that the
                standard does not define. Without it, such an object is read as "bytes".
        """
        return self.objects.read(what, subindex, kind)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """Write a value to an object of the drive; arguments as in `read`.

        Raises:
            UsageError: the value does not fit its type, or the type is not known.
            MotorBusyError: a motor on this object has reserved or moves it, and this is neither one
                of its operations nor low-level access.
        """
        self.physical.require_free()
        self.objects.write(what, value, subindex, kind)

    def send_frame(self, can_id: int, data: bytes = b"", *, extended: bool = False) -> Transmission:
        """Queue a frame of the caller; `time_ns` of the result is the time when it was sent.

        Args:
            can_id: the identifier, of 11 bits.
            data: up to 8 bytes.
            extended: whether the identifier has 29 bits.

        Raises:
            UsageError: the identifier or the data is not valid.
            MotorBusyError: another thread has low-level access; or as `write`.
            LinkError: the bus does not accept the frame.
        """
        self.physical.require_free()
        frame = raw_frame(can_id, data, extended=extended)
        with self.physical.passage(self.label, of_holder=True):
            return self.link.send_tracked(frame, self.fence)

    def listen(self, *can_ids: int) -> FrameInbox:
        """Return an inbox for raw frames of other nodes with these identifiers (none: all).

        `with hw.listen(0x581) as inbox: hw.send_frame(0x601, request); inbox.receive()`
        """
        return FrameInbox(self.link, can_ids)

    # --- received status -------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        """The last statusword received."""
        return self.node.statusword

    @property
    def state(self) -> PdsState | None:
        """The state shown by the last statusword."""
        return self.node.state

    @property
    def position_inc(self) -> int:
        """The last position received, in increments; it does not wrap with the drive's counter."""
        return self.node.position_inc

    @property
    def emergencies(self) -> Sequence[Emergency]:
        """The EMCY messages received, oldest first (the last 100)."""
        return tuple(self.node.emergencies)

    def refresh(self) -> None:
        """Read statusword and position, where the drive does not send them cyclically."""
        self.node.refresh()

    def follow(self, watch: "MotionWatch | None") -> None:
        """Show every status from now on to `watch`."""
        if watch is not None:
            watch.on_end = self.node.news.grow
        self.node.watch = watch
        self.node.news.grow()

    # --- commands; the rest is in `control` --------------------------------------------------

    def enable(self) -> None:
        """Enable operation; see `DriveControl.enable`."""
        self.physical.require_free()
        self.connect()
        self.control.enable()

    def disable(self) -> None:
        """Switch the power stage off, no matter which program owns the motor."""
        self.connect()
        self.control.disable(stops=True)

    def reset_fault(self) -> None:
        """Reset the fault; see `DriveControl.reset_fault`."""
        self.physical.require_free()
        self.connect()
        self.control.reset_fault()

    def halt(self) -> None:
        """Halt the drive as 605Dh defines, without waiting; it then holds its position."""
        self.connect()
        self.control.send_halt()
        self.end_stream(ENABLE_OPERATION | HALT)

    def quick_stop(self) -> None:
        """Stop the drive as 605Ah defines, without waiting."""
        self.connect()
        self.control.send_quick_stop()
        self.end_stream(QUICK_STOP)

    def set_mode(self, mode: Mode) -> None:
        """Set the mode of operation; see `DriveControl.set_mode`."""
        if mode not in tuple(Mode):
            names = ", ".join(f"Mode.{one.name}" for one in Mode)
            raise UsageError(f"{self.label}: mode {mode!r}: give one of {names}")
        self.connect()
        self.control.set_mode(Mode(mode))

    def stream_positions(
        self, period_s: float, next_target: Callable[[int], int | None]
    ) -> CspStream:
        """Stream `next_target(cycle)` in csp, one position per SYNC, until it returns None."""
        self.physical.require_free()
        self.connect()
        self.stream = CspStream(self.control, period_s, next_target)
        return self.stream

    def end_stream(self, word: int) -> None:
        """End a running stream of set-points with this controlword, without waiting.

        The drive has already received the word, and brakes or coasts accordingly.
        """
        if self.stream is not None:
            self.stream.stop(word)

    # --- low-level access ------------------------------------------------------------------

    def fall_silent(self) -> None:
        """Finish pending transfers, so that nothing is sent without a call.

        Raises:
            StateError: set-points are being streamed.
            LinkError: frames sent to the drive before do not get on the bus.
        """
        stream = self.stream
        if stream is not None and not self.runtime.wait_until(
            lambda: stream.ended, _STREAM_ENDS_CYCLES * stream.period_s
        ):  # a stopped stream still has to send its last words
            raise StateError(
                motor=self.label,
                operation="low_level()",
                state="set-points are being streamed to it",
                remedy="cancel() the stream first",
            )
        self.follow(None)
        self.node.sdo.finish()
        can_ids = [0x600 + self.node_id]
        if self.facts is not None:
            if self.facts.control_id is not None:
                can_ids.append(self.facts.control_id)
            can_ids += self.facts.latched_ids.values()
        self.link.confirmed([one for can_id in can_ids for one in self.link.pending(can_id)])

    def doubt(self) -> None:
        """Discard all knowledge of the drive; `connect` brings it up as if it were new.

        The homing status is kept: after homing by hand, call `was_homed()`.
        """
        self._is_doubted = True
        self.parameters.forget()
        self.objects.doubt()
        self.control.forget()


def _let_go(node: DriveNode, guard: "Registration | None") -> None:
    if guard is not None:
        guard.cancel()
    node.close()
    release_bus(node.bus)
