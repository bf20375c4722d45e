"""An emulated VESC (firmware 7.01) in CAN mode VESC.

Commands are never acknowledged, and each switches the mode at once. Status frames are off until
they are configured. There is no enable and no reset: a fault releases the motor, drops commands for
`fault_stop_s`, and then clears itself. Without a command for `timeout_s` the motor is released, or
braked with `timeout_brake_a`.

Each mode uses the servo of the axis with gains of its own:

| mode      | axis                                                                            |
| --------- | ------------------------------------------------------------------------------- |
| current   | that current; below `current_min_a` the power stage is off                      |
| brake     | a short-circuited motor, limited to that current                                |
| handbrake | holds the present position with that current                                    |
| duty      | a voltage source: the velocity loop with the gain of the winding, no integrator |
| speed     | a ramp in ERPM; a short-circuited motor while the set-point is below `erpm_min` |
| position  | proportional to the angle, derivative on the velocity; the shorter way round    |

Not emulated: averages of GET_VALUES (the present values are sent), charge and energy counters (0),
limits of input current, power and battery, detection, terminal, serial ports, the gains of the
speed controller. A warning names a command that has no effect.

Source: vedderb/bldc b9d287b3 (firmware 7.01), documentation/comm_can.md.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from struct import Struct
from typing import ClassVar, Final, final

from motorhil.emulators.api import (
    EFF_FLAG,
    REQUIRED,
    CanMotorDrive,
    ControllerContext,
    MotorTable,
    amount,
    drive_builder,
    flags,
    ns,
    number,
    positive,
    text,
    whole,
)
from motorhil.emulators.vesc.packets import (
    FILL,
    FILL_LONG,
    PROCESS,
    PROCESS_SHORT,
    Reassembly,
    frames_of,
)

_EVERYBODY: Final = 255
_I32: Final = Struct(">i")
_TWO: Final = Struct(">ii")
_TICK_NS: Final = 100_000  # of the firmware's operating system: 10 kHz
_CHECK_NS: Final = 10_000_000  # the timeout is checked so often
_AGAINST: Final = 0.02  # duty from which a relative current counts as against the motion
_FAULTS: Final = {flags.OVER_VOLTAGE: 1, flags.UNDER_VOLTAGE: 2, flags.OVER_TEMPERATURE: 6}
_FAULT_MAX: Final = 33
_AT_ONCE: Final = 1e300  # [A/s]
_RATE_HZ: Final = (1.0, 1000.0)
_CURRENT_A: Final = (0.01, 1000.0)
_TIME_S: Final = (0.01, 60.0)
_VOLTAGE_V: Final = (1.0, 1000.0)
_STATUS: Final = (9, 14, 15, 16, 27, 58)


@final
@dataclass(frozen=True, kw_only=True)
class VescTable(MotorTable):
    """The table of a VESC in a rig."""

    node_id: int = whole(REQUIRED, 0, 254, "", "Its controller id.", example="1")
    status_1: int = whole(
        0, 0, 63, "", "Status frames at rate 1: bit 0 STATUS to bit 5 STATUS_6; 0: none."
    )
    status_rate_1_hz: int = whole(50, 0, 10_000, "Hz", "Rate 1; 0: never.", plausible=_RATE_HZ)
    status_2: int = whole(0, 0, 63, "", "Status frames at rate 2.")
    status_rate_2_hz: int = whole(5, 0, 10_000, "Hz", "Rate 2; 0: never.", plausible=_RATE_HZ)
    timeout_s: float = amount(
        *(1.0, "s", "Time without a command until it releases the motor; 0: never.", _TIME_S),
        most=1e6,
    )
    timeout_brake_a: float = amount(
        0.0, "A", "Brake current after this time.", _CURRENT_A, most=1e4
    )
    fault_stop_s: float = amount(
        0.5, "s", "Time after which a fault clears itself.", _TIME_S, most=1e6
    )
    pole_pairs: int = whole(7, 1, 1000, "", "ERPM per rpm.")
    erpm_min: float = amount(900.0, "", "No speed control below this ERPM.", most=1e9)
    erpm_max: float = positive(100_000.0, "", "Limit of the speed in ERPM.", most=1e9)
    erpm_ramp_s: float = positive(
        25_000.0, "1/s", "Change of ERPM per second.", (100.0, 1e7), most=1e12
    )
    current_max_a: float = amount(
        60.0, "A", "Motor current limit, at most the plant's.", _CURRENT_A, most=1e4
    )
    current_brake_max_a: float = amount(60.0, "A", "The same while braking.", _CURRENT_A, most=1e4)
    current_min_a: float = amount(
        0.05, "A", "A smaller current releases the motor.", (1e-3, 10.0), most=1e4
    )
    duty_min: float = amount(0.005, "", "A smaller duty cycle releases the motor.", most=1)
    duty_max: float = positive(0.95, "", "Limit of the duty cycle.", most=1)
    duty_ramp_s: float = positive(20.0, "1/s", "Change of duty per second.", (0.1, 1e3), most=1e9)
    position_kp: float = amount(
        0.025, "1/deg", "Share of current_max_a per angle error.", (1e-5, 100.0), most=1e6
    )
    position_kd: float = positive(
        0.00035, "s/deg", "Share of current_max_a per angular velocity.", (1e-7, 1.0), most=1e6
    )
    encoder_turns: int = whole(
        1, 1, 1_000_000, "", "Turns of the motor in one of its encoder; known at power-on."
    )
    position_divider: float = positive(
        1.0, "", "Turns of the encoder in 360 degrees of position.", most=1e6
    )
    voltage_min_v: float = amount(
        8.0, "V", "Fault 2, under voltage, below; needs a DC link.", _VOLTAGE_V, most=1e6
    )
    voltage_max_v: float = amount(
        57.0, "V", "Fault 1, over voltage, above; needs a DC link.", _VOLTAGE_V, most=1e6
    )
    temperature_max_c: float = number(
        *(100.0, -273, 1e6, "C", "Fault 6, over temperature of the motor, from here."),
        plausible=(20.0, 300.0),
    )
    hardware: str = text("60", "Name of its hardware.", example='"60"')
    firmware_major: int = whole(7, 0, 255, "", "Firmware version, before the point.")
    firmware_minor: int = whole(1, 0, 255, "", "Firmware version, behind the point.")


class Mode(IntEnum):
    """Activity of the motor, as commanded last."""

    OFF = 0
    CURRENT = 1
    BRAKE = 2
    HANDBRAKE = 3
    DUTY = 4
    SPEED = 5
    POSITION = 6


@final
class VescController(CanMotorDrive):
    """Implements `motorhil.emulators.api.Controller`; times are int ns."""

    FLAG: ClassVar[int] = EFF_FLAG

    def __init__(self, settings: VescTable, context: ControllerContext) -> None:
        motor = settings.motor(context.stream())
        self._settings = settings
        self._plant = motor.plant
        super().__init__(motor, range(1, _FAULT_MAX + 1), _FAULTS)
        self._inc: Final = motor.plant.encoder_increments_rev
        self._inc_s: Final = self._inc / (60.0 * settings.pole_pairs)  # per ERPM
        self._gains: Final = motor.gains
        self._no_load_inc_s: Final = (
            motor.plant.supply_v / motor.plant.torque_constant_n_m_a
        ) * motor.plant.increments_per_rad()
        forward = min(settings.current_max_a, motor.plant.current_max_a)
        backward = min(settings.current_brake_max_a, motor.plant.current_max_a)
        self._limits_a = (-backward, forward)
        self._turn: Final = self._inc * settings.encoder_turns
        self._span: Final = self._turn * settings.position_divider  # increments in 360 degrees
        kd = settings.position_kd * forward * 360.0 / self._span
        plain = replace(
            motor.gains,
            velocity_ki_a_inc=0.0,
            velocity_feedforward=0.0,
            acceleration_feedforward_a_s2_inc=0.0,
        )
        self._position_gains = replace(
            plain,
            position_kp_1_s=settings.position_kp / settings.position_kd,
            velocity_kp_a_s_inc=kd,
        )
        self._duty_gains = plain.shorted(motor.plant)
        self.axis.set_thresholds(
            over_voltage_v=settings.voltage_max_v,
            under_voltage_v=settings.voltage_min_v,
            over_temperature_c=settings.temperature_max_c,
        )
        self._packets = Reassembly()
        self._mode = Mode.OFF
        self._timed_out = False
        self._fault = 0
        self._duty = self._angle_offset = 0.0
        self._speed = (0.0, 0, 0.0)  # set-point of ERPM, at this time [ns], on the way to there
        self._zero = self._power_on = self._last = self._travelled = 0  # increments of the encoder
        self._start_ns = 0

    # --- time

    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""
        self._start_ns = now_ns
        self._power_on = self._last = self.axis.count()
        self._zero = self._power_on // self._turn * self._turn
        self._travelled = self._fault = 0
        self._timed_out = False
        self._angle_offset = 0.0
        self.wake(self._notify_boot, 500_000_000)
        self.due_ns.update({self._tell_1: now_ns, self._tell_2: now_ns})
        self._feed()

    def watches(self) -> bool:
        """Return whether the plant has limits."""
        return self.axis.has_extras()

    def _hear_again(self) -> None:
        """End the time in which commands are dropped; begin it anew while a cause lasts."""
        self._fault = 0
        self._check_cause()
        if self._timed_out:
            self.brake(self._settings.timeout_brake_a)

    def _time_out(self) -> None:
        self._timed_out = True
        self._release()
        if self._hear_again not in self.due_ns:
            self.brake(self._settings.timeout_brake_a)

    def _notify_boot(self) -> None:
        self._send(57, self._settings.node_id, self._settings.hardware.encode()[:8])

    def _tell_1(self) -> None:
        self._tell(self._tell_1, self._settings.status_1, self._settings.status_rate_1_hz)

    def _tell_2(self) -> None:
        self._tell(self._tell_2, self._settings.status_2, self._settings.status_rate_2_hz)

    def _tell(self, again: Callable[[], None], mask: int, rate_hz: int) -> None:
        if mask and rate_hz:
            self.wake(again, 10_000 // rate_hz * _TICK_NS)
            self._send_status(mask)

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time."""
        super().advance(now_ns)
        count = self.axis.count()
        self._travelled += abs(count - self._last)
        self._last = count
        self._check_cause()

    def _check_cause(self) -> None:
        """Begin a fault, or begin its time anew, while its cause lasts."""
        for fault in self.causes():
            self._fail(fault)

    def _feed(self) -> None:
        self._timed_out = False
        timeout_ns = ns(self._settings.timeout_s)
        since_ns = self.now_ns + timeout_ns - self._start_ns
        due_ns = self._start_ns + (since_ns // _CHECK_NS + 1) * _CHECK_NS
        self.wake(self._time_out, due_ns - self.now_ns if timeout_ns else 0)

    def _fail(self, fault: int) -> None:
        if fault != self._fault:
            self.note("error", f"fault {fault}")
        self._fault = fault
        self._be_deaf(ns(self._settings.fault_stop_s))

    def _be_deaf(self, duration_ns: int) -> None:
        self._release()
        self.due_ns[self._hear_again] = self.now_ns + duration_ns

    # --- measurements

    def _erpm(self) -> float:
        return self.axis.velocity_inc_s() / self._inc_s

    def _duty_now(self) -> float:
        if self._mode is Mode.OFF:
            return 0.0
        return self.axis.winding_v() / self._volts()

    def _volts(self) -> float:
        return max(self.axis.dc_link_v(), 1e-3)

    def _degrees(self) -> float:
        spans = (self.axis.count() - self._zero) / self._span
        return (360.0 * spans - self._angle_offset) % 360.0

    def _tachometer(self, increments: int) -> int:
        return 6 * self._settings.pole_pairs * increments // self._inc

    def _fields(self) -> tuple[bytes, ...]:
        """Return the fields of GET_VALUES, by the bits of their mask."""
        amps, duty = self.axis.current_a(), self._duty_now()
        cold, warm = self._plant.extras.ambient_c, self.axis.winding_temperature_c()
        way = self.axis.count() - self._power_on
        return (
            *(_cut(2, cold * 10), _cut(2, warm * 10), _cut(4, amps * 100)),
            *(_cut(4, amps * duty * 100), _cut(4, 0), _cut(4, amps * 100)),
            *(_cut(2, duty * 1e3), _cut(4, self._erpm()), _cut(2, self._volts() * 10)),
            *(bytes(4), bytes(4), bytes(4), bytes(4)),
            *(_cut(4, self._tachometer(way)), _cut(4, self._tachometer(self._travelled))),
            *(bytes((self._fault,)), _cut(4, self._degrees() * 1e6)),
            *(bytes((self._settings.node_id,)), _cut(2, cold * 10) * 3),
            *(_cut(4, 0), _cut(4, duty * self._volts() * 1e3), bytes((self._timed_out,))),
        )

    # --- frames from the drive

    def _send_status(self, mask: int) -> None:
        told = self._fields()
        amps, duty = self.axis.current_a(), self._duty_now()
        angle = _cut(2, self._degrees() * 50)
        status = (
            told[7] + _cut(2, amps * 10) + told[6],
            told[9] + told[10],
            told[11] + told[12],
            told[0] + told[1] + _cut(2, amps * duty * 10) + angle,
            told[13] + told[8] + bytes(2),
            bytes(8),
        )
        for i, command in enumerate(_STATUS):
            if mask & 1 << i:
                self._send(command, self._settings.node_id, status[i])

    def _send(self, command: int, number: int, data: bytes) -> None:
        self.send(command << 8 | number, data)

    # --- frames to the drive

    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a frame to this drive; missing bytes count as 0."""
        command, payload = can_id >> 8, data
        if command > 0xFF or can_id & 0xFF not in (self._settings.node_id, _EVERYBODY):
            return
        needed = _NEEDED.get(command, 0)
        if len(payload) < needed:
            self.warn(f"command {command} has {len(payload)} of {needed} bytes; 0 for the rest")
            payload = payload.ljust(needed, b"\0")
        if command in _MOTION:
            if command == 1 and len(payload) >= 6:
                self.warn("SET_CURRENT of 6 bytes: the current is read from bytes 2 to 5")
                payload = payload[2:]
            self._command(*_MOTION[command], _I32.unpack_from(payload)[0])
        elif command == FILL:
            self._fill(payload[0], payload[1:])
        elif command == FILL_LONG:
            self._fill(int.from_bytes(payload[:2], "big"), payload[2:])
        elif command == PROCESS:
            length, crc = (int.from_bytes(payload[i : i + 2], "big") for i in (2, 4))
            packet = self._packets.take(length, crc)
            if packet is None:
                self.warn(f"a packet of {length} bytes is dropped: no buffer, or another CRC")
            else:
                self._process(packet, payload[0], payload[1])
        elif command == PROCESS_SHORT:
            self._process(payload[2:], payload[0], payload[1])
        else:
            self._configure(command, payload)

    def _configure(self, command: int, payload: bytes) -> None:
        """Handle a command that neither moves the motor nor feeds the timeout."""
        node_id = self._settings.node_id
        if command == 17:
            self._send(18, payload[0], bytes((node_id, 0)))
        elif command == 56:
            self._send(56, node_id, _cut(4, self._degrees() * 1e5))
        elif command in (21, 22):
            low, high = (value / 1e3 for value in _TWO.unpack_from(payload))
            most = self._plant.current_max_a
            self._limits_a = (max(-most, min(low, 0.0)), min(most, max(high, 0.0)))
        elif command == 55:
            now = self._degrees() + self._angle_offset
            self._angle_offset = now - _I32.unpack_from(payload)[0] / 1e4
        elif command == 31:
            self.go_dark()
        else:
            self.warn(f"command {command} is not emulated")

    def _fill(self, offset: int, part: bytes) -> None:
        if not self._packets.fill(offset, part):
            self.warn(f"a fragment at offset {offset} is dropped: no buffer ends there")

    def _process(self, packet: bytes, sender: int, mode: int) -> None:
        if mode not in (0, 2, 3) or not packet:
            return  # an answer: for a port of this controller, and there is none
        kind, rest = packet[0], packet[1:].ljust(4, b"\0")
        if kind in _PACKETS:
            self._command(*_MOTION[_PACKETS[kind]], _I32.unpack_from(rest)[0])
        elif kind == 30:
            self._feed()
        elif kind == 29:
            self._release()
            self.start(self.now_ns)
        elif kind == 159:
            self._be_deaf(int.from_bytes(rest[:2], "big") * 1_000_000)
        else:
            answer = self._answer(kind, rest)
            if answer is None:
                self.warn(f"packet {kind} is not emulated")
            elif mode != 2:
                answers_mode = 0 if mode == 3 else 1
                for one, data in frames_of(answer, self._settings.node_id, answers_mode):
                    self._send(one, sender, data)

    def _answer(self, kind: int, rest: bytes) -> bytes | None:
        s = self._settings
        if kind == 0:
            unique = s.node_id.to_bytes(12, "big")
            name, version = s.hardware.encode(), bytes((0, s.firmware_major, s.firmware_minor))
            return version + name + b"\0" + unique + bytes(8) + b"\0" + bytes(4)
        if kind == 4:
            return b"\x04" + b"".join(self._fields())
        if kind == 50:
            mask = int.from_bytes(rest[:4], "big")
            told = (field for i, field in enumerate(self._fields()) if mask & 1 << i)
            return b"\x32" + rest[:4] + b"".join(told)
        return None

    # --- modes

    def _command(self, mode: "_Mode", scale: float, raw: int) -> None:
        self._feed()
        if self._hear_again not in self.due_ns:
            mode(self, raw / scale)

    def _release(self) -> None:
        self._enter(Mode.OFF)
        self.axis.power(False)

    def _enter(self, mode: Mode) -> bool:
        """Enter the mode; return True if it is another one."""
        is_new = mode is not self._mode
        if is_new and self._mode is Mode.OFF:
            self.axis.power(True)
            self.axis.apply_current(0.0, _AT_ONCE)  # so that ramps start at the present speed
        if is_new:
            self._mode = mode
            self.wake(self._follow_speed, 0)
            own = {Mode.DUTY: self._duty_gains, Mode.POSITION: self._position_gains}
            self.axis.set_gains(own.get(mode, self._gains))
            self._limit(self._limits_a[1])
        return is_new

    def _limit(self, amps: float) -> None:
        self.axis.set_current_limit(amps)

    def current(self, amps: float) -> None:
        """Drive this current [A]."""
        low, high = self._limits_a
        amps = max(low, min(high, amps))
        if abs(amps) < self._settings.current_min_a:
            self._release()
        else:
            self._enter(Mode.CURRENT)
            self._limit(max(-low, high))
            self.axis.apply_current(amps, _AT_ONCE)

    def current_relative(self, share: float) -> None:
        """Drive this share of the current limit."""
        duty, (low, high) = self._duty_now(), self._limits_a
        against = abs(duty) >= _AGAINST and duty * share < 0.0
        self.current(share * (-low if against else high))

    def brake(self, amps: float) -> None:
        """Brake with this current [A], whatever its sign; it never drives."""
        amps = min(abs(amps), -self._limits_a[0])
        if amps < self._settings.current_min_a:
            self._release()
            return
        if self._enter(Mode.BRAKE):
            self.axis.brake(shorted=True)
        self._limit(amps)

    def brake_relative(self, share: float) -> None:
        """Brake with this share of the brake limit."""
        self.brake(share * self._limits_a[0])

    def handbrake(self, amps: float) -> None:
        """Hold the present position with this current [A]."""
        amps = min(abs(amps), self._limits_a[1])
        if amps < self._settings.current_min_a:
            self._release()
            return
        if self._enter(Mode.HANDBRAKE):
            self.axis.follow(self.axis.position_inc(), 0)
        self._limit(amps)

    def handbrake_relative(self, share: float) -> None:
        """Hold with this share of the current limit."""
        self.handbrake(share * self._limits_a[1])

    def duty(self, duty: float) -> None:
        """Apply this share of the supply voltage."""
        limit = self._settings.duty_max
        duty = max(-limit, min(limit, duty))
        if abs(duty) < self._settings.duty_min:
            self._release()
            return
        self._enter(Mode.DUTY)
        ramp = self._settings.duty_ramp_s * self._no_load_inc_s
        self.axis.run_at(duty * self._no_load_inc_s, ramp, ramp)

    def position(self, degrees: float) -> None:
        """Turn to this angle the shorter way round [degrees]."""
        self._enter(Mode.POSITION)
        way = (degrees - self._degrees() + 180.0) % 360.0 - 180.0
        self.axis.follow(self.axis.position_inc() + round(way / 360.0 * self._span), 0)

    def speed(self, erpm: float) -> None:
        """Ramp to this speed [ERPM]."""
        limit = self._settings.erpm_max
        is_new = self._enter(Mode.SPEED)
        start = self._erpm() if is_new else self._set_point()
        self._speed = start, self.now_ns, max(-limit, min(limit, erpm))
        if is_new and abs(start) >= self._settings.erpm_min:
            self.axis.follow_velocity(start * self._inc_s, 0)
        elif is_new:
            self.axis.brake(shorted=True)
        self._follow_speed()

    def _set_point(self) -> float:
        """Return the set-point of ERPM now, on its ramp."""
        start, since_ns, target = self._speed
        way = self._settings.erpm_ramp_s * (self.now_ns - since_ns) / 1e9
        return min(target, start + way) if target > start else max(target, start - way)

    def _follow_speed(self) -> None:
        """Control the speed, or short the motor while the set-point is too low; plan the next."""
        low, ramp, axis = self._settings.erpm_min, self._settings.erpm_ramp_s, self.axis
        now, target = self._set_point(), self._speed[2]
        until: float | None = None  # way of the set-point to the next change
        if abs(now) < low * (1.0 - 1e-9):
            if not axis.is_braking:
                axis.brake(shorted=True)
            if abs(target) >= low:
                until = low - now if target > 0.0 else low + now
        elif axis.is_braking:
            axis.follow_velocity(now * self._inc_s, 0)
            until = 0.0
        else:
            axis.run_at(target * self._inc_s, ramp * self._inc_s, ramp * self._inc_s)
            if abs(target) < low or target * now < 0.0:
                until = abs(now) - low
        tick_ns = 1 + int(self._settings.servo.tick_ns())
        self.wake(
            self._follow_speed, 0 if until is None else max(tick_ns, int(until / ramp * 1e9) + 1)
        )

    # --- physical inputs, and the rest of the interface

    def go_dark(self) -> None:
        """Lose the power."""
        self._release()
        self.cancel_times()

    def inject(self, fault: int) -> None:
        """Cause a fault, which clears itself."""
        self._fail(fault)

    def truth(self) -> Mapping[str, float]:
        """Return mode, fault, and whether the timeout has struck."""
        return {
            "mode": float(self._mode),
            "fault": float(self._fault),
            "timeout": float(self._timed_out),
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return the identifiers of its commands, and of those to all controllers."""
        return [
            EFF_FLAG | command << 8 | number
            for number in (self._settings.node_id, _EVERYBODY)
            for command in _COMMANDS
        ]


def _cut(size: int, value: float) -> bytes:
    """Return a number in big endian, truncated toward zero and limited to its size."""
    most = 1 << 8 * size - 1  # as `truncated`, without a call: 20 fields each time
    return int(max(-most, min(most - 1, value))).to_bytes(size, "big", signed=True)


_Mode = Callable[[VescController, float], None]
_MOTION: Final[dict[int, tuple[_Mode, float]]] = {
    0: (VescController.duty, 1e5),
    1: (VescController.current, 1e3),
    2: (VescController.brake, 1e3),
    3: (VescController.speed, 1.0),
    4: (VescController.position, 1e6),
    10: (VescController.current_relative, 1e5),
    11: (VescController.brake_relative, 1e5),
    12: (VescController.handbrake, 1e3),
    13: (VescController.handbrake_relative, 1e5),
}
"""Commands that move the motor: how, and the scale of their number."""
_PACKETS: Final[dict[int, int]] = {5: 0, 6: 1, 7: 2, 8: 3, 9: 4, 10: 12, 84: 10}
"""Packets with the same content as a command."""
_NEEDED: Final = {
    **dict.fromkeys(_MOTION, 4),
    **{FILL: 1, FILL_LONG: 2, PROCESS: 6, PROCESS_SHORT: 2, 17: 1, 21: 8, 22: 8, 55: 4},
}
_COMMANDS: Final = (*_NEEDED, 19, 23, 24, 25, 26, 28, 29, 30, 31, 47, 56, 63)


build: Final = drive_builder(VescTable, VescController, api=1)
