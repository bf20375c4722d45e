"""An emulated MyActuator RMD (driver V3, protocol V4.2).

Every request of 8 bytes has one answer, `answer_s` later. Requests to 280h reach all drives.
Angles and speeds are those of the output. A request that moves the motor is obeyed without a fault
only, and is answered in any case.

What is kept in ROM survives the power supply: acceleration (43h), gains (32h), zero (63h, 64h),
interruption time (B3h), ID (79h), and the switches of 20h. `rom_writes` of the truth counts writes.

Choices of this emulator where the manual leaves room: a stall is a following error beyond
`stall_deg`; an ID is valid after the restart; faults of level 2 last `fault_s`. Motion mode (400h)
is reported as mode 1; both its angles are within 12.5 rad of 0, and turn over there. Not emulated,
with a warning: gains that act, RS485, bit rates, the lock of the brake; the phase
currents of 9Dh are always those of one electrical angle.

Source: MyActuator, Servo Motor Control Protocol V4.2 (2024-05).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from struct import Struct
from typing import Any, Final, final

from motorhil.emulators.api import (
    REQUIRED,
    CanMotorDrive,
    ControllerContext,
    MotorTable,
    amount,
    drive_builder,
    flags,
    ns,
    of_code,
    positive,
    text,
    to_code,
    truncated,
    whole,
)

_REQUEST, _ANSWER, _ALL, _SETTING = 0x140, 0x240, 0x280, 0x300
_IMPEDANCE, _IMPEDANCE_ANSWER = 0x400, 0x500  # motion mode
_P_RAD, _V_RAD_S, _T_N_M = 12.5, 45.0, 24.0  # ranges of motion mode, either way
_KP_MAX, _KD_MAX = 500.0, 5.0
_MOTION: Final = Struct("<Bbhhh")
_LAST: Final = Struct("<4xi")
_LAST_U: Final = Struct("<4xI")
_SPEEDS: Final = Struct("<2xHi")
_SECOND_NS: Final = 1_000_000_000
_ERROR_NS: Final = 100_000_000
_AT_ONCE: Final = 1e300
_STALL: Final = 0x0002
_CAUSES: Final = {
    flags.FOLLOWING_ERROR: _STALL,
    flags.UNDER_VOLTAGE: 0x0004,
    flags.OVER_VOLTAGE: 0x0008,
    flags.OVER_TEMPERATURE: 0x1000,
}
_UNTIL_RESTART: Final = 0x0002 | 0x0010 | 0x0080
_GAINS: Final = (1, 2, 4, 5, 7, 8, 9)
_REPLIES: Final = (0x60, 0x61, 0x62, 0x92, 0x9A, 0x9C, 0x9D)
_PULSES: Final = 16384  # of the encoder per turn of the motor
NONE, CURRENT, SPEED, POSITION = range(4)


@final
@dataclass(frozen=True, kw_only=True)
class RmdTable(MotorTable):
    """The table of an RMD in a rig."""

    node_id: int = whole(REQUIRED, 1, 32, "", "Its ID.", example="1")
    answer_s: float = amount(0.0005, "s", "From a request to its answer.", (1e-5, 0.1), most=1)
    restart_s: float = amount(
        1.0, "s", "From power-on or reset to the first answer.", (0.01, 60.0), most=3600
    )
    acceleration_dps_s: int = whole(
        *(10_000, 0, 60_000, "deg/s²", "The four accelerations in ROM; 0: as fast as possible."),
        plausible=(100, 60_000),
    )
    interruption_ms: int = whole(
        *(0, 0, (1 << 32) - 1, "ms", "Interruption time in ROM; 0: off."), plausible=(5, 60_000)
    )
    stall_deg: float = positive(
        30.0, "deg", "Following error of the output that is a stall.", (0.1, 360.0), most=1e6
    )
    fault_s: float = amount(
        0.1, "s", "Duration of an injected fault of level 2.", (0.01, 60.0), most=3600
    )
    model: str = text("X6V3", "Its model, at most 7 letters.", example='"X8S2V10"')
    date: int = whole(20220206, 0, 99991231, "", "Date of its software.")


@final
@dataclass
class _Rom:
    """The parameters that survive the power supply."""

    node_id: int
    acceleration: list[int]  # position, its deceleration, speed, its deceleration [deg/s²]
    gains: dict[int, bytes]
    interruption_ms: int
    offset: int = 0  # pulses
    is_filtered: bool = False
    keeps_turns: bool = True
    limits: tuple[int, int] = (0, 0)  # of position commands, 0.01 degrees; 0: none
    writes: int = 0


@final
class RmdController(CanMotorDrive):
    """Implements `motorhil.emulators.api.Controller`; times are int ns."""

    def __init__(self, settings: RmdTable, context: ControllerContext) -> None:
        motor = settings.motor(context.stream())
        plant = motor.plant
        self._settings = settings
        super().__init__(motor, range(1, 0x4000), _CAUSES)
        self._inc_deg: Final = plant.encoder_increments_rev * plant.gear_ratio / 360.0
        self._inc_rad: Final = plant.gear_ratio * plant.increments_per_rad()
        self._n_m_a: Final = plant.gear_ratio * plant.torque_constant_n_m_a
        self._pulses: Final = _PULSES / plant.encoder_increments_rev
        self.axis.set_windows(
            following_window_inc=round(settings.stall_deg * self._inc_deg), following_window_ns=0
        )
        self._profiled: Final = motor.gains
        self._direct: Final = replace(
            motor.gains, velocity_feedforward=0.0, acceleration_feedforward_a_s2_inc=0.0
        )
        gains = {index: Struct("<f").pack(1.0) for index in _GAINS}
        accelerations = [settings.acceleration_dps_s] * 4
        self._rom = _Rom(settings.node_id, accelerations, gains, settings.interruption_ms)
        self._node = settings.node_id
        self._gains = dict(gains)
        self._mode = self._errors = 0
        self._is_silenced = self._swallows = self._reports = False
        self._lost = 0  # increments of whole turns that were lost with the power
        self._offset = 0
        self._start_ns = 0
        self._brake_is_open = False
        self._active: dict[int, int] = {}  # command: period [ns]

    # --- time

    def boot(self, now_ns: int) -> None:
        """Begin anew, with power or by a reset."""
        self._off()
        self.cancel_times()
        self.due_ns[self._hear] = now_ns + ns(self._settings.restart_s)
        self._start_ns = now_ns
        self._errors = 0
        self._is_silenced = self._swallows = self._reports = self._brake_is_open = False
        self._active = {}
        self._gains, self._offset = dict(self._rom.gains), self._rom.offset
        if not self._rom.keeps_turns:
            turn = round(self._inc_deg * 360)
            self._lost = self.axis.count() // turn * turn
        if self._node != self._rom.node_id:
            self._node = self._rom.node_id
            self.renumber()

    def watches(self) -> bool:
        """Return True in a mode, or if the plant has limits."""
        return bool(self._mode) or self.axis.has_extras()

    def expire(self, now_ns: int) -> None:
        """Do everything that is due at `now_ns`."""
        super().expire(now_ns)
        for command, period_ns in self._active.items():
            if self.is_due(command):
                self.wake(command, period_ns)
                self._answer(self._read(bytes((command,)) + bytes(7)))

    def _fall_silent(self) -> None:
        """Switch the output off, as no request has come within the interruption time."""
        if not self._is_silenced:
            self.warn("communication interrupted: the output is off")
        self._is_silenced = self._swallows = True
        self.wake(self._fall_silent, _SECOND_NS)
        self._off()
        self.send(_ANSWER + self._node, b"\xf1" + bytes(7))

    def _clear(self) -> None:
        self._errors &= _UNTIL_RESTART
        self._check_causes()

    def _report(self) -> None:
        if self._errors:
            self.wake(self._report, _ERROR_NS)
            self._answer(self.status_1(b"\x9a"))

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time."""
        super().advance(now_ns)
        self._check_causes()

    def _check_causes(self) -> None:
        for error in self.causes():
            if error != _STALL or self._mode:
                self._fail(error)

    def _fail(self, error: int, duration_ns: int = _ERROR_NS) -> None:
        if not self._errors & error:
            self.note("error", f"fault {error:04X}h")
            if self._reports:
                self.wake(self._report, _ERROR_NS)
        self._errors |= error
        self._off()
        if error & ~_UNTIL_RESTART:
            self.wake(self._clear, duration_ns)

    def _off(self) -> None:
        self._mode = NONE
        self.axis.power(False)

    # --- frames

    def hears(self, now_ns: int) -> bool:
        """Return whether it has restarted."""
        return self._hear not in self.due_ns

    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a request."""
        request, is_all = data, can_id in (_ALL, _SETTING)
        own = (_REQUEST + self._node, _IMPEDANCE + self._node)
        if can_id not in own and not (is_all and not self._rom.is_filtered):
            return
        answer_id = (_IMPEDANCE_ANSWER if can_id == own[1] else _ANSWER) + self._node
        self._hear()
        if len(request) != 8:
            self.warn(
                f"request {request.hex()} of {len(request)} bytes is ignored: 8 are needed",
            )
            return
        if self._swallows:  # the first one after an interruption comes back, and does nothing
            self._swallows = False
            self._answer(request, answer_id)
            return
        if can_id == own[1]:
            self._answer(self.impedance(request), answer_id)
            return
        if can_id == _SETTING:
            self._set_id(request)
            return
        command = request[0]
        if command in _READS and command not in self._active:
            self._answer(self._read(request))
        elif command in _WRITES:
            answer = _WRITES[command](self, request)
            if answer is not None:
                self._answer(answer)
        elif command not in _READS:
            self.warn(f"command {command:02X}h is not emulated")

    def _hear(self) -> None:
        """Begin the interruption time anew."""
        self._is_silenced = False
        self.wake(self._fall_silent, self._rom.interruption_ms * 1_000_000)

    def _answer(self, data: bytes, can_id: int | None = None) -> None:
        can_id = _ANSWER + self._node if can_id is None else can_id
        self.send(can_id, data, ns(self._settings.answer_s))

    def _set_id(self, request: bytes) -> None:
        if request[0] != 0x79:
            return
        if request[2]:
            told = (_ANSWER + self._node).to_bytes(2, "little")
            self._answer(request[:6] + told, _SETTING)
        elif 1 <= request[7] <= 32:
            self._write(node_id=request[7])
            self._answer(request, _SETTING)

    # --- measurements

    def _pulses_now(self) -> int:
        """Return the raw position of the multi-turn encoder [pulses]."""
        return int((self.axis.count() - self._lost) * self._pulses // 1)

    def _centidegrees(self) -> int:
        return int((self.axis.count() - self._zero_inc()) * 100.0 / self._inc_deg // 1)

    def _temperature(self) -> int:
        return truncated(self.axis.winding_temperature_c(), 8)

    def status_1(self, request: bytes) -> bytes:
        """Answer with temperature, voltage and errors (9Ah)."""
        told = self._temperature().to_bytes(1, "little", signed=True)
        volts = int(self.axis.dc_link_v() * 10).to_bytes(2, "little")
        is_open = bytes((self._brake_is_open or self._mode != NONE,))
        return request[:1] + told + b"\0" + is_open + volts + self._errors.to_bytes(2, "little")

    def status_2(self, request: bytes) -> bytes:
        """Answer with temperature, current, speed and angle (9Ch)."""
        speed = self.axis.velocity_inc_s() / self._inc_deg
        amps = self.axis.current_a() * 100
        values = (truncated(one, 16) for one in (amps, speed, self._centidegrees() / 100))
        return _MOTION.pack(request[0], self._temperature(), *values)

    def status_3(self, request: bytes) -> bytes:
        """Answer with temperature and phase currents (9Dh)."""
        amps = self.axis.current_a() * 100
        phases = (truncated(share * amps, 16) for share in (1.0, -0.5, -0.5))
        return _MOTION.pack(request[0], self._temperature(), *phases)

    def encoder(self, request: bytes) -> bytes:
        """Answer with the single-turn encoder (90h)."""
        raw = self._pulses_now() % _PULSES
        offset = self._offset % _PULSES
        told = ((raw - offset) % _PULSES, raw, offset)
        return request[:2] + b"".join(one.to_bytes(2, "little") for one in told)

    def _plain(self, request: bytes, value: int) -> bytes:
        return request[:4] + (value & 0xFFFFFFFF).to_bytes(4, "little")

    # --- commands that move the motor: each is answered, and obeyed without a fault only

    def current(self, request: bytes) -> bytes:
        """Drive a torque current (A1h)."""
        if self._can_move():
            self._mode = CURRENT
            self.axis.apply_current(
                int.from_bytes(request[4:6], "little", signed=True) / 100, _AT_ONCE
            )
        return self.status_2(request)

    def speed(self, request: bytes) -> bytes:
        """Ramp to a speed (A2h)."""
        if self._can_move():
            self._mode = SPEED
            faster, slower = (self._ramp(index) for index in (2, 3))
            wanted = _LAST.unpack(request)[0] / 100 * self._inc_deg
            self.axis.set_gains(self._profiled)
            self.axis.run_at(wanted, faster, slower)
        return self.status_2(request)

    def position(self, request: bytes) -> bytes:
        """Move to an angle (A4h), by a trapezoid, or directly if its acceleration is 0."""
        dps, target = _SPEEDS.unpack(request)
        self._go_to(dps, target)
        return self.status_2(request)

    def increment(self, request: bytes) -> bytes:
        """Move by an angle from the present position (A8h)."""
        dps, way = _SPEEDS.unpack(request)
        self._go_to(dps, self._centidegrees() + way)
        return self.status_2(request)

    def single_turn(self, request: bytes) -> bytes:
        """Move within one turn (A6h): 0 clockwise, 1 counter-clockwise; in single-turn mode."""
        dps, target = int.from_bytes(request[2:4], "little"), int.from_bytes(request[4:6], "little")
        if self._rom.keeps_turns:
            self.warn("A6h needs single-turn mode; switch 20h index 4 off, and restart")
        else:
            here = self._centidegrees()
            way = (target - here) % 36_000
            self._go_to(dps, here + (way - 36_000 if request[1] and way else way))
        status = self.status_2(request)
        return status[:6] + (self._pulses_now() & 0xFFFF).to_bytes(2, "little")

    def impedance(self, request: bytes) -> bytes:
        """Obey a frame of motion mode: p (16 bits), v, kp, kd, t (12 bits each)."""
        bits = int.from_bytes(request, "big")
        v, kp, kd, t = (bits >> at & 0xFFF for at in (36, 24, 12, 0))
        if self._can_move():
            self._mode = CURRENT
            turned_over = self._radians() - self._within()
            p = of_code(bits >> 48, _P_RAD, 16) + turned_over
            gain = 1.0 / (self._inc_rad * self._n_m_a)
            self.axis.follow_impedance(
                p * self._inc_rad + self._zero_inc(),
                of_code(v, _V_RAD_S, 12) * self._inc_rad,
                of_code(kp, _KP_MAX, 12, 0.0) * gain,
                of_code(kd, _KD_MAX, 12, 0.0) * gain,
                of_code(t, _T_N_M, 12) / self._n_m_a,
            )
        return self._impedance_answer()

    def _impedance_answer(self) -> bytes:
        """Return ID, p (16 bits), v and t (12 bits each), and two bytes of 0."""
        speed, torque = self.axis.velocity_inc_s() / self._inc_rad, self.axis.torque_n_m()
        v, t = to_code(speed, _V_RAD_S, 12), to_code(torque, _T_N_M, 12)
        v, t = (truncated(code, 12, signed=False) for code in (v, t))
        code = to_code(self._within(), _P_RAD, 16) << 24 | v << 12 | t
        return bytes((self._node,)) + code.to_bytes(5, "big") + bytes(2)

    def _zero_inc(self) -> float:
        """Return where the angle is 0, in increments of the axis."""
        return self._lost + self._offset / self._pulses

    def _radians(self) -> float:
        """Return the multi-turn angle [rad]."""
        return (self.axis.count() - self._zero_inc()) / self._inc_rad

    def _within(self) -> float:
        """Return the angle of motion mode [rad], which turns over at its ends."""
        return (self._radians() + _P_RAD) % (2.0 * _P_RAD) - _P_RAD

    def _go_to(self, dps: int, target: int) -> None:
        if not self._can_move():
            return
        low, high = self._rom.limits
        target = min(target, high) if high else target
        target = max(target, low) if low else target
        self._mode = POSITION
        inc = round(target / 100 * self._inc_deg + self._zero_inc())
        speed = dps * self._inc_deg if dps else _AT_ONCE
        is_direct = not self._rom.acceleration[0]
        self.axis.set_gains(self._direct if is_direct else self._profiled)
        if not is_direct:
            self.axis.move_to(inc, min(speed, 1e12), self._ramp(0), self._ramp(1))
        else:
            self.axis.follow(inc, 0, speed_max_inc_s=speed)

    def _can_move(self) -> bool:
        if self._errors:
            self.warn(f"not obeyed: fault {self._errors:04X}h")
        elif self._mode == NONE:
            self.axis.power(True)
        return not self._errors

    def _ramp(self, index: int) -> float:
        return (self._rom.acceleration[index] or 1e9) * self._inc_deg

    def stop(self, request: bytes) -> bytes:
        """Slow down to speed 0 in closed loop (81h)."""
        if self._mode != NONE:
            self.axis.ramp_to_rest(self._ramp(3))
        return request

    def shutdown(self, request: bytes) -> bytes:
        """Switch the output off, and leave the mode (80h)."""
        self._off()
        return request

    def reset(self, request: bytes) -> None:
        """Restart without an answer (76h)."""
        self.boot(self.now_ns)

    def brake(self, request: bytes) -> bytes:
        """Release (77h) or lock (78h) the brake, which is a mere flag here."""
        self._brake_is_open = request[0] == 0x77
        return request

    # --- parameters

    def _write(self, **values: Any) -> None:
        """Write parameters to ROM."""
        for name, value in values.items():
            setattr(self._rom, name, value)
        self._rom.writes += 1

    def acceleration(self, request: bytes) -> bytes | None:
        """Write an acceleration to RAM and ROM (43h)."""
        value = _LAST_U.unpack(request)[0]
        if request[1] > 3 or not (value == 0 or 100 <= value <= 60_000):
            self.warn(f"acceleration {request[1]} = {value} deg/s² is ignored")
            return None
        self._rom.acceleration[request[1]] = value
        self._write()
        return request

    def gain(self, request: bytes) -> bytes | None:
        """Write a gain to RAM (31h) or ROM (32h); it has no effect here."""
        if request[1] not in _GAINS:
            return None
        self._gains[request[1]] = request[4:]
        if request[0] == 0x32:
            self._rom.gains[request[1]] = request[4:]
            self._write()
        return request

    def zero(self, request: bytes) -> bytes:
        """Write the zero (63h), or the present position as zero (64h); valid after a restart."""
        offset = self._pulses_now() if request[0] == 0x64 else _LAST.unpack(request)[0]
        self._write(offset=offset)
        return self._plain(request, offset)

    def interruption(self, request: bytes) -> bytes:
        """Write the interruption time (B3h)."""
        self._write(interruption_ms=_LAST_U.unpack(request)[0])
        self._hear()
        return request

    def reply(self, request: bytes) -> None:
        """Send an answer by itself (B6h), instead of when it is asked."""
        command, period = request[1], int.from_bytes(request[3:5], "little")
        self._active.pop(command, None)
        self.due_ns.pop(command, None)
        if request[2] and period and command in _REPLIES:
            self._active[command] = period * 10_000_000
            self.wake(command, self._active[command])

    def control(self, request: bytes) -> bytes:
        """Control a function (20h)."""
        index, value = request[1], _LAST.unpack(request)[0]
        if index == 1:
            self._write(offset=self._pulses_now())
        elif index == 2:
            self._write(is_filtered=bool(value))
        elif index == 3:
            self._reports = bool(value)
            self.wake(self._report, _ERROR_NS if value and self._errors else 0)
        elif index == 4:
            self._write(keeps_turns=bool(value))
        elif index == 5 and 1 <= value <= 32:
            self._write(node_id=value)
        elif index in (6, 7):
            low, high = self._rom.limits
            self._write(limits=(low, value) if index == 6 else (value, high))
        return request

    # --- physical inputs, and the rest of the interface

    def inject(self, fault: int) -> None:
        """Cause faults, by their bits."""
        self._fail(fault, ns(self._settings.fault_s))

    def go_dark(self) -> None:
        """Lose the power."""
        self._off()

    def truth(self) -> Mapping[str, float]:
        """Return mode, errors, and the number of writes to ROM."""
        return {
            "mode": float(self._mode),
            "fault": float(self._errors),
            "rom_writes": float(self._rom.writes),
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return the identifiers of its requests, of those to all, and of the setting of IDs."""
        return [_REQUEST + self._node, _IMPEDANCE + self._node, _ALL, _SETTING]

    # --- reading

    def _read(self, request: bytes) -> bytes:
        """Answer a request that only reads."""
        command, index, raw = request[0], request[1], self._pulses_now()
        if command in _STATUSES:
            return _STATUSES[command](self, request)
        told = {
            0x30: request[:4] + self._gains.get(index, bytes(4)),
            0x70: request[:7] + bytes((self._mode,)),
            0xB5: request[:1] + self._settings.model.encode()[:7].ljust(7, b"\0"),
        }
        numbers = {
            0x42: self._rom.acceleration[index] if index < 4 else 0,
            0x60: raw - self._offset,
            0x61: raw,
            0x62: self._offset,
            0x92: self._centidegrees(),
            0x94: self._centidegrees() % 36_000 << 16,
            0xB1: (self.now_ns - self._start_ns) // 1_000_000,
            0xB2: self._settings.date,
        }
        return told.get(command) or self._plain(request, numbers[command])

    def power(self, request: bytes) -> bytes:
        """Answer with the electrical power (71h)."""
        watts = abs(self.axis.current_a() * self.axis.winding_v())
        return request[:6] + truncated(watts * 10, 16, signed=False).to_bytes(2, "little")


