"""The adaptation of the motor interface to a MyActuator RMD, in degrees of its output.

| command                                  | request to the drive                                |
| ---------------------------------------- | --------------------------------------------------- |
| set-point or simple trajectory, position | A4h, streamed along the trapezoid, acceleration 0   |
| set-point or ramp, velocity              | A2h, streamed along the ramp, acceleration 0        |
| set-point or ramp, current               | A1h, streamed along the ramp                        |
| enable; disable                          | A4h to the present angle, which is held; 80h        |
| stop, halt, quick stop                   | A4h along a braking ramp, then held                 |
| reset of a fault                         | none, or 76h, which restarts the drive              |

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
from math import tau
from struct import Struct
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    ControlVariable,
    DeadlineExceeded,
    Estimate,
    LinkError,
    Motion,
    MotorModel,
    Options,
    PeerError,
    SentFrame,
    StreamedCanHardware,
    StreamedMotor,
    UsageError,
    adaptation,
    amount,
    number,
    output_sign,
    positive,
    text,
    texts_of,
    whole,
)

if TYPE_CHECKING:
    from motorhil.motorapi.api import BoundFence

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
_DEGREES: Final = 360.0 / tau
_DEGREES_MAX: Final = ((1 << 31) - 1) / 100.0
_CLEARED_S: Final = 2.0
_ASK_S: Final = 0.05


class Command(IntEnum):
    """Commands that move or release the motor."""

    SHUTDOWN = 0x80
    STOP = 0x81
    CURRENT = 0xA1
    SPEED = 0xA2
    POSITION = 0xA4
    INCREMENT = 0xA8


@dataclass(frozen=True, slots=True, kw_only=True)
class RmdOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    poll_period_ms: float = number(
        *(5.0, 0.5, 500.0, "ms", "Period of requests; every second one is the angle."),
        plausible=(1, 50),
    )
    timeout_ms: float = positive(
        *(200.0, "ms", "Time without an angle after which the drive is lost.", (10.0, 5000.0)),
        most=1e6,
    )
    stream_period_ms: float = number(
        5.0, 0.5, 500.0, "ms", "Period of streamed set-points.", plausible=(1.0, 50.0)
    )
    lead_ms: float = amount(
        17.5, "ms", "Lead of streamed positions: the lag of the drive.", (0.1, 200.0), most=1000.0
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class RmdTable(RmdOptions):
    """A motor behind an RMD."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Its ID.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class RmdHwMotor(StreamedCanHardware[RmdOptions]):
    """One RMD on a CAN bus, by ID; see `StreamedCanHardware`. Positions are in degrees.

    Attributes:
        mode: the operating mode of the drive: 0 none, 1 current, 2 speed, 3 position; or None.
        errors: those of its last status; errors of level 2 clear themselves.
    """

    OPTIONS = RmdOptions
    NOUN: ClassVar[str] = "an RMD"
    NODE_ID_MIN: ClassVar[int] = 1
    NODE_ID_MAX: ClassVar[int] = NODE_ID_MAX
    LACKS: str = "answer to 92h, 9Ah and 42h"

    def _begin(self) -> None:
        own, drive = self.options, self.drive
        self._stream(own.stream_period_ms, own.lead_ms)
        self.mode: int | None = None
        self.errors: int = 0
        self._acceleration: dict[int, int] = {}  # in its ROM, by index
        self._speed: tuple[float, int] | None = None  # and its time; None: none since a loss
        self._mode_asked: int | None = None
        self._is_known = False
        self._doubts = True  # whether the next answer may be an echo
        self._turn = 0
        self._life = drive.expect("angle", own.timeout_ms / 1e3, self._lose)
        drive.handle(_ANSWER + self.node_id, self._on_answer)
        for can_id in (_REQUEST + self.node_id, _ALL):
            drive.handle(can_id, self._on_foreign)
        drive.repeat(own.poll_period_ms / 1e3, self._poll)
        drive.starts_by(_REQUEST + self.node_id, 8)

    def _connected(self) -> None:
        period_s = self.options.poll_period_ms / 2e3
        answers, requests = ((one + self.node_id, 8, period_s) for one in (_ANSWER, _REQUEST))
        self.drive.note_frames([answers], [requests])

    def _knows(self) -> bool:
        has_heard = self.estimate is not None and self.mode is not None
        return has_heard and len(self._acceleration) == _ACCELERATIONS

    def _greet(self) -> None:
        self._is_known = True
        self._read_accelerations()

    def _read_accelerations(self) -> None:
        for index in range(_ACCELERATIONS):
            self._ask(_READ_ACCELERATION, index)

    @property
    def is_on(self) -> bool:
        """True if the drive is in an operating mode."""
        return bool(self.mode)

    # --- commands: values as on the wire

    def tell(
        self, command: int, data: bytes = bytes(7), fence: "BoundFence | None" = None
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

    def obey(self, command: int, data: bytes = bytes(7)) -> None:
        """Send a command, and wait for its answer; it is repeated if none comes.

        Raises:
            DeadlineExceeded: it has no answer.
        """
        awaited = f"answer to {command:02X}h"
        self.drive.ask(command, lambda: self.tell(command, data), _OBEYED_S, awaited, _REPEAT_S)

    def track(self) -> None:
        """Set the accelerations to 0, unless they are, so that set-points are tracked directly.

        Raises:
            PeerError: the drive does not take them.
        """
        for index in range(_ACCELERATIONS):
            if self._acceleration.get(index) == 0:
                continue
            self.drive.confirm(self.tell(_WRITE_ACCELERATION, bytes((index, *bytes(6)))))
            self._acceleration.pop(index, None)
            try:  # an answer to another program may tell the former value
                self.drive.exchange(
                    partial(self._ask, _READ_ACCELERATION, index),
                    partial(self._is_direct, index),
                    *(_OBEYED_S, "answer to 42h", _REPEAT_S),
                )
            except DeadlineExceeded:
                if index not in self._acceleration:
                    raise
                raise PeerError(
                    f"{self.label}: acceleration {index} is {self._acceleration[index]} deg/s²"
                    " after 0 was written; expected a drive of type V3; check its firmware"
                ) from None

    def _is_direct(self, index: int) -> bool:
        return self._acceleration.get(index) == 0

    def read_errors(self) -> int:
        """Return the errors that the drive reports now.

        Raises:
            DeadlineExceeded: it does not answer.
        """
        ask = partial(self._ask, _STATUS_1)
        self.drive.ask(_STATUS_1, ask, _OBEYED_S, "answer to 9Ah", _REPEAT_S)
        return self.errors

    def restart(self) -> None:
        """Restart the drive (76h), which has no answer; needs the ownership."""
        self.drive.confirm(self.tell(_RESET))
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

    # --- requests and answers

    def _ask(self, command: int, index: int = 0) -> None:
        self.drive.request(_REQUEST + self.node_id, bytes((command, index)) + bytes(6))

    def _poll(self) -> None:
        if self._is_known:
            self._turn += 1
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
        self.drive.answered(command)
        if command == _ANGLE:
            self._life.came(time_ns)
            speed = self._speed
            if speed is not None and time_ns - speed[1] < self.options.timeout_ms * 1e6:
                self.estimate = Estimate(_I32.unpack(data)[0] / 100.0, speed[0], time_ns)
        elif command in (_STATUS_2, Command.SPEED, Command.POSITION, Command.INCREMENT):
            self._speed = float(int.from_bytes(data[4:6], "little", signed=True)), time_ns
        elif command == _MODE:
            self._mode_asked = data[7]  # valid from the next errors on: a fault is then known
        elif command == _READ_ACCELERATION and data[1] < _ACCELERATIONS:
            self._acceleration[data[1]] = _U32.unpack(data)[0]
        elif command == _STATUS_1:
            self.errors = errors = int.from_bytes(data[6:], "little")
            self.see_fault(errors, texts_of(errors, ERRORS), time_ns)
            self.mode = self._mode_asked

    def _on_foreign(self, data: bytes, time_ns: int) -> None:
        """Handle a request of another program: those that move the motor end our motion."""
        if data[:1] == bytes((_WRITE_ACCELERATION,)):
            self._acceleration.clear()
            with suppress(LinkError):
                self._read_accelerations()
        elif data and (data[0] in tuple(Command) or data[0] in (_RESET, 0xA6)):
            self.overheard(f"request {data[0]:02X}h", time_ns)

    def _lose(self) -> None:
        super()._lose()
        self._doubts = True
        self.estimate = self.mode = self._mode_asked = self._speed = None
        self._acceleration.clear()


@final
class RmdMotor(StreamedMotor[RmdHwMotor]):
    """A logical motor on an RMD; several of them may share one hardware object.

    The drive's angles are those of its output, behind its own gear; of the model's gear ratio only
    the sign counts, for the direction.
    """

    def _units_of(self, model: MotorModel) -> float:
        return _DEGREES * output_sign(model)

    def _enable(self) -> None:
        hardware = self.hardware
        self._check_fault()
        if hardware.mode and hardware.motions.variable is not None:
            return  # it holds, after a quick stop
        hardware.track()
        self._hold()
        self._await_mode(True)
        self._check_fault()

    def _disable(self) -> None:
        self.hardware.motions.forget()
        self.hardware.obey(Command.SHUTDOWN)
        self._await_mode(False)

    def _await_mode(self, is_on: bool) -> None:
        hardware, left = self.hardware, 20
        while hardware.is_on != is_on and hardware.fault is None and left:
            left -= 1
            self.runtime.wait_until(lambda: hardware.is_on == is_on, _ASK_S)

    def _command(self, motion: Motion) -> None:
        if abs(motion.target * self._scale(motion.variable)) > _DEGREES_MAX:
            raise UsageError(
                f"{self.name}: {motion.target:g} does not fit 32 bits of 0.01 degrees; expected at"
                f" most {_DEGREES_MAX / _DEGREES:g}; move less far"
            )
        self.hardware.track()
        super()._command(motion)

    def _quantise(self, motion: Motion) -> Motion:
        return self._rounded(motion, 100.0 * self._scale(motion.variable))

    def _reset_fault(self) -> None:
        hardware = self.hardware
        if hardware.read_errors() & UNTIL_RESTART:
            hardware.restart()
            hardware.connect()
        hardware.await_clear(hardware.read_errors, _CLEARED_S)
        self._check_fault()

    def _position_source(self) -> str:
        return "multi-turn angle, answer 92h"


build: Final = adaptation(api=1)(CanBuilder(RmdTable, RmdHwMotor, RmdMotor, "RMD"))
