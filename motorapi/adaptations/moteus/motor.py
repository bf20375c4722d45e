"""The adaptation to a moteus: position and velocity, with the trajectories on board.

A moteus sends nothing by itself, so the hardware object asks it periodically. While a motion goes
on, it repeats the whole command instead, which feeds the watchdog of the drive: without the host,
the drive stops. At the target, a command without a watchdog holds the position, so that an idle
motor needs no program. After a timeout, the motor has current but holds no position; its state is
STOPPED until `enable`.

Source: mjbots/moteus, docs/protocol/can.md and docs/protocol/registers.md.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isnan, nan, tau
from struct import Struct
from typing import ClassVar, Final, NamedTuple, final

from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    CanHardware,
    CanMotor,
    ControlMode,
    ControlVariable,
    Fault,
    LinkError,
    Measurement,
    Motion,
    MotionKind,
    MotionTimes,
    MotorBusyError,
    MotorModel,
    MotorState,
    Options,
    PeerError,
    SentFrame,
    SettingError,
    adaptation,
    motor_turns,
    positive,
    require_here,
    text,
    whole,
)

STOPPED, FAULT, POSITION, TIMEOUT = 0, 1, 10, 11  # modes
_OTHERS: Final = (12, 13, 15)  # with current: zero velocity, stay within, brake
NODE_ID_MAX: Final = 126
REGISTER_MAP: Final = 5
_REPLY: Final = 0x8000
_BROADCAST: Final = 0x7F
_EXTENDED: Final = 0x8000_0000
_BRS: Final = 1
_STANDARD: Final = 0x7FF
_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # of CAN FD
# Read 000 as int8; 001..003 as float; 00B, 00C and 00F as int8; 038 as float.
_QUERY: Final = bytes.fromhex("1100 1f01 120b 110f 1d38")
_STATUS: Final = Struct("<2sb2s3f2s2b2sb2sf")
_HEADS: Final = tuple(map(bytes.fromhex, ("2100", "2f01", "220b", "210f", "2d38")))
_IDENTITY: Final = bytes.fromhex("1a8102")  # read 101 and 102 as int32
_IDENTITY_REPLY: Final = Struct("<3s2i")
# Write 000 as int8; 020, 021 and 027..029 as float.
_COMMAND: Final = Struct("<3s2s2f2s3f")
_COMMAND_HEADS: Final = tuple(map(bytes.fromhex, ("01000a", "0e20", "0f27")))
_MODE_WRITE: Final = bytes.fromhex("0100")
_STOP: Final = bytes.fromhex("010000")
_OUTPUT_ZERO: Final = bytes.fromhex("0db102 00000000")  # write 131 as float
_OUTPUT_WRITES: Final = tuple(map(bytes.fromhex, ("0db002", "0db102")))  # 130 or 131
_STATES: Final = {
    FAULT: MotorState.FAULT,
    POSITION: MotorState.ENABLED,
    **dict.fromkeys((TIMEOUT, *_OTHERS), MotorState.STOPPED),  # with current, at no position
}
_FAULTS: Final = {
    **{32: "calibration", 33: "motor driver", 34: "over-voltage", 35: "encoder"},
    **{36: "motor not configured (motor.poles)", 37: "PWM cycle overrun", 38: "over-temperature"},
    **{39: "start outside servopos.position_min and position_max", 40: "under-voltage"},
    **{41: "configuration changed", 42: "theta invalid", 43: "position invalid"},
    **{44: "driver enable", 45: "stop position with limits", 46: "timing violation"},
    **{47: "bemf feedforward without acceleration limit", 48: "invalid limits"},
    **{49: "position control error", 50: "velocity control error"},
}
_ANSWER_S: Final = 0.2
_FEEDS: Final = 3  # of the watchdog, within its time
_WINDOW: Final = 0.1  # of the model's tolerance
_REACHED: Final = 0.05  # of the model's velocity
_HOME_OUTPUT: Final = 2
_SINGLE: Final = 2.0**-23  # of a value: the step of the single precision of registers


class Status(NamedTuple):
    """A reply, in revolutions, and when it was complete on the bus [ns]."""

    mode: int
    position: float
    velocity: float
    torque: float
    is_done: bool
    home: int
    fault: int
    control: float
    time_ns: int


class Order(NamedTuple):
    """A command of position mode [rev, rev/s, rev/s, rev/s²]; NaN: no position."""

    position: float
    velocity: float
    speed: float
    acceleration: float

    def packed(self, watchdog_s: float) -> bytes:
        """Return its registers; NaN: no watchdog."""
        first, second, third = _COMMAND_HEADS
        limits = watchdog_s, self.speed, self.acceleration
        return _COMMAND.pack(first, second, self.position, self.velocity, third, *limits)


@dataclass(frozen=True, slots=True, kw_only=True)
class MoteusOptions(Options):
    """The options of a hardware object; in a rig, keys of the motor's table."""

    poll_ms: float = positive(10.0, "ms", "Period of queries and commands.", (1.0, 50.0), most=1e3)
    watchdog_ms: float = positive(
        *(100.0, "ms", "The drive stops after this time without its host.", (10.0, 10_000.0)),
        most=1e6,
    )
    timeout_ms: float = positive(
        100.0, "ms", "Time without a reply after which the drive is lost.", (10.0, 10_000.0)
    )
    rotor_to_output_ratio: float = positive(
        1.0, "", "As in the drive: turns of its output per turn of the motor.", most=1e9
    )

    def check_together(self) -> None:
        """Check that the watchdog is fed in time."""
        if self.watchdog_ms < _FEEDS * self.poll_ms:
            problem = f"{self.watchdog_ms:g} ms is too short for poll_ms = {self.poll_ms:g}"
            raise SettingError(("watchdog_ms",), problem, f"at least {_FEEDS} times poll_ms")


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MoteusTable(MoteusOptions):
    """A motor behind a moteus."""

    node_id: int = whole(REQUIRED, 1, NODE_ID_MAX, "", "Id of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@final
class MoteusHwMotor(CanHardware[MoteusOptions]):
    """One moteus on a CAN FD bus, by id; see `CanHardware`.

    Attributes:
        status: the last reply, or None.
        is_over: whether the last command has ended.
        started_ns, ended_ns: when the last motion began and ended [ns]; None: not known.
        has_lost_zero: whether it has, or may have, restarted since its zero was set.
    """

    OPTIONS = MoteusOptions
    NOUN: ClassVar[str] = "a moteus"
    NODE_ID_MIN: ClassVar[int] = 1
    NODE_ID_MAX: ClassVar[int] = NODE_ID_MAX
    LACKS: str = "reply with status and versions"
    CONNECT_S = 1.0
    FD: ClassVar[bool] = True

    def _begin(self) -> None:
        node_id, drive = self.node_id, self.drive
        self._request_id = node_id | _REPLY | _EXTENDED
        self.status: Status | None = None
        self.is_over: bool = True
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self._register_map: int | None = None
        self._fault_since_ns = 0
        self._fed: Order | None = None  # repeated, as the motion goes on
        self._order = hold(0.0)
        self._sent: SentFrame | None = None  # the last command
        self.has_lost_zero: bool = False
        self._is_motion = False  # the last command, not a stop
        self._is_zeroed = False  # by a host, which it forgets without power
        self._may_stop = True  # it is, or was, told to
        self._was_lost = False
        self._window = 0.0
        self._last: tuple[Callable[..., SentFrame], bytes] | None = None
        self._life = drive.expect("reply", self.options.timeout_ms / 1e3, self._lose)
        reply_id = node_id << 8
        self._reply_id = reply_id | (_EXTENDED if reply_id > _STANDARD else 0)
        drive.handle(self._reply_id, self._on_reply)
        for destination in (node_id, _BROADCAST):
            drive.handle(destination, self._on_foreign)
            drive.handle(destination | _REPLY | _EXTENDED, self._on_foreign)
        drive.repeat(self.options.poll_ms / 1e3, self._poll)
        length = len(_padded(hold(0.0).packed(0.0) + _QUERY))
        drive.starts_by(self._request_id, length, flags=_BRS)

    def _greet(self) -> None:
        self._ask(_IDENTITY)

    def _knows(self) -> bool:
        return self.status is not None and self._register_map is not None

    def _rests(self) -> bool:
        return self.is_over and self._fed is None

    def _connected(self) -> None:
        if self._register_map != REGISTER_MAP:
            found, self._register_map = self._register_map, None
            raise PeerError(
                f"{self.label}: register map {found}; expected {REGISTER_MAP}; update the firmware"
            )
        period_s = self.options.poll_ms / 1e3
        self.drive.note_frames([(self._reply_id, 32, period_s)], [(self._request_id, 48, period_s)])

    def forget(self) -> None:
        """Repeat no command, and forget what the drive was told."""
        self._fed = None
        super().forget()

    def _lose(self) -> None:
        super()._lose()
        self._was_lost = True

    @property
    def fault(self) -> Fault | None:
        """Return the fault of the last reply, or None."""
        status = self.status
        if status is None or status.mode != FAULT:
            return None
        text = _FAULTS.get(status.fault, "unknown fault")
        return Fault(status.fault, text, self._fault_since_ns)

    # --- commands: `command` needs the ownership of the motor, a stop does not

    def begin(self, order: Order, window: float) -> None:
        """Begin a motion, which ends within the window [rev or rev/s]."""
        self._fed, self._is_motion = order, True
        data = order.packed(self.options.watchdog_ms / 1e3)
        sent = self._follow(order, window, self.drive.command, data)
        self.started_ns, self.ended_ns = self.drive.confirm(sent), None

    def brake(self, deceleration: float, window: float) -> None:
        """Slow down, then hold; needs no ownership."""
        self._fed, self._is_motion = None, False
        is_obeyed = self.status is not None and self.status.mode in (POSITION, *_OTHERS)
        self.is_over = not is_obeyed  # it rests, or a timeout has stopped it
        if is_obeyed:
            order = hold(deceleration)
            self._follow(order, window, self.drive.stop_command, order.packed(nan))

    def call_here_zero(self, window: float) -> None:
        """Make the present position that of the output's zero."""
        self._fed, self._is_motion = None, False
        self.has_lost_zero, self._is_zeroed = False, True
        self._follow(hold(0.0), window, self.drive.command, _OUTPUT_ZERO)

    def obey(self, data: bytes, is_there: Callable[[Status], bool], awaited: str) -> None:
        """Send a command, and wait for a reply to a later query that satisfies `is_there`.

        Raises:
            DeadlineExceeded: there was none.
        """
        self._fed, self.is_over, self._may_stop = None, True, True
        self._last = last = self.drive.command, data
        since: list[SentFrame] = []

        def is_answered() -> bool:
            status = self.status
            return status is not None and self._shows(status, since[0]) and is_there(status)

        self.drive.exchange(
            lambda: since.append(self._tell(*last)), is_answered, _ANSWER_S, awaited
        )
        self._may_stop = data == _STOP

    def _shows(self, status: Status, sent: SentFrame | None) -> bool:
        """Return whether a reply shows the state after a command, as its own reply does not."""
        sent_ns = None if sent is None else sent.time_ns
        return sent_ns is not None and status.time_ns - sent_ns > self.options.poll_ms * 5e5

    def _follow(
        self, order: Order, window: float, send: Callable[..., SentFrame], data: bytes
    ) -> SentFrame:
        self._order, self._window = order, window
        self.is_over = False
        self._last = send, data
        self._sent = self._tell(send, data)
        return self._sent

    def _tell(self, send: Callable[..., SentFrame], data: bytes) -> SentFrame:
        return send(self._request_id, _padded(data + _QUERY), flags=_BRS)

    def _ask(self, data: bytes) -> None:
        self.drive.request(self._request_id, _padded(data), flags=_BRS)

    # --- in the background

    def _poll(self) -> None:
        fed, last = self._fed, self._last
        if fed is None:
            self._ask(_QUERY)
            return
        has_arrived = self._has_arrived()
        holds = has_arrived and not fed.velocity  # from now on without a watchdog
        try:
            watchdog_s = nan if holds else self.options.watchdog_ms / 1e3
            self._tell(self.drive.command, fed.packed(watchdog_s))
        except MotorBusyError:
            self._fed = None
        if last is not self._last and self._last is not None:
            self._tell(*self._last)  # another thread has sent it meanwhile: it must come last
        elif has_arrived and self._fed is fed and not self.is_over:
            self._fed, self.is_over = None if holds else fed, True
            self.ended_ns = self.drive.runtime.now_ns()
            self.drive.news.grow()

    def _has_arrived(self) -> bool:
        status, order, window = self.status, self._order, self._window
        if status is None or status.mode != POSITION or not self._shows(status, self._sent):
            return False
        if order.velocity:
            return status.is_done and abs(status.velocity - order.velocity) <= window
        is_near = abs(status.position - status.control) <= window
        is_there = isnan(order.position) or abs(status.control - order.position) <= window
        return status.is_done and is_near and is_there

    def commanded(self, control: float) -> float:
        """Return the commanded position [turns] that the drive has rounded to this one.

        Rounding would otherwise accumulate, and a motor on a limit could start beyond it.
        """
        target = self._order.position
        return target if abs(control - target) <= _SINGLE * abs(target) else control

    def _on_reply(self, data: bytes, time_ns: int) -> None:
        if len(data) >= _IDENTITY_REPLY.size and data[:3] == b"\x2a\x81\x02":
            _, _, self._register_map = _IDENTITY_REPLY.unpack_from(data)
            return
        if len(data) < _STATUS.size:
            return
        values = _STATUS.unpack_from(data)
        if tuple(one for one in values if isinstance(one, bytes)) != _HEADS:
            return  # the answer to a query of another program
        mode, position, velocity, torque, done, home, fault, control = (
            one for one in values if not isinstance(one, bytes)
        )
        before = self.status
        self.status = Status(
            mode, position, velocity, torque, bool(done), home, fault, control, time_ns
        )
        if mode == FAULT and (before is None or before.mode != FAULT):
            self._fault_since_ns = time_ns
        self._life.came(time_ns)
        self._see_restart(mode)
        if self._fed is None and self.is_over:
            return
        if self._is_motion and mode != POSITION:
            if self._shows(self.status, self._sent):
                self._break_off(mode, time_ns)
        elif self._fed is None:
            self.is_over = self._has_arrived() or mode < POSITION

    def _see_restart(self, mode: int) -> None:
        """Note whether the drive has, or may have, restarted; a host's zero is lost then."""
        is_off = mode < POSITION and mode != FAULT
        if is_off and self._is_zeroed and (self._was_lost or not self._may_stop):
            self.has_lost_zero, self._is_zeroed = True, False
        self._was_lost = False

    def _break_off(self, mode: int, time_ns: int) -> None:
        """End a motion that the drive no longer makes; switch off what its command enabled anew."""
        was_fed = self._fed is not None
        self._fed, self.is_over = None, True
        if mode == FAULT:
            return
        by = "its watchdog (mode 11)" if mode == TIMEOUT else "the drive, now stopped"
        self.drive.physical.stopped_elsewhere(by, time_ns)
        if was_fed and mode < POSITION:
            self._last = self.drive.stop_command, _STOP
            with suppress(LinkError):
                self._tell(*self._last)

    def _on_foreign(self, data: bytes, time_ns: int) -> None:
        """Handle a command of another program, which gives all in one frame."""
        if data.startswith(_OUTPUT_WRITES):
            self._is_zeroed = True
        if data.startswith(_MODE_WRITE):
            self._may_stop, self._is_motion = True, False
            self.overheard(f"mode {data[2:3].hex()}h", time_ns)


def hold(deceleration: float) -> Order:
    """Return the order to slow down, then to hold."""
    return Order(nan, 0.0, -1.0, deceleration)


def _padded(data: bytes) -> bytes:
    return data.ljust(next(one for one in _LENGTHS if one >= len(data)), b"\x50")


@final
class MoteusMotor(CanMotor[MoteusHwMotor]):
    """A logical motor on a moteus; several of them may share one hardware object."""

    def _units_of(self, model: MotorModel) -> float:
        """Return turns of the output per unit of the model, signed."""
        ratio, units = self.hardware.options.rotor_to_output_ratio, motor_turns(model)
        turns = (model.gear_ratio or 0.0) * ratio
        self._n_m = turns * (1.0 if model.kind is MotionKind.ROTARY else tau)
        return units * ratio

    @property
    def _window(self) -> float:
        return _WINDOW * self.model.start_tolerance * abs(self._units)

    def _latest(self) -> Measurement | None:
        status = self.hardware.status
        if status is None:
            return None
        state = _STATES.get(status.mode, MotorState.DISABLED)
        error = status.control - status.position if status.mode == POSITION else 0.0
        return Measurement(
            *(status.time_ns, state, status.position / self._units, status.velocity / self._units),
            *(status.torque * self._n_m, error / self._units),
        )

    def _enable(self) -> None:
        hardware = self.hardware
        status = hardware.status
        if status is not None and status.mode == TIMEOUT:
            hardware.obey(_STOP, lambda one: one.mode == STOPPED, "mode 0")
        order = hold(abs(self.model.deceleration * self._units))
        hardware.obey(order.packed(nan), lambda one: one.mode in (FAULT, POSITION), "mode 10")
        self._check_fault()

    def _disable(self) -> None:
        self.hardware.obey(_STOP, lambda one: one.mode == STOPPED, "mode 0")

    def _command(self, motion: Motion) -> None:
        size = abs(self._units)
        ramp = min(motion.acceleration, motion.deceleration) * size
        if motion.variable is ControlVariable.POSITION:
            order = Order(motion.target * self._units, 0.0, motion.velocity * size, ramp)
            self.hardware.begin(order, self._window)
            return
        order = Order(nan, motion.target * self._units, -1.0, ramp)
        self.hardware.begin(order, _REACHED * self.model.velocity_max * size)

    def _stop(self) -> None:
        size = self._physical.stop_deceleration(self.model.deceleration)
        self.hardware.brake(size * abs(self._units), self._window)

    # --- capabilities

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable in (ControlVariable.POSITION, ControlVariable.VELOCITY)

    def _motion_times(self) -> MotionTimes | None:
        started_ns, ended_ns = self.hardware.started_ns, self.hardware.ended_ns
        source = "its command on the wire; trajectory complete in a reply"
        return MotionTimes(started_ns, ended_ns, source, latched_ns=started_ns)

    def _quantise(self, motion: Motion) -> Motion:
        """Return the motion with the one acceleration that a moteus has for both ramps."""
        least = min(motion.acceleration, motion.deceleration)
        return replace(motion, acceleration=least, deceleration=least)

    def _is_done(self) -> bool:
        hardware = self.hardware
        hardware.drive.check()
        self._check_fault()
        return self._physical.run is None if hardware.status is None else hardware.is_over

    def _read_reference(self) -> float:
        status = self.hardware.status
        if status is None or status.mode != POSITION:
            return self._read_position()
        self.hardware.drive.check()
        return self.hardware.commanded(status.control) / self._units

    def _read_fault(self) -> Fault | None:
        return self.hardware.fault

    def _reset_fault(self) -> None:
        self._disable()
        self._check_fault()

    def _home(self, method: int | None) -> None:
        require_here(self.name, method)
        self.hardware.call_here_zero(self._window)

    def _read_referenced(self) -> bool:
        hardware, status = self.hardware, self.hardware.status
        is_known = status is not None and status.home == _HOME_OUTPUT
        return is_known and not hardware.has_lost_zero

    def _position_source(self) -> str:
        return "register 001h"


build: Final = adaptation(api=1)(CanBuilder(MoteusTable, MoteusHwMotor, MoteusMotor))
