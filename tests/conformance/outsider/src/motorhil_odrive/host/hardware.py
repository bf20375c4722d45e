"""The hardware class of an ODrive, in turns of its motor.

There is one object per physical motor and process. The class knows the drive's abilities, and
nothing of their use in an application. All commands to the drive pass through `tell`. There they
pass the fence (`motorhil.motorapi.ownership.fencing`) and low-level access
(`motorhil.motorapi.motor`).
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.turn_lock import TurnLock
from motorhil.motorapi.errors import DeadlineExceeded, LinkError, PeerError, UsageError
from motorhil.motorapi.locking.directory import bus_name
from motorhil.motorapi.locking.process_lock import ProcessLock, can_share_time
from motorhil.motorapi.ownership.fencing import NodeFence, announce
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.api import wait_until
from motorhil.motorapi.runtime.wall import runtime_of
from motorhil.motorapi.synchronization.bus_load import NodeTraffic, PeriodicMessage, note_node

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.heard import Heard, Heartbeat
from motorhil_odrive.host.options import OdriveOptions
from motorhil_odrive.host.wire import Sent, Wire

if TYPE_CHECKING:
    import can
    from motorhil.motorapi.ownership.fencing import Fence
    from motorhil.motorapi.runtime.api import Runtime

    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.stream import Stream

NODE_ID_MAX: Final = 0x3E
_ASK_S: Final = 0.02
_ASK_VERSION_S: Final = 0.1
_ANSWER_S: Final = 0.2
# Commands that start or prevent motion: from another host they end an active motion.
_COMMANDS: Final = tuple(
    message.command
    for message in (
        *(m.ESTOP, m.AXIS_STATE, m.CONTROLLER_MODE, m.INPUT_POSITION, m.INPUT_VELOCITY),
        *(m.INPUT_TORQUE, m.REBOOT, m.DFU_MODE),
    )
)


@final
class OdriveHwMotor:
    """One ODrive on a CAN bus, by node-ID; shared by all logical motors and threads.

    Args:
        bus: an open python-can bus with any interface.
        node_id: the drive's node-ID, 0..62.
        runtime: the runtime for waits; None: the bus's own (virtual time), else wall time.
        options: see OdriveOptions.

    Attributes:
        physical: the record that its logical motors share.
        heard: the last received messages.
        fence: passes commands to the drive; None: no other process can take the drive over.
        stream: the last streamed set-points, or None.
        held: the last commanded position [rev]; None: not known.
        quick_stopped: whether a quick stop was the last command.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this drive exists already; names it.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        *,
        runtime: "Runtime | None" = None,
        options: OdriveOptions | None = None,
    ) -> None:
        if not isinstance(node_id, int) or not 0 <= node_id <= NODE_ID_MAX:
            raise UsageError(f"node_id = {node_id!r}: an ODrive's is 0 to {NODE_ID_MAX}")
        self.runtime: Final = runtime_of(bus) if runtime is None else runtime
        self.node_id: Final = node_id
        self.options: Final = OdriveOptions() if options is None else options
        channel = getattr(bus, "channel", None)
        self.label: Final = f"{bus.channel_info if channel is None else channel} node {node_id}"
        self.stream: Stream | None = None
        self.held: float | None = None
        self.quick_stopped = self.is_closed = False
        self.users = 0
        self._bus = bus
        self._told: dict[int, tuple[float, ...]] = {}
        self._told_at = -1
        self._feeds = False  # whether this program was the last to command the drive
        self._connecting = TurnLock(self.runtime)
        where = bus_name(bus) if can_share_time(self.runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-node{node_id}", self.label)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            bus, node_id, self.label, self, lock
        )
        self.fence: Final = (
            None
            if lock is None
            else NodeFence(lock, self.physical.ownership, self.runtime, bus, node_id)
        )
        if lock is not None:
            announce(self.physical.ownership, bus, node_id)
        self._wire = Wire(
            bus, self.runtime, node_id, self.label, self._overheard, lambda: self.heard.news.grow()
        )
        self.heard: Final = Heard(self._wire, self.label, self.options.heartbeat_timeout_ms)
        self.physical.news = self.heard.news
        self._every = self.runtime.every(self.options.watchdog_feed_ms / 1e3, self._look)

    def __repr__(self) -> str:
        heartbeat = self.heard.heartbeat
        what = "not heard" if heartbeat is None else f"axis state {heartbeat.state}"
        return f"<OdriveHwMotor {self.label}: {'closed' if self.is_closed else what}>"

    def close(self) -> None:
        """Stop sending and receiving; the drive's watchdog stops it, if there is one."""
        if self.is_closed:
            return
        watch = self.heard.watch
        done = watch is None or watch.is_over()
        status = RunStatus.DONE if done else RunStatus.GOING
        self.physical.end(f"close() of {self.label}", self.runtime.now_ns(), status)
        self.is_closed = True
        self.end_stream()
        self._every.cancel()
        self._wire.close()
        release_physical_motor(self._bus, self.node_id, self)
        self.heard.news.grow()

    def connect(self) -> None:
        """Wait until the drive is heard, and check its protocol; free if this is known.

        Raises:
            LinkError: the drive is not heard, this object is closed, or the bus is off.
            PeerError: the drive uses another protocol version.
        """
        self.check_open()
        self._wire.status.check()
        heard, timeout_s = self.heard, self.options.connect_timeout_s
        if heard.is_up():
            return
        with self._connecting.turn(2 * timeout_s, f"{self.label}: connecting"):
            end_ns = self.runtime.now_ns() + round(timeout_s * 1e9)
            while not heard.is_up():
                if self.runtime.now_ns() >= end_ns:
                    reason = f"no heartbeat, estimate and version within {timeout_s:g} s"
                    raise LinkError(link=self.label, reason=reason)
                self._wire.ask(m.VERSION)
                wait_until(self.runtime, heard.is_up, _ASK_VERSION_S)
            protocol = 0 if heard.version is None else int(heard.version[0])
            if protocol != m.PROTOCOL:
                heard.version = None
                raise PeerError(
                    f"{self.label}: it speaks version {protocol} of CANSimple, not {m.PROTOCOL}"
                )
        self._note_traffic()

    def check_open(self) -> None:
        """Raise LinkError if this object is closed."""
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    # --- commands ----------------------------------------------------------------------------

    def tell(self, message: "Message", *values: float, fence: "Fence | None" = None) -> Sent:
        """Send a command to the drive, only while this process owns the motor.

        Args:
            message: see `motorhil_odrive.host.messages`.
            values: the values of its signals.
            fence: the fence of a stream's ownership; None: the present one.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor, or has low-level access.
        """
        with self.physical.passage(self.label, of_holder=True):
            sent = self._wire.tell(message, *values, fence=self.fence if fence is None else fence)
        return self._noted(message, values, sent)

    def tell_anyway(self, message: "Message", *values: float) -> Sent:
        """Send a command whoever owns the motor: for stops, which need no ownership."""
        with self.physical.passage(self.label, of_holder=True):
            sent = self._wire.tell(message, *values)
        return self._noted(message, values, sent)

    def push(self, message: "Message", *values: float) -> Sent | None:
        """Send a command unless it was the last one of its kind; return None then."""
        return None if self.was_told(message, *values) else self.tell(message, *values)

    def was_told(self, message: "Message", *values: float) -> bool:
        """Return whether the drive is known to have these values."""
        return self.told(message) == values

    def told(self, message: "Message") -> tuple[float, ...] | None:
        """Return the last values sent with this message, if still valid, or None."""
        is_ours = self._told_at == self.physical.token
        return self._told.get(message.command) if is_ours else None

    def doubt(self) -> None:
        """Forget all values that were sent to the drive."""
        self._told.clear()
        self.held = None

    def confirm(self, sent: Sent) -> int:
        """Return when the frame was on the bus [ns]; raise LinkError if it was not."""
        return self._wire.confirm(sent)

    def _noted(self, message: "Message", values: tuple[float, ...], sent: Sent) -> Sent:
        """Remember sent values, which are valid until another program commands the drive."""
        if self._told_at != self.physical.token:
            self._told.clear()
            self._told_at = self.physical.token
        self._told[message.command] = values
        self._feeds = True
        if message in (m.INPUT_POSITION, m.ABSOLUTE_POSITION):
            self.held = values[0]
        elif message in (m.INPUT_VELOCITY, m.INPUT_TORQUE, m.AXIS_STATE):
            self.held = None
        return sent

    # --- requests ------------------------------------------------------------------------------

    def ask(self, message: "Message") -> tuple[float, ...]:
        """Request a message by a remote frame, and return its values.

        Raises:
            DeadlineExceeded: the drive does not answer.
            LinkError: the bus does not accept the frame.
        """
        answers, found = self.heard.answers, []

        def is_there() -> bool:
            if message.command in answers:
                found.append(answers[message.command])
            return bool(found) or self._wire.status.is_off

        with self.physical.passage(self.label, of_holder=True):
            answers.pop(message.command, None)
            self._wire.ask(message)
            if not wait_until(self.runtime, is_there, _ANSWER_S):
                what = f"{self.label}: answer to {message.command:02X}h"
                heard = self._wire.status.trouble() or "nothing"
                raise DeadlineExceeded(awaited=what, timeout_s=_ANSWER_S, last_heard=heard)
        if not found:
            raise self._wire.status.failure()
        return found[-1]

    def ask_for_heartbeat(self) -> None:
        """Request a heartbeat; do not wait."""
        self._wire.ask(m.HEARTBEAT)

    def await_heartbeat(self, wanted: Callable[[Heartbeat], bool], timeout_s: float) -> Heartbeat:
        """Return the first heartbeat from now on that satisfies `wanted`.

        Raises:
            DeadlineExceeded: no such heartbeat came within `timeout_s` [s].
        """
        since_ns = self.runtime.now_ns()
        end_ns = since_ns + round(timeout_s * 1e9)

        def is_there() -> bool:
            heard = self.heard.heartbeat
            return heard is not None and heard.time_ns > since_ns and wanted(heard)

        while True:
            self.ask_for_heartbeat()
            if wait_until(self.runtime, is_there, _ASK_S):
                assert self.heard.heartbeat is not None  # checked by is_there
                return self.heard.heartbeat
            if self.runtime.now_ns() >= end_ns:
                what = f"{self.label}: a heartbeat that shows what was commanded"
                told = f"{self.heard.heartbeat}"
                raise DeadlineExceeded(awaited=what, timeout_s=timeout_s, last_heard=told)

    # --- background
    # --------------------------------------------------------------------------------

    def end_stream(self) -> None:
        """End the stream of set-points."""
        if self.stream is not None:
            self.stream.cancel()

    def _overheard(self, command: int, time_ns: int) -> None:
        """Handle a command to the drive from another program, or from a tool."""
        self.doubt()
        self._feeds = False  # its watchdog is now fed by that program
        physical, watch = self.physical, self.heard.watch
        moves = physical.run is not None and watch is not None and watch.moves
        if moves and command in _COMMANDS:
            self.end_stream()
            if physical.run is not None:
                physical.ownership.notice(physical.run.owner)  # the error then names the new owner
            physical.stopped_elsewhere(f"another program (message {command:02X}h)", time_ns)

    def _look(self) -> None:
        """Feed the watchdog if this program commanded last, and detect the loss of the drive."""
        if self.heard.look(self.runtime.now_ns()):
            self._feeds = False
            self.doubt()
        if self._feeds and not self._wire.status.is_off:
            try:
                self.ask_for_heartbeat()
            except LinkError:
                self._feeds = False

    def _note_traffic(self) -> None:
        first, options = self.node_id << 5, self.options
        heartbeat_s = min(options.watchdog_feed_ms / 1e3, _ASK_S)
        estimates_s = options.estimate_period_ms / 1e3
        sent = (
            PeriodicMessage(first | m.HEARTBEAT.command, m.HEARTBEAT.length, heartbeat_s),
            PeriodicMessage(first | m.ESTIMATES.command, m.ESTIMATES.length, estimates_s),
        )
        asked = PeriodicMessage(first | m.HEARTBEAT.command, 0, heartbeat_s)
        note_node(self._bus, self.node_id, NodeTraffic(sent=sent, ours=(asked,)))
