"""The hardware class of an ODrive: the whole drive, free of inheritance, in turns of its motor.

One object per physical motor and process. It knows what the drive is able to do, and nothing of
what an application means by it. What commands the drive goes out through `tell`, and nowhere else:
there it passes the fence (`motorapi.fencing`) and low-level access (`motorapi.low_level`).
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.turn_lock import TurnLock
from motorapi.errors import DeadlineExceeded, LinkError, PeerError, UsageError
from motorapi.fencing import NodeFence, announce
from motorapi.lock_names import bus_name
from motorapi.process_lock import ProcessLock, can_share_time
from motorapi.runtime import runtime_of, wait_until
from motorapi.sharing import (
    PhysicalMotor,
    RunStatus,
    bus_key,
    register_physical_motor,
    release_physical_motor,
)
from motorapi.traffic import NodeTraffic, PeriodicMessage, note_node
from motorhil_odrive.host import messages as m
from motorhil_odrive.host.heard import Heard, Heartbeat
from motorhil_odrive.host.options import OdriveOptions
from motorhil_odrive.host.wire import Sent, Wire

if TYPE_CHECKING:
    import can

    from motorapi.fencing import Fence
    from motorapi.runtime import Runtime
    from motorhil_odrive.host.messages import Message
    from motorhil_odrive.host.stream import Stream

NODE_ID_MAX: Final = 0x3E
_ASK_S: Final = 0.02
_ASK_VERSION_S: Final = 0.1
_ANSWER_S: Final = 0.2
# What moves a drive, or keeps it from moving: of others, it ends what goes on here.
_COMMANDS: Final = tuple(
    message.command
    for message in (
        *(m.ESTOP, m.AXIS_STATE, m.CONTROLLER_MODE, m.INPUT_POSITION, m.INPUT_VELOCITY),
        *(m.INPUT_TORQUE, m.REBOOT, m.DFU_MODE),
    )
)


@final
class OdriveHwMotor:
    """One ODrive on one CAN bus, by node-ID. Shared by all logical motors and threads.

    Args:
        bus: an open python-can bus, of whatever interface.
        node_id: the drive's, 0..62.
        runtime: where to wait; None: the bus's own (virtual time), else the wall's.
        options: see OdriveOptions.

    Attributes:
        physical: the record that its logical motors share.
        heard: what it said last.
        fence: lets out what commands the drive; None: no other process can take it over.
        stream: the set-points that it was given last; None: none were.
        held: the position that it was told to hold, or to go to [rev]; None: not known.
        quick_stopped: whether a quick stop was the last thing commanded to it.
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
        self._feeds = False  # whether we were the last to command it, of all programs
        self._connecting = TurnLock(self.runtime)
        where = bus_name(bus) if can_share_time(self.runtime) else None
        lock = None if where is None else ProcessLock(f"{where}-node{node_id}", self.label)
        self._key = (*bus_key(bus), node_id)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            self._key, self.label, self, lock
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
        """Nothing is sent or heard any more; the drive's watchdog stops it, if it has one."""
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
        release_physical_motor(self._key, self)
        self.heard.news.grow()

    def connect(self) -> None:
        """The drive is heard, and speaks the protocol we do; costs nothing if that is known.

        Raises:
            LinkError: it is not heard, or this object is closed, or the bus is off.
            PeerError: it speaks another protocol.
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
        """Raises LinkError if this object is closed."""
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")

    # --- what it is told ---------------------------------------------------------------------

    def tell(self, message: "Message", *values: float, fence: "Fence | None" = None) -> Sent:
        """The drive is told; only while this process owns the motor, if others can.

        Args:
            message: see `motorhil_odrive.host.messages`.
            values: of its signals.
            fence: of an ownership that a stream began under; None: the present one.

        Raises:
            LinkError: the bus does not take it.
            MotorBusyError: somebody else owns the motor, or has low-level access.
        """
        with self.physical.passage(self.label, of_holder=True):
            sent = self._wire.tell(message, *values, fence=self.fence if fence is None else fence)
        return self._noted(message, values, sent)

    def tell_anyway(self, message: "Message", *values: float) -> Sent:
        """As `tell`, whoever owns the motor: for stops, which take nobody's permission."""
        with self.physical.passage(self.label, of_holder=True):
            sent = self._wire.tell(message, *values)
        return self._noted(message, values, sent)

    def push(self, message: "Message", *values: float) -> Sent | None:
        """As `tell`, unless it was told the same already; None then."""
        return None if self.was_told(message, *values) else self.tell(message, *values)

    def was_told(self, message: "Message", *values: float) -> bool:
        """Whether the drive has this, by what may be believed of it."""
        return self.told(message) == values

    def told(self, message: "Message") -> tuple[float, ...] | None:
        """What it was told last of this, by what may be believed of it; None: nothing."""
        is_ours = self._told_at == self.physical.token
        return self._told.get(message.command) if is_ours else None

    def doubt(self) -> None:
        """Nothing is believed of what the drive was told."""
        self._told.clear()
        self.held = None

    def confirm(self, sent: Sent) -> int:
        """When it was on the wire [ns]. Raises LinkError: it was not."""
        return self._wire.confirm(sent)

    def _noted(self, message: "Message", values: tuple[float, ...], sent: Sent) -> Sent:
        """What it was told is believed of it, as long as nobody else commands it."""
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

    # --- what it is asked ----------------------------------------------------------------------

    def ask(self, message: "Message") -> tuple[float, ...]:
        """What the drive answers to a remote frame.

        Raises:
            DeadlineExceeded: it does not answer.
            LinkError: the bus does not take it.
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
        """A heartbeat comes soon; does not wait."""
        self._wire.ask(m.HEARTBEAT)

    def await_heartbeat(self, wanted: Callable[[Heartbeat], bool], timeout_s: float) -> Heartbeat:
        """The first heartbeat from now on that is wanted.

        Raises:
            DeadlineExceeded: it did not come within `timeout_s` [s].
        """
        since_ns = self.runtime.now_ns()
        end_ns = since_ns + round(timeout_s * 1e9)

        def is_there() -> bool:
            heard = self.heard.heartbeat
            return heard is not None and heard.time_ns > since_ns and wanted(heard)

        while True:
            self.ask_for_heartbeat()
            if wait_until(self.runtime, is_there, _ASK_S):
                assert self.heard.heartbeat is not None  # is_there has said so
                return self.heard.heartbeat
            if self.runtime.now_ns() >= end_ns:
                what = f"{self.label}: a heartbeat that shows what was commanded"
                told = f"{self.heard.heartbeat}"
                raise DeadlineExceeded(awaited=what, timeout_s=timeout_s, last_heard=told)

    # --- what goes on by itself ------------------------------------------------------------------

    def end_stream(self) -> None:
        """No more set-points come by themselves."""
        if self.stream is not None:
            self.stream.cancel()

    def _overheard(self, command: int, time_ns: int) -> None:
        """Somebody else has told the drive something: another program, or a person with a tool."""
        self.doubt()
        self._feeds = False  # its watchdog is that one's to feed
        physical, watch = self.physical, self.heard.watch
        moves = physical.run is not None and watch is not None and watch.moves
        if moves and command in _COMMANDS:
            self.end_stream()
            if physical.run is not None:
                physical.ownership.notice(physical.run.owner)  # who took it over is told by name
            physical.stopped_elsewhere(f"another program (message {command:02X}h)", time_ns)

    def _look(self) -> None:
        """The watchdog is fed by whoever commanded last; a drive that fell silent is lost."""
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
