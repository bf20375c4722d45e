"""The hardware class of a CiA 402 drive: the whole drive, free of inheritance, in its own units.

One object per physical motor and process. It knows what the drive is able to do, and nothing of
what an application means by it: positions are increments, velocities the drive's own integers.
Objects are read and written by index or by the standard's name:

    hw.read("position_actual_value"); hw.write(0x6065, 2000); hw.upload(0x2000, 1)
"""

import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.canopen_link import (
    CanopenLink,
    Transmission,
    bus_label,
    open_link,
    release_link,
)
from motorapi.adaptations.cia402_objects import Mode, PdsState, Value
from motorapi.adaptations.cia402_parameters import ParameterStore
from motorapi.adaptations.csp_stream import CspStream
from motorapi.adaptations.drive_control import DriveControl
from motorapi.adaptations.drive_node import DriveNode, Emergency
from motorapi.adaptations.drive_objects import DriveObjects
from motorapi.adaptations.drive_setup import DriveFacts, HwOptions, bring_up
from motorapi.adaptations.raw_frames import FrameInbox, raw_frame
from motorapi.adaptations.shared_node import SharedNode, guarding, node_locks
from motorapi.adaptations.turn_lock import TurnLock
from motorapi.errors import LinkError, StateError, UsageError
from motorapi.runtime import runtime_of
from motorapi.sharing import (
    PhysicalMotor,
    RunStatus,
    bus_key,
    register_physical_motor,
    release_physical_motor,
)

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    import can
    from canopen.sdo.client import SdoClient

    from motorapi.adaptations.motion_watch import MotionWatch
    from motorapi.runtime import Registration, Runtime


_STREAM_ENDS_CYCLES: Final = 4


