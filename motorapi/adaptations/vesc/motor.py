"""The adaptation of the motor interface to a VESC.

| command                                  | frames to the controller                             |
| ---------------------------------------- | ---------------------------------------------------- |
| set-point or simple trajectory, position | SET_POS, streamed along the trapezoid                |
| set-point or ramp, velocity              | SET_RPM, streamed along the ramp                     |
| set-point or ramp, current               | SET_CURRENT, streamed along the ramp                 |
| stop, halt, quick stop                   | SET_POS, streamed along a braking ramp, then held    |
| enable; disable                          | SET_POS to the present angle; SET_CURRENT 0          |

A VESC has no profile generator, acknowledges no command, and reports neither its mode nor a fault
in its status frames. So the host does three things at all times:

- It streams every motion (`SetpointStream`). A position is an angle within `position_turns` turns
  of the motor; the controller takes the shorter way, so that small steps go on over many turns.
- It asks for the fault. A fault clears itself after half a second; the host keeps it until
  `reset_fault`, so that no application misses it.
- It sends ALIVE while it is the last commander, as the controller releases its motor otherwise.

The position combines the angle (STATUS_4, fine, of few turns) and the tachometer (STATUS_5, coarse,
of all turns since power-on). At power-on it is 0 to a span of angles. A loss of frames does not
change the position at power-on; a restart does. The tachometer tells which it was, or the counter
of all ways since power-on, for which the host asks after a gap, or a notice of the drive.

After those, the position is told once the motor rests: while it turns, an angle that comes late is
not of the same time as the tachometer.

Source: vedderb/bldc b9d287b3 (firmware 7.01), documentation/comm_can.md.
"""

from binascii import crc_hqx
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from struct import Struct
from typing import TYPE_CHECKING, ClassVar, Final, final

from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    ControlVariable,
    Estimate,
    LinkError,
    Motion,
    MotorError,
    MotorModel,
    Options,
    PeerError,
    SentFrame,
    StreamedCanHardware,
    StreamedMotor,
    UsageError,
    adaptation,
    amount,
    motor_turns,
    number,
    positive,
    text,
    whole,
)

if TYPE_CHECKING:
    from motorhil.motorapi.api import BoundFence

NODE_ID_MAX: Final = 254
FOLLOWING_ERROR: Final = 0x8611  # found by the host; the number is that of CiA 402
FIRMWARES: Final = (6, 7)  # major versions with the frames used here
FAULTS: Final = {
    **{1: "over voltage", 2: "under voltage", 3: "gate driver", 4: "absolute over current"},
    **{5: "over temperature of the MOSFETs", 6: "over temperature of the motor"},
    **{7: "gate driver over voltage", 8: "gate driver under voltage", 9: "MCU under voltage"},
    **{10: "booting from watchdog reset", 11: "encoder SPI", 12: "encoder below minimum"},
    **{13: "encoder above maximum", 14: "flash corruption", 15: "offset of current sensor 1"},
    **{16: "offset of current sensor 2", 17: "offset of current sensor 3"},
    **{18: "unbalanced currents", 19: "brake", 20: "resolver LOT", 21: "resolver DOS"},
    **{22: "resolver LOS", 23: "flash corruption of the app", 24: "flash corruption of the motor"},
    **{25: "encoder without magnet", 26: "encoder magnet too strong", 27: "phase filter"},
    **{28: "encoder", 29: "LV output", 30: "encoder slip", 31: "overspeed", 32: "underspeed"},
    33: "absolute overspeed",
}

