"""A moteus: modes, faults, watchdog, and frames of register subframes.

A frame is one command. Its writes fill the command fields, its reads see the state before it, and
the command takes effect after the last subframe. A write of the mode sets all other fields back.
A reply has the bit rate switch of its query, and is padded to a length of CAN FD.

| from       | command of mode      | to                                               |
| ---------- | -------------------- | ------------------------------------------------ |
| any        | 0                    | stopped: the only reset of a fault or a timeout  |
| 0          | 5..15                | 2 (enabling), 3 (calibrating), 4, then that mode |
| 2, 3       | 5..15                | stays; the newest command counts when ready      |
| 4, 5..15   | 5..15                | that mode at once                                |
| 1, 11      | 5..15                | ignored                                          |

Not emulated, with a warning: the voltage modes 5 to 8 and 14, overrides of voltage and current.
Not emulated either: inputs and outputs (registers 05Ch to 07Fh keep what is written), the effect of
the clock trim, derating, slip limits, flow control of the tunnel, most of the diagnostic text.
A reply that is still queued is not withdrawn by the next one.

Source: mjbots/moteus, docs/protocol and fw; mjbots/mjlib, multiplex/micro_server.cc.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan, nan
from typing import ClassVar, Final, final

from motorhil.emulators.api import (
    BRS,
    EFF_FLAG,
    FD_FRAME_BYTES,
    FD_LENGTHS,
    NEVER_NS,
    RTR_FLAG,
    ControllerContext,
    MotorDrive,
    MotorTable,
    amount,
    can_id_of,
    data_of,
    drive_builder,
    flag,
    flags,
    number,
    pack,
    pack_fd,
    positive,
    whole,
)
from motorhil.emulators.moteus import registers as r
from motorhil.emulators.moteus.control import Servo, Trajectory

STOPPED, FAULT, ENABLING, CALIBRATING, CALIBRATED = range(5)
CURRENT, POSITION, TIMEOUT, ZERO_VELOCITY, WITHIN = range(9, 14)
BRAKE: Final = 15
BROADCAST: Final = 0x7F
_MODES: Final = 16
_MS: Final = 1_000_000
_ENABLING_NS: Final = 5 * _MS
_CALIBRATION_CYCLES: Final = 256
_STAGE, _WATCHDOG, _TICK = "stage", "watchdog", "tick"  # times
_CYCLES_S_MAX: Final = 30_000  # control cycles; the PWM may be faster
_LEAST_VOLTAGE: Final = 4.0
_FARTHEST: Final = 32768.0  # [rev]
_TUNNEL: Final = 128  # bytes that a channel keeps
_TUNNEL_REPLY: Final = 41
_FAMILIES: Final = (  # PWM [Hz], voltage [V], current [A], temperature [degC]: r4, n1, c1, x1
    (30_000, 46.0, 100.0, 75.0),
    (30_000, 56.0, 100.0, 75.0),
    (30_000, 54.0, 20.0, 75.0),
    (15_000, 56.0, 120.0, 105.0),
)
_LEAST_ACCELERATION: Final = 1e-9  # in place of 0, with which a motion never ends
_MANY: Final = 1e9
_GAINS, _SPEEDS, _TIMES, _VOLTS = (1e-4, 1e4), (1e-3, 1e4), (1e-3, 60.0), (8.0, 100.0)  # plausible


@final
@dataclass(frozen=True, kw_only=True)
class MoteusTable(MotorTable):
    """A moteus; the keys are named after its configuration."""

    node_id: int = whole(1, 1, 126, "", "Its id.")
    can_prefix: int = whole(0, 0, 0x1FFF, "", "Bits 16 to 28 of all identifiers.")
    family: int = whole(0, 0, 3, "", "Hardware: 0 r4, 1 n1, 2 c1, 3 x1.")
    serial_number: int = whole(1, 0, (1 << 63) - 1, "", "Its serial number; also of its UUID.")
    abi_version: int = whole(0x010100, 0, 0x7FFFFFFF, "", "Register 101h.")
    register_map_version: int = whole(5, 0, 0x7FFFFFFF, "", "Register 102h.")
    poles: int = whole(14, 0, 255, "", "Poles of the motor; 0: not configured.")
    rotor_to_output_ratio: float = positive(
        1.0, "", "Turns of the output per turn of the motor.", most=_MANY
    )
    output_encoder: bool = flag(
        False, "An absolute encoder at the output; without one, power-off loses whole turns."
    )
    kp_n_m_rev: float | None = amount(
        None, "N·m/rev", "Gain kp; absent: of the rig's servo.", _GAINS, most=_MANY
    )
    kd_n_m_s_rev: float = positive(0.05, "N·m·s/rev", "Gain kd, with kp.", _GAINS, most=_MANY)
    position_min_rev: float | str = number(
        -0.01, -_MANY, _MANY, "rev", "Least position; none: no limit.", word="none"
    )
    position_max_rev: float | str = number(
        0.01, -_MANY, _MANY, "rev", "Largest position; none: no limit.", word="none"
    )
    default_velocity_limit_rev_s: float | None = amount(
        None, "rev/s", "Velocity limit if a command has none.", _SPEEDS, most=_MANY
    )
    default_accel_limit_rev_s2: float | str = positive(
        50.0, "rev/s²", "Likewise; none: of older firmware.", _SPEEDS, most=_MANY, word="none"
    )
    default_timeout_s: float = positive(0.1, "s", "The watchdog.", _TIMES, most=3600)
    timeout_mode: int = whole(
        ZERO_VELOCITY, 0, 15, "", "After it: 0 off, 10 to rest, 12 zero velocity, 15 brake."
    )
    timeout_max_torque_n_m: float = amount(5.0, "N·m", "Torque in mode 12.", _GAINS, most=_MANY)
    max_velocity_rev_s: float = positive(500.0, "rev/s", "Velocity limit.", _SPEEDS, most=_MANY)
    max_current_a: float | None = amount(None, "A", "Absent: of the family.", _GAINS, most=_MANY)
    max_voltage_v: float | None = amount(None, "V", "Absent: of the family.", _VOLTS, most=_MANY)
    fault_position_error_rev: float | None = amount(
        None, "rev", "Absent: no limit.", _SPEEDS, most=_MANY
    )
    fault_velocity_error_rev_s: float | None = amount(
        None, "rev/s", "Absent: no limit.", _SPEEDS, most=_MANY
    )


@final
class MoteusController(MotorDrive):
    """Implements `motorhil.emulators.api.Controller`; times are int ns.

    Attributes:
        mode: 0 to 15.
        fault: the code of the fault; 0: none.
    """

    INPUTS: ClassVar[Mapping[str, tuple[float, float]]] = {"board_temperature_c": (-100.0, 300.0)}

    def __init__(self, table: MoteusTable, context: ControllerContext) -> None:
        self._table = table
        motor = table.motor(context.stream())
        ratio = table.rotor_to_output_ratio
        gains = None if table.kp_n_m_rev is None else (table.kp_n_m_rev, table.kd_n_m_s_rev)
        super().__init__(motor, range(1, 96), {flags.OVER_VOLTAGE: 34, flags.UNDER_VOLTAGE: 40})
        self._servo = Servo(self.axis, motor, ratio, gains)
        pwm_hz, self._volts, self._amps, self._hot_c = _FAMILIES[table.family]
        cycle_ns = 1_000_000_000 // min(pwm_hz, _CYCLES_S_MAX)
        self._calibration_ns = _CALIBRATION_CYCLES * cycle_ns
        self._amps = self._amps if table.max_current_a is None else table.max_current_a
        self._volts = self._volts if table.max_voltage_v is None else table.max_voltage_v
        self._bounds = (_or(table.position_min_rev, -inf), _or(table.position_max_rev, inf))
        self.mode: int = STOPPED
        self.fault: int = 0
        self._board_c = self._motor_c = 25.0
        self._home = 1
        self._stored: dict[int, float] = {}
        self._given = r.defaults()
        self._ordered: dict[int, float] = {}  # of the last command
        self._wanted = STOPPED  # the mode of the last command
        self._given_mode = STOPPED  # of the present frame, if `_has_command`
        self._has_command = False
        self._measured: dict[int, float] = {}  # of the present frame, when it reads
        self._trajectory = Trajectory(0.0, 0.0, None, 0.0, inf, inf)
        self._began_ns = 0  # of the trajectory
        self._stop_at = nan
        self._is_bounded = True
        self._is_torque_limited = False
        self._watchdog_ns = NEVER_NS  # counts in some modes
        self._boot_ns = 0
        self._heard, self._told = bytearray(), bytearray()
        self.axis.set_thresholds(over_voltage_v=self._volts, under_voltage_v=_LEAST_VOLTAGE)

    # --- time

    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""
        self._boot_ns = now_ns
        self._servo.restart(self._table.output_encoder)
        self._home = 2 if self._table.output_encoder else 1
        self._given, self._stored = r.defaults(), dict.fromkeys(r.STORED, 0.0)

    def watches(self) -> bool:
        """Return whether the plant can cause a fault now."""
        return self.mode > FAULT and self.axis.has_extras()

    def expire(self, now_ns: int) -> None:
        """Do what is due, of which `advance` knows all."""
        self.advance(now_ns)

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time."""
        super().advance(now_ns)
        stage_ns = self.due_ns.get(_STAGE, NEVER_NS)
        if self.is_due(_STAGE):
            self._advance(stage_ns)
        self._check()
        if self.is_due(_WATCHDOG):
            self._time_out()
        if self.is_due(_TICK):
            self._drive()

    def _advance(self, stage_ns: int) -> None:
        """Go on from enabling to calibrating, and from there to the commanded mode."""
        if self.mode == ENABLING:
            self.mode = CALIBRATING
            self.due_ns[_STAGE] = stage_ns + self._calibration_ns
        else:
            self.mode = CALIBRATED
            self._enter(self._wanted)

    # --- faults

    def _check(self) -> None:
        """Raise the faults whose conditions are met."""
        if self.mode <= FAULT:
            return
        causes = self.causes()
        if causes:
            self._fail(causes[0])
        elif self._board_c > self._hot_c:
            self._fail(38)
        elif self.mode == POSITION:
            position, velocity = self._control()
            if _is_beyond(self._servo.position() - position, self._table.fault_position_error_rev):
                self._fail(49)
            elif _is_beyond(
                self._servo.velocity() - velocity, self._table.fault_velocity_error_rev_s
            ):
                self._fail(50)

    def _fail(self, code: int) -> None:
        self._release()
        self.mode, self.fault = FAULT, code
        self.note("error", f"fault {code}")

    def _release(self) -> None:
        self._servo.release()
        self.cancel_times()

    # --- modes

    def _command(self, mode: int) -> None:
        """Carry out the command of a frame."""
        if mode == STOPPED:
            self._release()
            self.mode, self.fault = STOPPED, 0
            return
        if mode <= CALIBRATED or self.mode in (FAULT, TIMEOUT) or mode == TIMEOUT:
            return
        self._ordered = given = dict(self._given)
        self._wanted = mode
        timeout_s = given[0x027] or self._table.default_timeout_s
        self._watchdog_ns = NEVER_NS
        if isfinite(timeout_s):
            self._watchdog_ns = self.now_ns + max(0, round(timeout_s * 1e9))
        if self.mode == STOPPED:
            self.mode = ENABLING
            self.due_ns[_STAGE] = self.now_ns // _MS * _MS + _ENABLING_NS
        elif self.mode >= CALIBRATED:
            self._enter(mode)

    def _enter(self, mode: int) -> None:
        """Enter a mode, or obey a new command in it."""
        given, servo = self._ordered, self._servo
        if mode in (CURRENT, POSITION) and not self._table.poles:
            self._fail(36)
            return
        if mode in (POSITION, WITHIN) and mode != self.mode and not given[0x02D]:
            low, high = self._bounds
            if any(_FARTHEST < abs(bound) < inf for bound in self._bounds):
                self._fail(48)
                return
            if not low <= servo.position() <= high:
                self._fail(39)
                return
        before, self.mode = self.mode, mode
        self.due_ns[_TICK] = NEVER_NS
        self.due_ns[_WATCHDOG] = self._watchdog_ns if mode in (POSITION, WITHIN) else NEVER_NS
        self._limit(given[0x025])
        servo.scale(given[0x023], given[0x024], given[0x02B])
        if not (isnan(given[0x02A]) and isnan(given[0x02C])):
            self.warn("overrides (02Ah, 02Ch) are not emulated")
        if mode == POSITION:
            self._plan(is_first=before != POSITION)
        elif mode == WITHIN:
            self._drive()
        elif mode == CURRENT:
            self._limit(inf)
            servo.push(given[0x01C] if isfinite(given[0x01C]) else 0.0)
        elif mode == ZERO_VELOCITY:
            self._damp(given[0x024])
        elif mode == BRAKE:
            servo.short()
        else:
            servo.push(0.0)
            self.warn(f"mode {mode} drives no current: not emulated")

    def _damp(self, kd_scale: float) -> None:
        self._limit(min(self._ordered[0x025], self._table.timeout_max_torque_n_m))
        self._servo.scale(0.0, kd_scale, 0.0)
        self._servo.damp()

    def _limit(self, torque_n_m: float) -> None:
        most = self._amps * self._servo.constant
        self._is_torque_limited = abs(torque_n_m) < most
        self._servo.limit(torque_n_m if self._is_torque_limited else most)

    def _time_out(self) -> None:
        """Act as `servo.timeout_mode` says."""
        kind = self._table.timeout_mode
        position, velocity = self._control() if self.mode == POSITION else (nan, 0.0)
        self.mode, self.due_ns[_TICK] = TIMEOUT, NEVER_NS
        self.warn(f"no command: timeout mode {kind}")
        if kind == ZERO_VELOCITY:
            self._damp(self._ordered[0x024])
        elif kind == BRAKE:
            self._servo.short()
        elif kind == POSITION:
            self._ordered.update({0x022: 0.0, 0x023: 1.0, 0x024: 1.0})
            self._servo.scale(1.0, 1.0, 1.0)
            self._limit(inf)
            speed, acceleration = self._limits(nan, nan)
            start = self._servo.position() if isnan(position) else position
            self._follow(Trajectory(start, velocity, None, 0.0, speed, acceleration))
        else:
            self._release()

    # --- position mode

    def _limits(self, speed: float, acceleration: float) -> tuple[float, float]:
        """Return the limits of velocity and acceleration; inf: none."""
        table = self._table
        default = table.default_velocity_limit_rev_s
        speed = (inf if default is None else default) if isnan(speed) else speed
        if isnan(acceleration):
            acceleration = _or(table.default_accel_limit_rev_s2, inf)
        speed = inf if speed < 0 else speed
        acceleration = inf if acceleration < 0 else max(acceleration, _LEAST_ACCELERATION)
        if min(speed, acceleration) < inf:
            speed = min(speed, table.max_velocity_rev_s, self._servo.speed_max)
        return speed, acceleration

    def _plan(self, *, is_first: bool) -> None:
        given, servo = self._ordered, self._servo
        speed, acceleration = self._limits(given[0x028], given[0x029])
        if isfinite(given[0x026]) and min(speed, acceleration) < inf:
            self._fail(45)
            return
        if is_first:
            velocity = servo.velocity()
            start = servo.position(), velocity if abs(velocity) >= 0.05 else 0.0
        else:
            start = self._control()
        most = min(speed, servo.speed_max)
        final = max(-most, min(most, given[0x021])) if isfinite(given[0x021]) else 0.0
        target = None
        if isfinite(given[0x020]):
            target = max(-_FARTHEST, min(_FARTHEST, given[0x020]))
        self._stop_at = given[0x026]
        self._is_bounded = not given[0x02D]
        self._follow(Trajectory(*start, target, final, speed, acceleration))

    def _follow(self, trajectory: Trajectory) -> None:
        self._trajectory, self._began_ns = trajectory, self.now_ns
        self._drive()

    def _control(self, ahead_ns: int = 0) -> tuple[float, float]:
        """Return control position and velocity, within the bounds."""
        time_s = (self.now_ns + ahead_ns - self._began_ns) / 1e9
        position, velocity = self._trajectory.at(time_s)
        low, high = self._bounds if self._is_bounded else (-inf, inf)
        if velocity > 0 and self._stop_at < high:
            high = self._stop_at
        elif velocity < 0 and self._stop_at > low:
            low = self._stop_at
        if low <= position <= high:
            return position, velocity
        return max(low, min(high, position)), 0.0

    def _is_done(self) -> bool:
        time_s = (self.now_ns - self._began_ns) / 1e9
        is_there = time_s >= self._trajectory.duration_s
        return is_there and self._trajectory.at(time_s)[0] == self._control()[0]

    def _drive(self) -> None:
        """Give the motor its set-point for one period of the servo."""
        servo, feed = self._servo, self._ordered[0x022]
        feed = feed if isfinite(feed) else 0.0
        next_ns = (self.now_ns // servo.tick_ns + 1) * servo.tick_ns
        if self.mode == WITHIN:
            here = servo.position()
            low, high = self._ordered[0x040], self._ordered[0x041]
            if here < low or here > high:
                servo.hold(low if here < low else high, 0.0, feed)
            else:
                servo.push(feed / servo.constant)
            self.due_ns[_TICK] = next_ns
            return
        if self.mode == POSITION and not self._ordered[0x023] and not self._ordered[0x024]:
            self.due_ns[_TICK] = NEVER_NS
            servo.push(feed / servo.constant)
            return
        position, velocity = self._control(next_ns - self.now_ns)
        servo.hold(position, velocity, feed)
        time_s = (self.now_ns - self._began_ns) / 1e9
        goes_on = time_s < self._trajectory.duration_s or self._trajectory.final != 0.0
        self.due_ns[_TICK] = next_ns if goes_on else NEVER_NS

    # --- frames

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process a frame, and reply if its identifier asks for it."""
        can_id = can_id_of(data)
        own = (self._table.node_id, BROADCAST)
        is_ours = can_id >> 16 & 0x1FFF == self._table.can_prefix and can_id & 0xFF in own
        if not is_ours or can_id & RTR_FLAG or not self.is_powered:
            return
        self.advance(now_ns)
        self._has_command = False
        self._measured = {}
        reply = bytearray() if can_id & 0x8000 else None
        if self._process(data_of(data), reply):
            if reply is not None:
                self._send(can_id >> 8 & 0x7F, bytes(reply), data)
            if self._has_command:
                self._command(self._given_mode)

    def _process(self, data: bytes, reply: bytearray | None) -> bool:
        """Process the subframes; return False if the frame is for another UUID."""
        at = 0
        try:
            while at < len(data):
                code = data[at]
                at += 1
                if code == r.NOP or (r.READ <= code < r.REPLY and reply is None):
                    continue
                if code < r.REPLY:
                    kind, count = code >> 2 & 3, code & 3
                    if not count:
                        count, at = r.varuint(data, at)
                    first, at = r.varuint(data, at)
                    span = range(first, first + min(count, len(data) * 64))
                    if code < r.READ:
                        at = self._write(span, kind, data, at, reply)
                        if at < 0:
                            return False
                    elif reply is None or not self._read(span, kind, reply):
                        return True
                elif code in (r.TO_SERVER, r.POLL):
                    at = self._tunnel(code, data, at, reply)
                else:
                    return True
        except IndexError:  # the frame ends within a subframe
            pass
        return True

    def _write(self, span: range, kind: int, data: bytes, at: int, reply: bytearray | None) -> int:
        """Write registers; return where the subframe ends, -1 if another UUID is meant."""
        size = r.LAYOUTS[kind].size
        for register in span:
            if at + size > len(data):
                raise IndexError("the frame ends within a value")
            raw = data[at : at + size]
            at += size
            error = r.refusal(register)
            value = 0.0 if error else r.decode(raw, r.QUANTITIES[register], kind)
            if register in range(0x154, 0x158):
                if raw != r.encode(self._identity(register - 4), "int", kind):
                    self._has_command = False
                    return -1
            elif not error:
                error = self._set(register, value)
            if error and reply is not None:
                self._append(reply, bytes((r.WRITE_ERROR,)) + r.packed(register) + bytes((error,)))
        return at

    def _set(self, register: int, value: float) -> int:
        """Write a register; return the error, 0 if there is none."""
        register = r.SHADOWS.get(register, register)
        self._measured = {}
        if register == r.MODE:
            if not 0 <= value < _MODES:
                return r.UNKNOWN_REGISTER
            self._given = r.defaults()
            self._given_mode, self._has_command = int(value), True
        elif register in self._given:
            self._given[register] = value
        elif register in self._stored:
            self._stored[register] = max(-8, min(8, value)) if register == 0x071 else value
        elif register in (0x130, 0x131):
            self._set_output(value, register == 0x130)
        elif register == 0x133 and self.mode == POSITION:
            self._plan(is_first=True)
        return 0

    def _set_output(self, value: float, nearest: bool) -> None:
        """Set the position, exactly or by whole turns of the motor."""
        if not abs(value) <= _FARTHEST:
            return
        servo, ratio = self._servo, self._table.rotor_to_output_ratio
        before = servo.position()
        shift = value - before
        shift = round(shift / ratio) * ratio if nearest else shift
        control = self._control()[0] + shift
        servo.axis.set_position(round((before + shift) * servo.inc))
        self._home = 2
        if self.mode in (POSITION, TIMEOUT) and self.axis.flags & flags.POWERED:
            self._follow(Trajectory(control, 0.0, None, 0.0, inf, inf))

    def _read(self, span: range, kind: int, reply: bytearray) -> bool:
        """Append the values of registers; return False if one fails, or they do not fit."""
        values: list[bytes] = []
        if not self._measured:
            self._measured = self._measure()
        measured = self._measured
        for register in span:
            if register in r.IDENTITY and kind == r.INT32:
                values.append(r.encode(self._identity(register), "int", kind))
            elif register in measured:
                value = measured[register]
                if register == 0x070 and kind == r.FLOAT:
                    value %= 8388608
                values.append(r.encode(value, r.QUANTITIES[register], kind))
            else:
                error = bytes((r.READ_ERROR,)) + r.packed(register)
                self._append(reply, error + bytes((r.UNKNOWN_REGISTER,)))
                return False
        return self._append(reply, r.subframe(r.REPLY, kind, span.start, values))

    def _append(self, reply: bytearray, subframe: bytes) -> bool:
        if len(reply) + len(subframe) > FD_LENGTHS[-1]:
            return False
        reply += subframe
        return True

    def _tunnel(self, code: int, data: bytes, at: int, reply: bytearray | None) -> int:
        """Take text of a channel, or answer with text; return where the subframe ends."""
        channel, at = r.varuint(data, at)
        length, at = r.varuint(data, at)
        if code == r.POLL:
            if reply is not None:
                text = self._told if channel == 1 else bytearray()
                part = bytes(text[: min(length, _TUNNEL_REPLY)])
                del text[: len(part)]
                head = bytes((r.TO_CLIENT,)) + r.packed(channel) + r.packed(len(part))
                self._append(reply, head + part)
            return at
        if at + length > len(data):
            raise IndexError("the frame ends within a text")
        if channel == 1:
            self._heard += data[at : at + length][: _TUNNEL - len(self._heard)]
            while b"\n" in self._heard:
                line, _, self._heard = self._heard.partition(b"\n")
                self._obey(bytes(line).strip())
        return at + length

    def _obey(self, line: bytes) -> None:
        """Obey a line of the diagnostic channel."""
        if line == b"d stop":
            self._command(STOPPED)
        self._told += b"OK\r\n" if line == b"d stop" else b"ERR unknown command\r\n"
        del self._told[_TUNNEL:]

    def _send(self, destination: int, reply: bytes, query: bytes) -> None:
        can_id = self._table.can_prefix << 16 | self._table.node_id << 8 | destination
        can_id |= EFF_FLAG if can_id >= 0x800 else 0
        is_fd = len(query) == FD_FRAME_BYTES
        if len(reply) <= 8 and not is_fd:
            self.queue(pack(can_id, reply))
            return
        length = min(one for one in FD_LENGTHS if one >= len(reply))
        brs = query[5] & BRS if is_fd else 0
        self.queue(pack_fd(can_id, reply.ljust(length, bytes((r.NOP,))), brs))

    # --- values

    def _identity(self, register: int) -> int:
        table = self._table
        words = (0, table.abi_version, table.register_map_version)
        if register < 0x120:
            return words[register - 0x100]
        if register == 0x153:
            return 0x65746F6D
        return table.serial_number >> 32 * (register & 0xF) & 0xFFFFFFFF

    def _measure(self) -> dict[int, float]:
        """Return the values of all registers that any type can read."""
        servo, given = self._servo, self._given
        position, velocity, torque = servo.position(), servo.velocity(), servo.torque()
        controls = self.mode in (POSITION, TIMEOUT)
        control, control_v = self._control() if controls else (nan, nan)
        error, error_v = position - control, velocity - control_v
        kp, kd = servo.kp * given[0x023], servo.kd * given[0x024]
        values = dict.fromkeys(r.MEASURED, 0.0)
        values.update(self._stored)
        values.update(given)
        values.update({shadow: given[register] for shadow, register in r.SHADOWS.items()})
        values.update({0x000: self.mode, 0x001: position, 0x002: velocity, 0x003: torque})
        values.update({0x004: servo.axis.current_a(), 0x007: servo.power_w()})
        values.update({0x00B: self._is_done(), 0x00C: self._home, 0x00D: servo.axis.dc_link_v()})
        values.update({0x00E: self._board_c, 0x00F: self.fault or self._limiting()})
        values.update({0x030: -kp * error if controls else 0.0, 0x033: self._given[0x022]})
        demand = servo.axis.current_demand_a() * servo.constant
        values.update({0x032: -kd * error_v if controls else 0.0, 0x034: demand, 0x03A: demand})
        values.update({0x038: control, 0x039: control_v, 0x03B: error, 0x03C: error_v})
        values[0x03D] = torque - demand
        values.update({0x050: position, 0x051: velocity, 0x058: 3, 0x158: 1})
        values.update({0x070: (self.now_ns - self._boot_ns) // _MS, 0x073: nan, 0x075: nan})
        return values

    def _limiting(self) -> int:
        """Return the code of what limits the output now."""
        if self.mode not in (CURRENT, POSITION, TIMEOUT, ZERO_VELOCITY, WITHIN):
            return 0
        if self.mode == POSITION:
            wanted = self._trajectory.at((self.now_ns - self._began_ns) / 1e9)[0]
            if self._is_bounded and not self._bounds[0] <= wanted <= self._bounds[1]:
                return 103
        if not self._servo.is_saturated():
            return 0
        return 102 if self._is_torque_limited else 99

    # --- the rest of the interface

    def set_input(self, name: str, value: float) -> None:
        """Set the board's temperature [degC]."""
        self._board_c = value
        self._check()

    def inject(self, fault: int) -> None:
        """Cause a fault."""
        self._fail(fault)

    def go_dark(self) -> None:
        """Lose the power."""
        self._command(STOPPED)

    def truth(self) -> Mapping[str, float]:
        """Return the mode and the fault."""
        return {"mode": float(self.mode), "fault": float(self.fault)}

    def identifiers(self) -> Sequence[int] | None:
        """Return all identifiers with its prefix, to its id or to all."""
        first = self._table.can_prefix << 16
        every = [
            first | middle << 8 | node
            for middle in range(256)
            for node in (self._table.node_id, BROADCAST)
        ]
        return [*(one for one in every if one < 0x800), *(one | EFF_FLAG for one in every)]


def _or(value: float | str, other: float) -> float:
    """Return a number of the table; `other` for its word."""
    return other if isinstance(value, str) else value


def _is_beyond(error: float, limit: float | None) -> bool:
    return limit is not None and abs(error) > limit


build: Final = drive_builder(MoteusTable, MoteusController, api=1)
