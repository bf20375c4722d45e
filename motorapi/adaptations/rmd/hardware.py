"""The hardware class of a MyActuator RMD on CAN, in degrees of its output.

An RMD answers each request, and sends nothing by itself. So the host asks for angle, speed, mode
and errors all the time. Three traps of the protocol are handled here:

- Accelerations are written to ROM, and the least one is 100 deg/s². So the host streams every
  motion with accelerations of 0: the drive tracks set-points directly. They are read first, and
  written only if they differ.
- After a communication interruption the first request comes back unchanged, and is not obeyed. An
  echo of a reading would be an angle of 0: the first answer after a silence is not believed.
- Answers have no tag but the command: a command counts as obeyed when its own answer has come.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from struct import Struct
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.api import (
    CanDrive,
    ControlVariable,
    Fault,
    LinkError,
    Options,
    PeerError,
    PeriodicMessage,
    SentFrame,
    StreamedMotion,
    SyncOffer,
    checked_node,
    number,
)

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.api import BoundFence, Runtime

NODE_ID_MAX: Final = 32
UNTIL_RESTART: Final = 0x0002 | 0x0010 | 0x0080
ERRORS: Final = {
    **{0x0002: "stall", 0x0004: "under-voltage", 0x0008: "over-voltage", 0x0010: "over-current"},
    **{0x0040: "power overrun", 0x0080: "calibration parameters", 0x0100: "over-speed"},
    **{0x1000: "over-temperature of the motor", 0x2000: "encoder calibration"},
}

_REQUEST, _ANSWER, _ALL = 0x140, 0x240, 0x280
_I32: Final = Struct("<4xi")
_U32: Final = Struct("<4xI")
_READ_ACCELERATION, _WRITE_ACCELERATION, _MODE, _ANGLE = 0x42, 0x43, 0x70, 0x92
_STATUS_1, _STATUS_2, _RESET, _INTERRUPTED = 0x9A, 0x9C, 0x76, 0xF1
_POLLED: Final = (_ANGLE, _STATUS_2, _MODE, _STATUS_1)
_ACCELERATIONS: Final = 4  # by index: of positions, then of speeds, up and down
_OBEYED_S: Final = 0.3
_REPEAT_S: Final = 0.1
_CONNECT_S: Final = 3.0


class Command(IntEnum):
    """Commands that move or release the motor."""

    SHUTDOWN = 0x80
    STOP = 0x81
    CURRENT = 0xA1
    SPEED = 0xA2
    POSITION = 0xA4
    INCREMENT = 0xA8


class Estimate(NamedTuple):
    """Angle and speed of the output [deg, deg/s], and when the angle was complete [ns]."""

    angle: float
    speed: float
    time_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RmdOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    poll_period_ms: float = number(
        5.0,
        0.5,
        500.0,
        "ms",
        "Period of requests; every second one is the angle.",
        plausible=(1, 50),
    )
    timeout_ms: float = number(
        *(200.0, 0, 1e6, "ms", "Time without an angle after which the drive is lost."),
        above=True,
        plausible=(10.0, 5000.0),
    )
    stream_period_ms: float = number(
        5.0, 0.5, 500.0, "ms", "Period of streamed set-points.", plausible=(1.0, 50.0)
    )
    lead_ms: float = number(
        *(17.5, 0, 1000.0, "ms", "Lead of streamed positions: the lag of the drive."),
        plausible=(0.1, 200.0),
    )


@final
class RmdHwMotor:
    """One RMD on a CAN bus, by ID; shared by all logical motors and threads.

    Attributes:
        drive: its connection.
        motions: the motion that is streamed to it.
        estimate: the last measurement, or None.
        mode: the operating mode of the drive: 0 none, 1 current, 2 speed, 3 position; or None.
        fault: its fault until `reset_fault`, or None; errors of level 2 clear themselves.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this drive exists already, or a number is out of range.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        *,
        runtime: "Runtime | None" = None,
        options: RmdOptions | None = None,
    ) -> None:
        self.node_id: Final = checked_node(node_id, NODE_ID_MAX, "node_id of an RMD")
        self.options: Final = RmdOptions() if options is None else options
        self.estimate: Estimate | None = None
        self.mode: int | None = None
        self.fault: Fault | None = None
        self.errors: int = 0
        self.users = 0
        self._answers: dict[int, int] = {}  # number of answers by command
        self._acceleration: dict[int, int] = {}  # in its ROM, by index
        self._speed: float | None = None  # None: not known since the drive was lost
        self._mode_asked: int | None = None
        self._is_known = False
        self._doubts = True  # whether the next answer may be an echo
        self._turn = 0
        self.drive: Final = CanDrive(bus, node_id, self, runtime=runtime)
        self.label: Final = self.drive.label
        own = self.options
        self.motions: Final = StreamedMotion(
            self.drive, own.stream_period_ms / 1e3, own.lead_ms / 1e3
        )
        self._life = self.drive.expect("angle", self.options.timeout_ms / 1e3, self._lose)
        self.drive.handle(_ANSWER + node_id, self._on_answer)
        for can_id in (_REQUEST + node_id, _ALL):
            self.drive.handle(can_id, self._on_foreign)
        self.drive.every(self.options.poll_period_ms / 1e3, self._poll)

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self.drive.is_closed

    def close(self) -> None:
        """Stop sending and receiving."""
        self.drive.close(at_rest=not self.motions.is_going)
        self.motions.forget()

    def connect(self) -> None:
        """Wait until the drive answers, and read its accelerations.

        Raises:
            LinkError: it does not answer, or this object is closed, or the bus is off.
        """
        if self._is_up():
            return
        self._is_known = True
        lacks = "answer to 92h, 9Ah and 42h"
        self.drive.connect(self._is_up, self._greet, _CONNECT_S, lacks)
        period_s = self.options.poll_period_ms / 1e3
        self.drive.note_traffic(
            (PeriodicMessage(_ANSWER + self.node_id, 8, period_s / 2.0),),
            (PeriodicMessage(_REQUEST + self.node_id, 8, period_s / 2.0),),
        )

    def _is_up(self) -> bool:
        known = self.estimate is not None and self.mode is not None
        return known and len(self._acceleration) == _ACCELERATIONS and not self.drive.is_lost

    def _greet(self) -> None:
        for index in range(_ACCELERATIONS):
            self._ask(_READ_ACCELERATION, index)

    # --- commands: values as on the wire

    def tell(
        self, command: Command, data: bytes = bytes(7), fence: "BoundFence | None" = None
    ) -> SentFrame:
        """Send a command, only while this program owns the motor; do not wait for its answer.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor, or has low-level access.
        """
        return self.drive.command(_REQUEST + self.node_id, bytes((command,)) + data, fence=fence)

    def tell_anyway(self, command: int, data: bytes = bytes(7)) -> SentFrame:
        """Send a command whoever owns the motor: for stops."""
        return self.drive.stop_command(_REQUEST + self.node_id, bytes((command,)) + data)

    def obey(self, command: Command, data: bytes = bytes(7)) -> None:
        """Send a command, and wait for its answer; it is repeated if none comes.

        Raises:
            DeadlineExceeded: it has no answer.
        """
        before = self._answers.get(command, 0)
        self.drive.exchange(
            lambda: self.tell(command, data),
            lambda: self._answers.get(command, 0) > before,
            *(_OBEYED_S, f"answer to {command:02X}h", _REPEAT_S),
        )

    def track(self) -> None:
        """Set the accelerations to 0, unless they are, so that set-points are tracked directly.

        Raises:
            PeerError: the drive does not take them.
        """
        for index in range(_ACCELERATIONS):
            if self._acceleration.get(index) == 0:
                continue
            data = bytes((_WRITE_ACCELERATION, index)) + bytes(6)
            self.drive.confirm(self.drive.command(_REQUEST + self.node_id, data))
            self._acceleration.pop(index, None)
            self.drive.exchange(
                partial(self._ask, _READ_ACCELERATION, index),
                partial(self._acceleration.__contains__, index),
                *(_OBEYED_S, "answer to 42h", _REPEAT_S),
            )
            if self._acceleration[index] != 0:
                raise PeerError(
                    f"{self.label}: acceleration {index} is {self._acceleration[index]} deg/s²"
                    " after 0 was written; expected a drive of type V3; check its firmware"
                )

    def read_errors(self) -> int:
        """Return the errors that the drive reports now.

        Raises:
            DeadlineExceeded: it does not answer.
        """
        before = self._answers.get(_STATUS_1, 0)
        self.drive.exchange(
            partial(self._ask, _STATUS_1),
            lambda: self._answers.get(_STATUS_1, 0) > before,
            *(_OBEYED_S, "answer to 9Ah", _REPEAT_S),
        )
        return self.errors

    def restart(self) -> None:
        """Restart the drive (76h), which has no answer; needs the ownership."""
        data = bytes((_RESET,)) + bytes(7)
        self.drive.confirm(self.drive.command(_REQUEST + self.node_id, data))
        self._lose()

    def send(
        self, variable: ControlVariable, value: float, fence: "BoundFence | None"
    ) -> SentFrame:
        """Send a set-point in deg, deg/s or A."""
        raw = round(value * 100.0)
        if variable is ControlVariable.CURRENT:
            data = bytes(3) + raw.to_bytes(2, "little", signed=True) + bytes(2)
            return self.tell(Command.CURRENT, data, fence)
        is_position = variable is ControlVariable.POSITION
        data = bytes(3) + raw.to_bytes(4, "little", signed=True)  # speed limit 0: none
        return self.tell(Command.POSITION if is_position else Command.SPEED, data, fence)

    def stop_anyway(self) -> None:
        """Stop in closed loop, whoever owns the motor."""
        self.tell_anyway(Command.STOP)

    def forget(self) -> None:
        """Forget what the drive was told: another program commands it, or it was lost."""
        self.motions.forget()
        self.drive.doubt()

    def start_offer(self) -> SyncOffer:
        """Return the offer of a start by the first set-point."""
        return self.drive.start_offer(_REQUEST + self.node_id, 8)

    def measured(self) -> tuple[float, float]:
        """Return angle and speed now [deg, deg/s], extrapolated to the present."""
        last = self.estimate
        assert last is not None  # connected before
        age_s = (self.drive.runtime.now_ns() - last.time_ns) / 1e9
        return last.angle + last.speed * age_s, last.speed

    # --- requests and answers

    def _ask(self, command: int, index: int = 0) -> None:
        self.drive.request(_REQUEST + self.node_id, bytes((command, index)) + bytes(6))

    def _poll(self) -> None:
        if not self._is_known or self.drive.status.is_off:
            return
        self._turn += 1
        with suppress(LinkError):
            self._ask(_ANGLE if self._turn % 2 else _POLLED[1 + self._turn // 2 % 3])

    def _on_answer(self, data: bytes, time_ns: int) -> None:
        if len(data) != 8:
            return
        command = data[0]
        if command == _INTERRUPTED:
            self._doubts = True
            return
        if self._doubts:  # it may be the request itself
            self._doubts = False
            return
        self._answers[command] = self._answers.get(command, 0) + 1
        if command == _ANGLE:
            self._life.came(time_ns)
            if self._speed is not None:
                self.estimate = Estimate(_I32.unpack(data)[0] / 100.0, self._speed, time_ns)
        elif command in (_STATUS_2, Command.SPEED, Command.POSITION, Command.INCREMENT):
            self._speed = float(int.from_bytes(data[4:6], "little", signed=True))
        elif command == _MODE:
            self._mode_asked = data[7]  # valid from the next errors on: a fault is then known
        elif command == _READ_ACCELERATION and data[1] < _ACCELERATIONS:
            self._acceleration[data[1]] = _U32.unpack(data)[0]
        elif command == _STATUS_1:
            self._see_errors(int.from_bytes(data[6:], "little"), time_ns)
            self.mode = self._mode_asked

    def _see_errors(self, errors: int, time_ns: int) -> None:
        self.errors = errors
        if errors and (self.fault is None or self.fault.code != errors):
            named = [text for bit, text in ERRORS.items() if errors & bit]
            self.motions.forget()
            self.fault = Fault(errors, ", ".join(named) or "unknown error", time_ns)

    def _on_foreign(self, data: bytes, time_ns: int) -> None:
        """Handle a request of another program: those that move the motor end our motion."""
        if data[:1] == bytes((_WRITE_ACCELERATION,)):
            self._acceleration.clear()
            with suppress(LinkError):
                self._greet()
        elif data and (data[0] in tuple(Command) or data[0] in (_RESET, 0xA6)):
            self.forget()
            self.drive.overheard(f"request {data[0]:02X}h", time_ns)

    def _lose(self) -> None:
        self.forget()
        self._doubts = True
        self.estimate = self.mode = self._mode_asked = self._speed = None
        self._acceleration.clear()
