"""The hardware class of an ODrive, in turns of its motor.

There is one object per physical motor and process. The class knows the drive's abilities, and
nothing of their use in an application.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.api import (
    CanDrive,
    LinkError,
    PeerError,
    PeriodicMessage,
    SentFrame,
    checked_node,
)

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.heard import Heard, Heartbeat
from motorhil_odrive.host.messages import decoded, encoded
from motorhil_odrive.host.options import OdriveOptions

if TYPE_CHECKING:
    import can
    from motorhil.motorapi.api import BoundFence, Runtime, SetpointStream

    from motorhil_odrive.host.messages import Message

NODE_ID_MAX: Final = 0x3E
_ASK_S: Final = 0.02
_ANSWER_S: Final = 0.2
# Commands that start or prevent motion: from another host they end an active motion.
_COMMANDS: Final = tuple(
    message.command
    for message in (
        *(m.ESTOP, m.AXIS_STATE, m.CONTROLLER_MODE, m.INPUT_POSITION, m.INPUT_VELOCITY),
        *(m.INPUT_TORQUE, m.REBOOT, m.DFU_MODE),
    )
)
_TO_DRIVE: Final = sorted(set(range(1 << 5)) - {one.command for one in m.TOLD_BY_DRIVE})


@final
class OdriveHwMotor:
    """One ODrive on a CAN bus, by node-ID; shared by all logical motors and threads.

    Args:
        bus: an open python-can bus with any interface.
        node_id: the drive's node-ID, 0..62.
        runtime: the runtime for waits; None: the bus's own (virtual time), else wall time.
        options: see OdriveOptions.

    Attributes:
        drive: its connection.
        heard: the last received messages.
        stream: the last streamed set-points, or None.
        held: the last commanded position [rev]; None: not known.
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
        checked_node(node_id, NODE_ID_MAX, "node_id of an ODrive")
        self.node_id: Final = node_id
        self.options: Final = OdriveOptions() if options is None else options
        self.stream: SetpointStream | None = None
        self.held: float | None = None
        self.users = 0
        self._feeds = False  # whether this program was the last to command the drive
        self.drive: Final = CanDrive(bus, node_id, self, runtime=runtime)
        self.label: Final = self.drive.label
        timeout_s = self.options.heartbeat_timeout_ms / 1e3
        self.heard: Final = Heard(self.drive, timeout_s, self._lose)
        for message in m.TOLD_BY_DRIVE:
            self.drive.handle(self._id_of(message), partial(self._on_message, message))
        for command in _TO_DRIVE:
            self.drive.handle(node_id << 5 | command, partial(self._overheard, command))
        self.drive.every(self.options.watchdog_feed_ms / 1e3, self._feed)

    def __repr__(self) -> str:
        heartbeat = self.heard.heartbeat
        what = "not heard" if heartbeat is None else f"axis state {heartbeat.state}"
        return f"<OdriveHwMotor {self.label}: {'closed' if self.is_closed else what}>"

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self.drive.is_closed

    def close(self) -> None:
        """Stop sending and receiving; the drive's watchdog stops it, if there is one."""
        watch = self.heard.watch
        self.drive.close(at_rest=watch is None or watch.is_over())
        self.end_stream()

    def connect(self) -> None:
        """Wait until the drive is heard, and check its protocol; free if this is known.

        Raises:
            LinkError: the drive is not heard, this object is closed, or the bus is off.
            PeerError: the drive uses another protocol version.
        """
        heard, timeout_s = self.heard, self.options.connect_timeout_s
        if heard.is_up() and not self.is_closed and not self.drive.status.is_off:
            return
        lacks = "heartbeat, estimate and version"
        self.drive.connect(heard.is_up, lambda: self._request(m.VERSION), timeout_s, lacks)
        protocol = 0 if heard.version is None else int(heard.version[0])
        if protocol != m.PROTOCOL:
            heard.version = None
            raise PeerError(
                f"{self.label}: it speaks version {protocol} of CANSimple, not {m.PROTOCOL}"
            )
        self._note_traffic()

    # --- commands ----------------------------------------------------------------------------

    def tell(
        self, message: "Message", *values: float, fence: "BoundFence | None" = None
    ) -> SentFrame:
        """Send a command to the drive, only while this process owns the motor.

        Args:
            message: see `motorhil_odrive.host.messages`.
            values: the values of its signals.
            fence: the fence of a stream's ownership; None: the present one.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor, or has low-level access.
        """
        sent = self.drive.command(self._id_of(message), encoded(message, *values), fence=fence)
        return self._noted(message, values, sent)

    def tell_anyway(self, message: "Message", *values: float) -> SentFrame:
        """Send a command whoever owns the motor: for stops, which need no ownership."""
        sent = self.drive.stop_command(self._id_of(message), encoded(message, *values))
        return self._noted(message, values, sent)

    def push(self, message: "Message", *values: float) -> SentFrame | None:
        """Send a command unless it was the last one of its kind; return None then."""
        return None if self.was_told(message, *values) else self.tell(message, *values)

    def was_told(self, message: "Message", *values: float) -> bool:
        """Return whether the drive is known to have these values."""
        return self.told(message) == values

    def told(self, message: "Message") -> tuple[float, ...] | None:
        """Return the last values sent with this message, if still valid, or None."""
        values: tuple[float, ...] | None = self.drive.remembered(message.command)
        return values

    def doubt(self) -> None:
        """Forget all values that were sent to the drive."""
        self.drive.doubt()
        self.held = None

    def _noted(self, message: "Message", values: tuple[float, ...], sent: SentFrame) -> SentFrame:
        """Remember sent values, which are valid until another program commands the drive."""
        self.drive.remember(message.command, values)
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
        answers = self.heard.answers

        def request() -> None:
            answers.pop(message.command, None)
            self._request(message)

        awaited = f"answer to {message.command:02X}h"
        self.drive.exchange(request, lambda: message.command in answers, _ANSWER_S, awaited)
        return answers[message.command]

    def ask_for_heartbeat(self) -> None:
        """Request a heartbeat; do not wait."""
        self._request(m.HEARTBEAT)

    def await_heartbeat(self, wanted: Callable[[Heartbeat], bool], timeout_s: float) -> Heartbeat:
        """Return the first heartbeat from now on that satisfies `wanted`.

        Raises:
            DeadlineExceeded: no such heartbeat came within `timeout_s` [s].
        """
        since_ns = self.drive.runtime.now_ns()

        def is_there() -> bool:
            heard = self.heard.heartbeat
            return heard is not None and heard.time_ns > since_ns and wanted(heard)

        awaited = "a heartbeat that shows what was commanded"
        self.drive.exchange(self.ask_for_heartbeat, is_there, timeout_s, awaited, repeat_s=_ASK_S)
        assert self.heard.heartbeat is not None  # checked by is_there
        return self.heard.heartbeat

    # --- background ----------------------------------------------------------------------------

    def end_stream(self) -> None:
        """End the stream of set-points."""
        if self.stream is not None:
            self.stream.cancel()

    def _id_of(self, message: "Message") -> int:
        return self.node_id << 5 | message.command

    def _request(self, message: "Message") -> None:
        self.drive.request(self._id_of(message), remote=message.length)

    def _on_message(self, message: "Message", data: bytes, time_ns: int) -> None:
        values = decoded(message, data)
        if values is not None:
            self.heard.hear(message, values, time_ns)

    def _overheard(self, command: int, _: bytes, time_ns: int) -> None:
        """Handle a command to the drive from another program, or from a tool."""
        self.doubt()
        self._feeds = False  # its watchdog is now fed by that program
        watch = self.heard.watch
        if command in _COMMANDS and watch is not None and watch.moves:
            self.end_stream()
            self.drive.overheard(f"message {command:02X}h", time_ns)

    def _lose(self) -> None:
        self._feeds = False
        self.doubt()

    def _feed(self) -> None:
        """Feed the drive's watchdog if this program commanded last."""
        if self._feeds and not self.drive.status.is_off:
            try:
                self.ask_for_heartbeat()
            except LinkError:
                self._feeds = False

    def _note_traffic(self) -> None:
        options = self.options
        heartbeat_s = min(options.watchdog_feed_ms / 1e3, _ASK_S)
        estimates_s = options.estimate_period_ms / 1e3
        heartbeat, estimates = self._id_of(m.HEARTBEAT), self._id_of(m.ESTIMATES)
        self.drive.note_traffic(
            sent=(
                PeriodicMessage(heartbeat, m.HEARTBEAT.length, heartbeat_s),
                PeriodicMessage(estimates, m.ESTIMATES.length, estimates_s),
            ),
            ours=(PeriodicMessage(heartbeat, 0, heartbeat_s),),
        )