_STATUS, _STATUS_4, _STATUS_5, _NOTIFY_BOOT = 9, 16, 27, 57
_FILL, _PROCESS, _SHORT = 5, 7, 8
_FW_VERSION, _SELECTIVE, _ALIVE = 0, 50, 30
_VERSION_BYTES: Final = 3  # at least: packet, major, minor
_FAULT_MASK: Final = bytes((_SELECTIVE, 0, 0, 0x80, 0))
_WAY_MASK: Final = bytes((_SELECTIVE, 0, 0, 0x40, 0))  # the tachometer of all ways
_COMMANDS: Final = (*range(5), *range(10, 14))  # that move or stop the motor
_MOVING: Final = (*range(5, 11), 29, 84, 159)  # packets that move or stop the motor
_ERPM: Final = Struct(">i4x")
_ANGLE: Final = Struct(">6xh")
_TACHOMETER: Final = Struct(">i4x")
_VALUE: Final = Struct(">i")
_STATUS_S: Final = 0.01  # least usual period of the status frames
_PACKET_S: Final = 0.025  # of ALIVE, and of asking for the fault, in turns
_NEAR: Final = 0.05  # turns: a position so little below a span is one below 0
_LEAST_WAY: Final = 1.0  # turns by which the counter of all ways must be less after a restart
_JUMP: Final = 0.5  # turns by which two tachometers in succession disagree with the velocity
_FOLLOW_MAX: Final = 0.45  # of the span of positions: at 0.5 the shorter way is the wrong one
_ANSWER_S: Final = 0.2
_SILENCE_S: Final = 0.5  # without an answer: the drive does not hear the host
_BOOTED_NS: Final = 1_000_000_000
_NOTICE_NS: Final = 480_000_000  # the least time from a start to its notice
_GAP_NS: Final = 40_000_000  # without STATUS, and twice its period before
_LATE_NS: Final = 400_000_000  # an angle so late and a tachometer in time are not of one position
_ERPM_MAX: Final = 2**31 - 1
_SPAN_MAX: Final = 0.4  # of a turn of positions, within the lead and period of a stream
_FAULT_STOP_S: Final = 2.0  # a fault clears itself after 0.5 s, unless its cause lasts
_ARRIVAL_S: Final = 2.0  # after the last set-point


class Mode(IntEnum):
    """The commands that this adaptation sends, with the scale of their number."""

    CURRENT = 1
    BRAKE = 2
    SPEED = 3
    POSITION = 4