_READS: Final = (
    *(0x30, 0x42, 0x60, 0x61, 0x62, 0x70, 0x71, 0x90, 0x92, 0x94, 0x9A, 0x9C, 0x9D),
    *(0xB1, 0xB2, 0xB5),
)
_STATUSES: Final[dict[int, Callable[[RmdController, bytes], bytes]]] = {
    0x71: RmdController.power,
    0x90: RmdController.encoder,
    0x9A: RmdController.status_1,
    0x9C: RmdController.status_2,
    0x9D: RmdController.status_3,
}
_WRITES: Final[dict[int, Callable[[RmdController, bytes], bytes | None]]] = {
    0x20: RmdController.control,
    0x31: RmdController.gain,
    0x32: RmdController.gain,
    0x43: RmdController.acceleration,
    0x63: RmdController.zero,
    0x64: RmdController.zero,
    0x76: RmdController.reset,
    0x77: RmdController.brake,
    0x78: RmdController.brake,
    0x80: RmdController.shutdown,
    0x81: RmdController.stop,
    0xA1: RmdController.current,
    0xA2: RmdController.speed,
    0xA4: RmdController.position,
    0xA6: RmdController.single_turn,
    0xA8: RmdController.increment,
    0xB3: RmdController.interruption,
    0xB6: RmdController.reply,
}


build: Final = drive_builder(RmdTable, RmdController, api=1)
