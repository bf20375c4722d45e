"""The hardware class of an ODrive, in turns of its motor.

There is one object per physical motor and process. The class knows the drive's abilities, and
nothing of their use in an application.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.motorapi.api import CanHardware, PeerError, SentFrame

from motorhil_odrive.host import messages as m
from motorhil_odrive.host.heard import Heard, Heartbeat
from motorhil_odrive.host.messages import decoded, encoded
from motorhil_odrive.host.options import OdriveOptions

if TYPE_CHECKING:
    from motorhil.motorapi.api import BoundFence, SetpointStream

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
class OdriveHwMotor(CanHardware[OdriveOptions]):
    """One ODrive on a CAN bus, by node-ID; see `CanHardware`.

    Attributes:
        heard: the last received messages.
        stream: the last streamed set-points, or None.
        held: the last commanded position [rev]; None: not known.
    """

    OPTIONS = OdriveOptions
    NOUN: ClassVar[str] = "an ODrive"
    NODE_ID_MAX: ClassVar[int] = NODE_ID_MAX
    LACKS: str = "heartbeat, estimate and version"

    def _begin(self) -> None:
        own, drive = self.options, self.drive
        self.CONNECT_S = own.connect_timeout_s
        self.stream: SetpointStream | None = None
        self.held: float | None = None
        self._feeds = False  # whether this program was the last to command the drive
        self.heard: Heard = Heard(drive, own.heartbeat_timeout_ms / 1e3, self._lose)
        for message in m.TOLD_BY_DRIVE:
            drive.handle(self._id_of(message), partial(self._on_message, message))
        for command in _TO_DRIVE:
            drive.handle(self.node_id << 5 | command, partial(self._on_foreign, command))
        drive.repeat(own.watchdog_feed_ms / 1e3, self._feed)
        drive.starts_by(self._id_of(m.INPUT_POSITION), m.INPUT_POSITION.length)

    def __repr__(self) -> str:
        heartbeat = self.heard.heartbeat
        what = "not heard" if heartbeat is None else f"axis state {heartbeat.state}"
        return f"<OdriveHwMotor {self.label}: {'closed' if self.is_closed else what}>"

    def _knows(self) -> bool:
        return self.heard.is_up()

    def _greet(self) -> None:
        self._request(m.VERSION)

    def _rests(self) -> bool:
        watch = self.heard.watch
        return watch is None or watch.is_over()

    def _connected(self) -> None:
        """Check its protocol (PeerError), and declare the traffic."""
        heard, options = self.heard, self.options
        protocol = 0 if heard.version is None else int(heard.version[0])
        if protocol != m.PROTOCOL:
            heard.version = None
            raise PeerError(
                f"{self.label}: it speaks version {protocol} of CANSimple, not {m.PROTOCOL}"
            )
        heartbeat_s = min(options.watchdog_feed_ms / 1e3, _ASK_S)
        heartbeat, estimates = self._id_of(m.HEARTBEAT), self._id_of(m.ESTIMATES)
        self.drive.note_frames(
            [
                (heartbeat, m.HEARTBEAT.length, heartbeat_s),
                (estimates, m.ESTIMATES.length, options.estimate_period_ms / 1e3),
            ],
            [(heartbeat, 0, heartbeat_s)],
        )

    def forget(self) -> None:
        """Send no more set-points, and forget what the drive was told."""
        self.end_stream()
        self._feeds = False
        self.doubt()

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

    def _on_foreign(self, command: int, _: bytes, time_ns: int) -> None:
        """Handle a command to the drive from another program, or from a tool."""
        self.doubt()
        self._feeds = False  # its watchdog is now fed by that program
        watch = self.heard.watch
        if command in _COMMANDS and watch is not None and watch.moves:
            self.overheard(f"message {command:02X}h", time_ns)

    def _feed(self) -> None:
        """Feed the drive's watchdog if this program commanded last."""
        if self._feeds:
            self.ask_for_heartbeat()