MODES: Final = {
    ControlVariable.POSITION: Mode.POSITION,
    ControlVariable.VELOCITY: Mode.SPEED,
    ControlVariable.CURRENT: Mode.CURRENT,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class VescOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    host_id: int | None = whole(
        None, 0, 254, "", "Own id on the bus, of no other node; absent: 128 + node_id."
    )
    pole_pairs: int = whole(7, 1, 1000, "", "ERPM per rpm, as configured (motor poles / 2).")
    position_turns: float = positive(
        1.0, "", "Turns of the motor in 360 degrees of position.", most=1e6
    )
    erpm_min: float = amount(900.0, "", "Least ERPM of speed control, as configured.")
    stream_period_ms: float = number(
        5.0, 0.1, 500.0, "ms", "Period of streamed set-points.", plausible=(1.0, 50.0)
    )
    lead_ms: float = amount(
        *(16.5, "ms", "Lead of streamed positions: kd / kp, and half a period.", (0.1, 200.0)),
        most=1000.0,
    )
    status_timeout_ms: float = positive(
        *(200.0, "ms", "Time without one of its STATUS, 4 or 5 until it is lost.", (10.0, 5000.0)),
        most=1e6,
    )
    brake_current_a: float = amount(
        *(10.0, "A", "Brake current of a stop by a program that does not own the motor."),
        *((0.01, 1000.0),),
        most=1e4,
    )


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class VescTable(VescOptions):
    """A motor behind a VESC."""

    node_id: int = whole(REQUIRED, 0, NODE_ID_MAX, "", "Controller id.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class VescHwMotor(StreamedCanHardware[VescOptions]):
    """One VESC on a CAN bus, by controller id; see `StreamedCanHardware`. Positions are in turns.

    Attributes:
        held: the last position sent [turns]; None: positions are not controlled.
    """

    OPTIONS = VescOptions
    NOUN: ClassVar[str] = "a VESC"
    NODE_ID_MAX: ClassVar[int] = NODE_ID_MAX
    LACKS: str = "STATUS, STATUS_4 and STATUS_5"
    EXTENDED: ClassVar[bool] = True

    def _begin(self) -> None:
        own, node_id = self.options, self.node_id
        self._host_id = 128 + node_id if own.host_id is None else own.host_id
        if self._host_id > NODE_ID_MAX or self._host_id == node_id:
            raise UsageError(
                f"host_id = {self._host_id} for node_id {node_id}: not usable; expected a free id"
                f" of 0 to {NODE_ID_MAX}; give host_id"
            )
        self._stream(own.stream_period_ms, own.lead_ms)
        self.held: float | None = None
        self.has_reported: bool = False
        self._reported = 0  # fault code of the last report
        self._firmware: tuple[int, int] | None = None
        self._velocity: float | None = None  # None: not known since the drive was lost
        self._angle: float | None = None
        self._angle_ns = 0
        self._power_on: float | None = None  # position at power-on [turns], 0 to a span
        self._tachometer = (0.0, 0.0, 0)  # the last one [turns], velocity then, time [ns]
        self._way = 0.0  # all ways since the position at power-on is known, at least [turns]
        self._is_kept = False  # whether the position at power-on is from before the last loss
        self._rested: tuple[float, float, int] | None = None  # angle, turns [turns], since [ns]
        self._packet = b""
        self._since_ns = 0  # first frame since the drive was lost
        self._status_ns = self._period_ns = 0  # of the last STATUS
        self._gap_ns = 0  # last first STATUS after a gap
        self._asks = self._is_known = False  # whether it was connected once
        self._feeds = False  # whether this program was the last to command the drive
        self._life, self._angles, self._counts = (
            self.drive.expect(name, own.status_timeout_ms / 1e3, self._lose)
            for name in ("STATUS", "STATUS_4", "STATUS_5")
        )
        self._answers = self.drive.expect("answer to GET_VALUES_SELECTIVE", _SILENCE_S)
        self._listen()
        self.drive.repeat(_PACKET_S, self._keep_alive)
        self.drive.starts_by(Mode.POSITION << 8 | node_id, _VALUE.size)  # as all set-points

    def _listen(self) -> None:
        own, host = self.node_id, self._host_id
        handlers: dict[int, Callable[[bytes, int], None]] = {
            _STATUS << 8 | own: self._on_status,
            _STATUS_4 << 8 | own: self._on_angle,
            _STATUS_5 << 8 | own: self._on_tachometer,
            _NOTIFY_BOOT << 8 | own: self._on_boot,
            _SHORT << 8 | own: self._on_foreign_packet,
            _SHORT << 8 | host: self._on_answer,
            _FILL << 8 | host: self._on_part,
            _PROCESS << 8 | host: self._on_end,
            **{one << 8 | own: partial(self._on_foreign, one) for one in _COMMANDS},
        }
        for can_id, handler in handlers.items():
            self.drive.handle(can_id, handler)

    def connect(self) -> None:
        """Wait until the drive is heard, and check its firmware; free if this is known.

        Raises:
            LinkError: the drive is not heard, or this object is closed, or the bus is off.
            PeerError: its status frames are off, or its firmware is not known, or its motor turns
                after a loss or restart.
        """
        try:
            super().connect()
        except LinkError as error:
            if self._firmware is None or self.drive.is_closed or self.drive.status.is_off:
                raise
            if self._rested is not None:
                raise PeerError(
                    f"{self.label}: its motor turns since the drive was lost or has restarted, so"
                    " that its position is not known; expected rest; bring it to rest"
                ) from error
            raise PeerError(
                f"{self.label}: it answers, but sends no {self.LACKS} within {self.CONNECT_S:g} s;"
                " expected bits 0, 3 and 4 of its CAN status messages, which are off by default;"
                " set them (VESC Tool: App Settings, General, CAN Status Messages)"
            ) from error

    def _connected(self) -> None:
        assert self._firmware is not None  # of _knows
        major, minor = self._firmware
        if major not in FIRMWARES:
            self._firmware = None
            known = " and ".join(f"{one}.x" for one in FIRMWARES)
            raise PeerError(
                f"{self.label}: firmware {major}.{minor:02d} is not supported; expected {known};"
                " update it"
            )
        self._is_known = True
        own, stream_s = self.node_id, self.options.stream_period_ms / 1e3
        self.drive.note_frames(
            [(one << 8 | own, 8, _STATUS_S) for one in (_STATUS, _STATUS_4, _STATUS_5)],
            [(Mode.POSITION << 8 | own, 4, stream_s), (_SHORT << 8 | own, 7, _PACKET_S)],
        )

    def _knows(self) -> bool:
        return self._firmware is not None and self.estimate is not None and self.has_reported

    @property
    def is_on(self) -> bool:
        """True while this program controls the motor."""
        return self.motions.variable is not None

    # --- commands: values in A, turns/s, turns

    def tell(self, mode: Mode, value: float, fence: "BoundFence | None" = None) -> SentFrame:
        """Send a command, only while this program owns the motor.

        Raises:
            LinkError: the bus does not accept the frame.
            MotorBusyError: another user owns the motor, or has low-level access.
        """
        sent = self.drive.command(mode << 8 | self.node_id, self._encoded(mode, value), fence=fence)
        self._feeds = True
        self.held = value if mode is Mode.POSITION else None
        return sent

    def release(self) -> SentFrame:
        """Release the motor, which then coasts."""
        self.motions.forget()
        return self.tell(Mode.CURRENT, 0.0)

    def stop_anyway(self) -> SentFrame:
        """Brake, whoever owns the motor."""
        data = self._encoded(Mode.BRAKE, self.options.brake_current_a)
        return self.drive.stop_command(Mode.BRAKE << 8 | self.node_id, data)

    def send(
        self, variable: ControlVariable, value: float, fence: "BoundFence | None"
    ) -> SentFrame:
        """Send a set-point in turns, turns/s or A."""
        return self.tell(MODES[variable], value, fence)

    def scale(self, mode: Mode) -> float:
        """Return the number of a command for 1 of its value."""
        if mode is Mode.SPEED:
            return 60.0 * self.options.pole_pairs
        return 360e6 / self.options.position_turns if mode is Mode.POSITION else 1e3

    def _encoded(self, mode: Mode, value: float) -> bytes:
        raw = round(value * self.scale(mode))
        return _VALUE.pack(raw % 360_000_000 if mode is Mode.POSITION else raw)

    # --- requests

    def read_fault(self) -> int:
        """Return the fault code that the drive reports now; 0: none.

        Raises:
            DeadlineExceeded: it does not answer.
        """
        ask = partial(self._ask, _FAULT_MASK)
        self.drive.ask(_SELECTIVE, ask, _ANSWER_S, "answer to GET_VALUES_SELECTIVE", _PACKET_S)
        return self._reported

    def _ask(self, packet: bytes, mode: int = 0) -> None:
        """Send a packet that only reads or keeps alive; do not wait."""
        data = bytes((self._host_id, mode)) + packet
        self.drive.request(_SHORT << 8 | self.node_id, data)

    def _greet(self) -> None:
        self._ask(bytes((_FW_VERSION,)))
        self._ask(_FAULT_MASK)

    def _keep_alive(self) -> None:
        """Feed the drive's timeout and ask for its fault, in turns."""
        self._asks = not self._asks
        if self._is_known and self._asks:
            self._ask(_FAULT_MASK)
        elif self._is_known and self._feeds:
            self._ask(bytes((_ALIVE,)), mode=2)

    # --- frames of the drive

    def _on_status(self, data: bytes, time_ns: int) -> None:
        if len(data) == _ERPM.size:
            self._velocity = _ERPM.unpack(data)[0] / (60.0 * self.options.pole_pairs)
            elapsed_ns = time_ns - self._status_ns
            if self._life.came(time_ns):
                self._since_ns = time_ns
            elif elapsed_ns > max(_GAP_NS, 2 * self._period_ns):
                self._gap_ns = time_ns
                with suppress(LinkError):
                    self._ask(_WAY_MASK)
            self._status_ns, self._period_ns = time_ns, elapsed_ns

    def _on_angle(self, data: bytes, time_ns: int) -> None:
        if len(data) == _ANGLE.size:
            self._angle = _ANGLE.unpack(data)[0] / 18_000.0 * self.options.position_turns
            self._angle_ns = time_ns
            self._angles.came(time_ns)

    def _on_tachometer(self, data: bytes, time_ns: int) -> None:
        angle, velocity, span = self._angle, self._velocity, self.options.position_turns
        if len(data) != _TACHOMETER.size:
            return
        self._counts.came(time_ns)
        if angle is None or velocity is None:
            return
        turns = (_TACHOMETER.unpack(data)[0] + 0.5) / (6.0 * self.options.pole_pairs)
        if self.estimate is not None and self._begins_anew(turns, velocity, time_ns):
            self._restart()
            self._since_ns = time_ns
            return
        offset = angle + velocity * (time_ns - self._angle_ns) / 1e9 - turns
        power_on, is_doubtful = self._power_on, self._is_kept and self.estimate is None
        if power_on is None or (
            is_doubtful and self._has_restarted(offset - power_on, turns, velocity, time_ns)
        ):
            if self._is_known and not self._has_rested(angle, turns, time_ns):
                return
            power_on = (offset + _NEAR) % span - _NEAR
            self._power_on = power_on
            self._is_kept = False
        if self.estimate is not None:
            self._way += abs(turns - self._tachometer[0])
        self._tachometer = turns, velocity, time_ns
        position = angle + span * round((power_on + turns - angle) / span)
        before = self.estimate
        if before is not None:
            possible = abs(velocity) + abs(before.velocity)
            possible *= (time_ns - before.time_ns) / 1e9
            if abs(position - before.position) > _FOLLOW_MAX * span + possible:
                self._restart()
                return
        self.estimate = Estimate(position, velocity, time_ns)
        self._check_following(position)

    def _has_rested(self, angle: float, turns: float, now_ns: int) -> bool:
        """Return whether both have been the same for as long as one of them may be late."""
        then = self._rested
        if then is None or max(abs(angle - then[0]), abs(turns - then[1])) > _NEAR:
            self._rested = then = angle, turns, now_ns
        return now_ns - then[2] >= _LATE_NS

    def _has_restarted(self, change: float, turns: float, velocity: float, now_ns: int) -> bool:
        """Return whether the first tachometer after a loss begins anew.

        `change` is that of the position at power-on, as it seems, and may be off by whole spans.
        """
        span, speed = self.options.position_turns, abs(velocity)
        before, velocity_then, time_ns = self._tachometer
        difference = (change + span / 2.0) % span - span / 2.0
        possible = 1.0 + (speed + abs(velocity_then)) * (now_ns - time_ns) / 1e9
        return abs(difference) > _NEAR + speed * _STATUS_S or abs(turns - before) > possible

    def _begins_anew(self, turns: float, velocity: float, now_ns: int) -> bool:
        """Return whether the tachometer has jumped to its value at power-on, 0."""
        before, velocity_then, time_ns = self._tachometer
        elapsed_s = (now_ns - time_ns) / 1e9
        expected = before + 0.5 * (velocity + velocity_then) * elapsed_s
        possible = _JUMP + abs(velocity - velocity_then) * elapsed_s
        return abs(turns) <= _JUMP + abs(velocity) * elapsed_s and abs(turns - expected) > possible

    def _check_following(self, position: float) -> None:
        """Stop a motion whose motor is so far behind that the controller would turn back."""
        limit = _FOLLOW_MAX * self.options.position_turns
        if self.held is not None and abs(self.held - position) >= limit:
            self.fail(f"the motor is {limit:.3g} turns or more off its set-point")

    def fail(self, problem: str) -> None:
        """Report a following error, and brake."""
        self._see_fault(FOLLOWING_ERROR, problem)
        with suppress(MotorError):
            self.stop_anyway()

    def _see_fault(self, code: int, problem: str) -> None:
        if code:
            self.held = None
        self.see_fault(code, problem, self.drive.runtime.now_ns())

    def _on_boot(self, data: bytes, time_ns: int) -> None:
        """Note a restart; the notice of a start comes half a second after the first frames.

        So a drive that was heard before a gap, half a second ago or earlier, started in that gap.
        """
        has_gap = self._since_ns < self._gap_ns <= time_ns - _NOTICE_NS
        if has_gap or time_ns - self._since_ns > _BOOTED_NS or self._is_kept:
            self._restart()

    def _on_answer(self, data: bytes, time_ns: int) -> None:
        if data[:1] != bytes((self.node_id,)) or data[2:7] != _FAULT_MASK or len(data) < 8:
            return
        self.has_reported = True
        self.drive.answered(_SELECTIVE)
        self._answers.came(time_ns)
        self._reported = data[7]
        self._see_fault(data[7], FAULTS.get(data[7], "unknown fault"))

    def _on_part(self, data: bytes, time_ns: int) -> None:
        if data[:1] == b"\0":
            self._packet = data[1:]
        elif data and data[0] == len(self._packet):  # so it never grows beyond 262 bytes
            self._packet += data[1:]

    def _on_end(self, data: bytes, time_ns: int) -> None:
        packet, self._packet = self._packet, b""
        told = int.from_bytes(data[2:4], "big"), int.from_bytes(data[4:6], "big")
        is_whole = told == (len(packet), crc_hqx(packet, 0)) and len(packet) >= _VERSION_BYTES
        if data[:1] != bytes((self.node_id,)) or not is_whole:
            return
        if packet[0] == _FW_VERSION:
            self._firmware = packet[1], packet[2]
        elif packet[: len(_WAY_MASK)] == _WAY_MASK and self.estimate is not None:
            way = int.from_bytes(packet[len(_WAY_MASK) :], "big") / (6.0 * self.options.pole_pairs)
            if way < self._way - _LEAST_WAY:
                self._restart()
                self._since_ns = time_ns

    # --- frames of other programs

    def _on_foreign(self, command: int, data: bytes, time_ns: int) -> None:
        self.overheard(f"command {command}", time_ns)

    def _on_foreign_packet(self, data: bytes, time_ns: int) -> None:
        if len(data) > 2 and data[2] in _MOVING:
            self.overheard(f"packet {data[2]}", time_ns)

    def forget(self) -> None:
        """Forget what the drive was told: another program commands it, or it was lost."""
        super().forget()
        self._feeds = False
        self.held = None

    def _lose(self) -> None:
        super()._lose()
        self._firmware = self._angle = self._velocity = self.estimate = None
        self._rested = None
        self.has_reported = False
        self._is_kept = self._power_on is not None

    def _restart(self) -> None:
        """Forget also what began anew with the drive."""
        self._power_on = None
        self._way = 0.0
        self._lose()


@final
class VescMotor(StreamedMotor[VescHwMotor]):
    """A logical motor on a VESC; several of them may share one hardware object."""

    def _units_of(self, model: MotorModel) -> float:
        return motor_turns(model)

    def _enable(self) -> None:
        hardware = self.hardware
        self._check_fault()
        if hardware.is_on:
            return  # it holds, after a quick stop
        self._hold()
        hardware.read_fault()
        self._check_fault()

    def _disable(self) -> None:
        self.hardware.drive.confirm(self.hardware.release())

    def _command(self, motion: Motion) -> None:
        self._check_speed(motion)
        super()._command(motion)

    def _check_speed(self, motion: Motion) -> None:
        """Refuse speeds that the controller cannot follow.

        Raises:
            UsageError: too fast for streamed positions or for 32 bits, or too slow for speed
                control.
        """
        own = self.hardware.options
        if motion.variable is ControlVariable.POSITION:
            ahead_s = (own.lead_ms + own.stream_period_ms) / 1e3
            most = _SPAN_MAX * own.position_turns / (ahead_s * abs(self._units))
            if motion.velocity > most:
                raise UsageError(
                    f"{self.name}: a velocity of {motion.velocity:.4g} per s is too high for"
                    f" positions; expected at most {most:.4g} with position_turns ="
                    f" {own.position_turns:g}, as the controller takes the shorter way;"
                    " move slower, or configure a larger span"
                )
        elif motion.variable is ControlVariable.VELOCITY:
            erpm = round(abs(motion.target * self._units) * self.hardware.scale(Mode.SPEED))
            if erpm > _ERPM_MAX:
                raise UsageError(
                    f"{self.name}: a velocity of {motion.target:.4g} per s is {erpm} ERPM;"
                    f" expected at most {_ERPM_MAX} ERPM, 32 bits; correct the motor model"
                )
            if 0 < erpm < own.erpm_min:
                raise UsageError(
                    f"{self.name}: a velocity of {motion.target:.4g} per s is {erpm} ERPM;"
                    f" expected 0, or at least {own.erpm_min:g} ERPM; configure s_pid_min_erpm, and"
                    " set erpm_min"
                )

    # --- capabilities

    def _quantise(self, motion: Motion) -> Motion:
        step = self._scale(motion.variable) * self.hardware.scale(MODES[motion.variable])
        return self._rounded(motion, step)

    def _reset_fault(self) -> None:
        self.hardware.await_clear(self.hardware.read_fault, _FAULT_STOP_S)
        self._check_fault()

    def _is_done(self) -> bool:
        hardware, is_over = self.hardware, super()._is_done()
        is_late = not hardware.motions.is_going and hardware.motions.since_end_s > _ARRIVAL_S
        if not is_over and hardware.held is not None and is_late:
            window = f"{self.model.start_tolerance:.3g} {self.model.unit}"
            hardware.fail(f"the motor did not reach its target within {window}")
            self._check_fault()
        return is_over

    def _position_source(self) -> str:
        return "angle of STATUS_4 (10h) with the turns of STATUS_5 (1Bh)"


build: Final = adaptation(api=1)(CanBuilder(VescTable, VescHwMotor, VescMotor, "VESC"))