@final
class Cia402HwMotor:
    """One drive on one CANopen bus, by node-ID. Shared by all logical motors and threads.

    `control` commands it, `objects` is its object dictionary, `node` is what is heard of it,
    `physical` is the record that logical motors share.

    Nothing is sent before it is needed; `connect()` does it at once. Use it directly for what the
    motor interface has no word for: inside `with motor.low_level() as hardware:`, where no logical
    motor uses it, and no other thread can.

    Args:
        bus: an open python-can bus, of whatever interface.
        node_id: the drive's, 1..127.
        runtime: where to wait; None: the bus's own (virtual time), else the wall's.
        options: see HwOptions.

    Attributes:
        stream: the set-points streamed last, by `stream_positions`; None: none were.
        fence: lets out what commands the drive; None: no other process can take it over.
        quick_stopped: whether a quick stop was the last thing commanded to its power stage.
        users: how many motors were built on it by settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this drive exists already; it is named.
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
            raise UsageError(f"{bus!r} is no bus: give what can.Bus(...) returned")
        if runtime is None:
            runtime = runtime_of(bus)
        self.node_id: Final = node_id
        self.options: Final = options if options is not None else HwOptions()
        self.runtime: Final = runtime
        self.label: Final = f"{bus_label(bus)} node {node_id}"
        if self.options.heartbeat_ms and node_id == self.options.host_node_id:
            raise self._is_the_hosts()
        self._facts: DriveFacts | None = None
        self._key = (*bus_key(bus), node_id)
        lock, sdo_lock = node_locks(bus, runtime, node_id, self.label)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            self._key, self.label, self, lock
        )
        self._shared = SharedNode(self.physical, sdo_lock, runtime)
        self.link: Final[CanopenLink] = open_link(bus, runtime)
        if self.link.is_host(node_id):
            release_link(self.link)
            release_physical_motor(self._key, self)
            raise self._is_the_hosts()
        self.node: Final = DriveNode(
            self.link,
            node_id,
            sdo_timeout_s=self.options.sdo_timeout_s,
            quarantine_s=self.options.sdo_quarantine_s,
            heartbeat_timeout_ms=self.options.heartbeat_timeout_ms,
        )
        self.physical.news = self.node.news
        self.fence: Final = self._shared.attach(self.node, bus)
        self.objects: Final = DriveObjects(self.node, self.physical)
        self._setting_up = TurnLock(runtime)
        self.control: Final = DriveControl(self.link, self.node, self.objects, self.fence)
        self.users = 0
        self.quick_stopped = False
        self.stream: CspStream | None = None
        self.parameters: Final = ParameterStore(self.node, self.objects)
        self._homed_at_boot: int | None = None
        self._is_doubted = False
        guard = guarding(runtime, self.physical, self.node, self.control, self.end_stream)
        self._close = weakref.finalize(self, _let_go, self.link, self.node, self.options, guard)
        self._close.atexit = False

    def _is_the_hosts(self) -> UsageError:
        return UsageError(
            f"{self.label}: node {self.node_id} is also the host's node-ID;"
            " give the host another with HwOptions(host_node_id=...)"
        )

    def __repr__(self) -> str:
        what = "not connected" if self._facts is None else self.node.describe_status()
        return f"<Cia402HwMotor {self.label}: {'closed' if self.is_closed else what}>"

    def close(self) -> None:
        """Nothing is sent or heard any more; the drive's dead-man stops it if it moves."""
        if self._close.alive:
            watch = self.node.watch
            done = watch is None or watch.ended_ns is not None
            status = RunStatus.DONE if done else RunStatus.GOING
            self.physical.end(f"close() of {self.label}", self.runtime.now_ns(), status)
        release_physical_motor(self._key, self)
        if self.stream is not None:
            self.stream.cancel()
        self._facts = None
        self._close()

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return not self._close.alive

    @property
    def is_homed(self) -> bool:
        """Whether a homing succeeded since the drive was last heard to boot."""
        return self._homed_at_boot == self.node.boots

    def was_homed(self) -> None:
        """A homing has succeeded."""
        self._homed_at_boot = self.node.boots

    # --- bringing up ---------------------------------------------------------------------

    def connect(self) -> DriveFacts:
        """The drive is up and configured; costs nothing if it is already. See `bring_up`."""
        facts = self._facts
        if facts is not None and self._close.alive and self._is_known:
            return facts
        if not self._close.alive:
            raise LinkError(link=self.label, reason="this hardware object is closed")
        options = self.options
        with (
            self.physical.passage(self.label, of_holder=True),
            self._setting_up.turn(4 * options.connect_timeout_s, f"{self.label}: its set-up"),
        ):
            if self._facts is not None and self._is_known:
                return self._facts
            if options.heartbeat_ms and not self.node.uses_host_heartbeat:
                self.link.produce_heartbeat(options.host_node_id, options.heartbeat_ms)
                self.node.uses_host_heartbeat = True
            self.objects.doubt()
            self.control.forget()
            self._facts = self.control.facts = None  # what fails now is tried again the next time
            with self._shared.setting_up(self.node.sdo, 4 * options.connect_timeout_s):
                self._is_doubted = False
                self._facts = self.control.facts = bring_up(self.node, options)
            return self._facts

    @property
    def _is_known(self) -> bool:
        return self.node.is_up and not self._is_doubted and self._shared.is_as_we_left_it

    @property
    def facts(self) -> DriveFacts | None:
        """What `connect` found; None before it."""
        return self._facts

    # --- objects -------------------------------------------------------------------------

    def sdo(self) -> "AbstractContextManager[SdoClient]":
        """The SDO client of canopen for this drive, for block transfer and streams.

        `with hw.sdo() as sdo: sdo.open(0x1021, block_transfer=True).read()`
        """
        return self.node.sdo.alone()

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """The bytes of an object, as the drive sends them. Raises as `DriveObjects.upload`."""
        return self.objects.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """The drive has `data` in an object. Raises as `DriveObjects.upload`."""
        self.objects.download(index, subindex, data)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """The value of an object, by index or by the standard's name ("target_position").

        Args:
            what: index, or name.
            subindex: of an index.
            kind: its data type ("u8" to "i64", "f32", "string", "bytes") if the standard has none
                for it; without, such an object is read as "bytes".
        """
        return self.objects.read(what, subindex, kind)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """An object of the drive has this value; arguments as in `read`.

        Raises:
            UsageError: the value does not fit its type, or the type is not known.
        """
        self.objects.write(what, value, subindex, kind)

    def send_frame(self, can_id: int, data: bytes = b"", *, extended: bool = False) -> Transmission:
        """A frame of your own is on its way; `time_ns` of the answer tells when it was sent.

        Args:
            can_id: its identifier, of 11 bits.
            data: up to 8 bytes.
            extended: the identifier has 29 bits.

        Raises:
            UsageError: there is no such frame.
            MotorBusyError: another thread has low-level access.
            LinkError: the bus does not take it.
        """
        frame = raw_frame(can_id, data, extended=extended)
        with self.physical.passage(self.label, of_holder=True):
            return self.link.send_tracked(frame, self.fence)

    def listen(self, *can_ids: int) -> FrameInbox:
        """Frames of others with these identifiers (none: all), as they are, from now on.

        `with hw.listen(0x581) as inbox: hw.send_frame(0x601, request); inbox.receive()`
        """
        return FrameInbox(self.link, can_ids)

    # --- what is heard -------------------------------------------------------------------

    @property
    def statusword(self) -> int:
        """The last statusword heard."""
        return self.node.statusword

    @property
    def state(self) -> PdsState | None:
        """The state it shows."""
        return self.node.state

    @property
    def position_inc(self) -> int:
        """The last position heard, in increments."""
        return self.node.position_inc

    @property
    def emergencies(self) -> Sequence[Emergency]:
        """EMCY heard, oldest first (the last 100)."""
        return tuple(self.node.emergencies)

    def refresh(self) -> None:
        """Statusword and position are fresh where the drive does not repeat them by itself."""
        self.node.refresh()

    def follow(self, watch: "MotionWatch | None") -> None:
        """Every status from now on is shown to `watch`."""
        if watch is not None:
            watch.on_end = self.node.news.grow
        self.node.watch = watch
        self.node.news.grow()

    # --- commanding, the common part; the rest is in `control` ------------------------------

    def enable(self) -> None:
        """Operation is enabled. See `DriveControl.enable`."""
        self.connect()
        self.control.enable()

    def disable(self) -> None:
        """The power stage is off, whoever owns the motor."""
        self.connect()
        self.control.disable(stops=True)

    def reset_fault(self) -> None:
        """The fault is acknowledged. See `DriveControl.reset_fault`."""
        self.connect()
        self.control.reset_fault()

    def halt(self) -> None:
        """The drive stops as 605Dh says, and holds; does not wait."""
        self.connect()
        self.control.send_halt()

    def quick_stop(self) -> None:
        """The drive stops as 605Ah says; does not wait."""
        self.connect()
        self.control.send_quick_stop()

    def set_mode(self, mode: Mode) -> None:
        """The drive is in this mode of operation. See `DriveControl.set_mode`."""
        if mode not in tuple(Mode):
            names = ", ".join(f"Mode.{one.name}" for one in Mode)
            raise UsageError(f"{self.label}: mode {mode!r}: give one of {names}")
        self.connect()
        self.control.set_mode(Mode(mode))

    def stream_positions(
        self, period_s: float, next_target: Callable[[int], int | None]
    ) -> CspStream:
        """Csp: one target position per SYNC, from `next_target(cycle)`, until that is None."""
        self.stream = CspStream(self, period_s, next_target)
        return self.stream

    def end_stream(self, word: int) -> None:
        """Set-points that are being streamed bring this controlword, and then end; does not wait.

        The drive has been given the word, and brakes or coasts as it says.
        """
        if self.stream is not None:
            self.stream.stop(word)

    # --- low-level access ------------------------------------------------------------------

    def fall_silent(self) -> None:
        """Nothing of what others asked for is under way, and nothing is sent by itself.

        Raises:
            StateError: set-points are being streamed.
            LinkError: what was sent to the drive before does not get on the bus.
        """
        stream = self.stream
        if stream is not None and not self.runtime.wait_until(
            lambda: stream.ended, _STREAM_ENDS_CYCLES * stream.period_s
        ):  # one that was stopped still has its last words to say
            raise StateError(
                motor=self.label,
                operation="low_level()",
                state="set-points are being streamed to it",
                remedy="cancel() the stream first",
            )
        self.follow(None)
        self.node.sdo.finish()
        can_ids = [0x600 + self.node_id]
        if self._facts is not None:
            if self._facts.control_id is not None:
                can_ids.append(self._facts.control_id)
            can_ids += self._facts.latched_ids.values()
        self.link.confirmed([one for can_id in can_ids for one in self.link.pending(can_id)])

    def doubt(self) -> None:
        """Nothing is believed of the drive; `connect` brings it up as if it were new.

        Whether it is referenced is not forgotten: who homed it by hand says `was_homed()`.
        """
        self._is_doubted = True
        self.parameters.forget()
        self.objects.doubt()
        self.control.forget()


def _let_go(
    link: CanopenLink, node: DriveNode, options: HwOptions, guard: "Registration | None"
) -> None:
    if guard is not None:
        guard.cancel()
    node.close()
    if node.uses_host_heartbeat:
        link.release_heartbeat(options.host_node_id)
    release_link(link)
