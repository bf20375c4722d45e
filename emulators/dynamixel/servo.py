"""An emulated servo of the X series: instructions, answers in turn, errors and watchdog.

A status is sent the return delay time after its instruction, with the values at the instruction. In
sync and bulk reads each servo waits for the status of the one before it in the list. It gives up
50 ms after the last status; so one absent servo silences all behind it. In fast reads, each adds
its block to one packet as soon as that has the bytes of those before it.

Choices of this emulator, where the maker publishes nothing: a packet with a wrong CRC is not
answered; group reads are answered at every status return level; a new instruction cancels a pending
status; an overload is 5 s at the limit of the current; a hardware error stays until reboot; after a
shutdown, torque on is ignored.

Source: the maker's manuals of Protocol 2.0 and of the models; for the order of answers, the
maker's device-side program for OpenCR.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final, final

from motorhil.emulators.api import (
    NEVER_NS,
    REQUIRED,
    ControllerContext,
    MotorDrive,
    MotorTable,
    Number,
    SettingError,
    TablesByKey,
    amount,
    drive_builder,
    nearest,
    setting,
    whole,
    word,
)
from motorhil.emulators.api import flags as f
from motorhil.emulators.dynamixel import motion as modes
from motorhil.emulators.dynamixel.memory import Memory
from motorhil.emulators.dynamixel.motion import Motion
from motorhil.emulators.dynamixel.packets import (
    ALERT,
    BROADCAST,
    HEADER,
    ID_MAX,
    STATUS,
    Error,
    Instruction,
    Packet,
    Receiver,
    crc16,
    status,
)
from motorhil.emulators.dynamixel.table import BAUD, EXTENDED_MAX, MODELS, RAM, Item

_I: Final = Instruction
_US: Final = 1000
_MS: Final = 1_000_000
_CLEAR_TURNS: Final = bytes.fromhex("01 44 58 4C 22")
_BACKUP: Final = bytes.fromhex("43 54 52 4C")
_KEEP: Final = {0xFF: (), 0x01: ("id",), 0x02: ("id", "baud_rate")}
_GOALS: Final = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
_LIMITS: Final = dict(
    zip(_GOALS[:3], ("pwm_limit", "current_limit", "velocity_limit"), strict=True)
)
_GROUP_READS: Final = (_I.SYNC_READ, _I.FAST_SYNC_READ, _I.BULK_READ, _I.FAST_BULK_READ)
_FAST: Final = (_I.FAST_SYNC_READ, _I.FAST_BULK_READ)
_GROUPS: Final = (*_GROUP_READS, _I.SYNC_WRITE, _I.BULK_WRITE)
_PING_STEP_NS: Final = 3 * _MS
_PATIENCE_NS: Final = 50 * _MS
_OVERLOAD_NS: Final = 5_000 * _MS
_WATCHDOG_NS: Final = 20 * _MS
_WATCHDOG_ERROR: Final = -1
_VOLTAGE, _HEAT, _OVERLOAD = 0x01, 0x04, 0x20
_FAULTS: Final = range(1, 0x3E)


@final
@dataclass(frozen=True, kw_only=True)
class DynamixelTable(MotorTable):
    """A servo of the X series (Dynamixel) on a serial line."""

    unit: int = whole(REQUIRED, 0, ID_MAX, "", "Its id.", example="1")
    model: str = word("xl330-m288", MODELS, "model", "Its model.")
    firmware: int | None = whole(None, 1, 255, "", "Firmware version; absent: the model's.")
    registers: Mapping[str, int] = setting(
        {},
        TablesByKey(Number(-(1 << 31), (1 << 31) - 1, is_whole=True)),
        "Values as delivered, by name of the item.",
    )
    model_information: int = whole(
        0, 0, 0xFFFF_FFFF, "", "Register 2, of which its maker tells nothing."
    )
    boot_up_s: float = amount(
        0.4, "s", "From power-on or a reboot until it answers.", (0.05, 5.0), most=60
    )
    turn_round_s: float = amount(
        50e-6, "s", "Least time from an instruction to its status.", (1e-6, 1e-3), most=0.01
    )


@final
class Servo(MotorDrive):
    """Implements `motorhil.emulators.controller.Controller`.

    Attributes:
        memory: its control table.
        motion: its motor.
        receiver: the packets on the line.

    Raises:
        SettingError: a register is unknown, or its value is out of range.
    """

    INPUTS: ClassVar[Mapping[str, tuple[float, float]]] = {
        "input_voltage_v": (0.0, 100.0),
        "temperature_c": (-40.0, 200.0),
    }

    def __init__(self, own: DynamixelTable, context: ControllerContext) -> None:
        motor, line_bit_s = own.motor(context.stream()), context.bitrate_bit_s
        self.unit: Final = own.unit
        self._model: Final = MODELS[own.model]
        self._firmware: Final = self._model.firmware if own.firmware is None else own.firmware
        self._line_bit_s: Final = line_bit_s
        rates = BAUD[: 7 if self._model.is_x330 else 8]
        known = {"id": own.unit, "model_information": own.model_information}
        delivered = {**known, **_rate(line_bit_s, rates), **own.registers}
        self.memory: Final = Memory(self._model, self._firmware, delivered)
        for name, value in own.registers.items():
            self._require(name, value)
        super().__init__(motor, _FAULTS)
        self.motion: Final = Motion(self.axis, motor.plant, self.memory, self._model)
        self.receiver: Final = Receiver()
        self._boot_ns: Final = round(own.boot_up_s * 1e9)
        self._turn_round_ns: Final = round(own.turn_round_s * 1e9)
        self._ready_ns = self._booted_ns = self._heard_ns = 0
        self._voltage, self._temperature = self._model.voltage[1], 30
        self._is_shut_down = False
        self._registered: bytes | None = None
        self._answer = b""  # the pending status, until `_send` is due
        self._answers_as = (self.unit, 0)  # its id and the delay of a status
        self._before: int | None = None  # the id whose status ours follows; -1: a broadcast ping
        self._fast: tuple[int, bytearray] | None = None  # bytes before our block, and those heard
        self._gives_up_ns = 0

    def _require(self, name: str, value: int) -> None:
        items = self.memory.items
        item = items.get(name)
        if item is None or item.low is None or item.high is None:
            known = [one.name for one in items.values() if one.low is not None]
            problem = "is not a writable register of this model"
            raise SettingError(("registers", name), problem, nearest(name, known))
        if not item.low <= value <= item.high:
            problem = f"{value} is out of range; allowed: {item.low} to {item.high}"
            raise SettingError(("registers", name), problem)

    # --- Controller ------------------------------------------------------------------------------

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process characters on the line, the last of them complete at `now_ns`."""
        rate = BAUD[self.memory["baud_rate"]]
        if not self.is_powered or self._line_bit_s not in (None, rate):
            return
        self.advance(now_ns)
        start_ns = now_ns - len(data) * 10_000_000_000 // rate
        self._extend(data, start_ns, now_ns)
        for heard in self.receiver.feed(data, start_ns, now_ns):
            if heard.instruction == STATUS:
                self._follow(heard.unit)
            elif now_ns >= self._ready_ns:
                self._heard_ns = now_ns
                self._cancel()
                self._execute(heard)

    def next_deadline_ns(self) -> int | None:
        """Return when `expire` must be called at the latest [ns], or None."""
        self.due_ns["watchdog"] = self._watchdog_ns()
        return super().next_deadline_ns()

    def watches(self) -> bool:
        """Return True: a change of the motor can begin an overload."""
        return True

    def _send(self) -> None:
        self._before = None
        self.queue(self._answer)

    def _send_in(self, wait_ns: int) -> None:
        self.due_ns[self._send] = self.now_ns + wait_ns

    def _cancel(self) -> None:
        """Cancel a pending status."""
        self.wake(self._send, 0)
        self._before = self._fast = None

    def set_input(self, name: str, value: float) -> None:
        """Set input voltage [V] or temperature [degC]."""
        if name == "input_voltage_v":
            self._voltage = round(value * 10.0)
        else:
            self._temperature = round(value)
        self.advance(self.now_ns)

    def inject(self, fault: int) -> None:
        """Set bits of the hardware error status."""
        self._fail(fault)

    def go_dark(self) -> None:
        """Lose the power."""
        self._torque(False)

    def truth(self) -> Mapping[str, float]:
        """Return following error, torque and hardware errors."""
        return {
            "following_error_inc": float(self.axis.following_error_inc()),
            "torque_enable": float(self.memory["torque_enable"]),
            "hardware_error_status": float(self.memory["hardware_error_status"]),
        }

    def identifiers(self) -> Sequence[int] | None:
        """Return None: a servo hears the whole line."""
        return None

    # --- motor -----------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Update the motor to this time, and apply what has become of it."""
        super().advance(now_ns)
        if self.is_powered:
            self._look()

    def _look(self) -> None:
        """Apply what has become of the motor, its supply and the host."""
        memory, now_ns = self.memory, self.now_ns
        if now_ns >= self._watchdog_ns():
            self.warn("bus watchdog: no instruction on the line; the motor stops")
            memory["bus_watchdog"] = _WATCHDOG_ERROR
            memory["profile_velocity"] = memory["profile_acceleration"] = 0
            self.motion.stop()
        if not self.motion.is_on or not self.axis.flags & f.CURRENT_SATURATED:
            self.wake(self._be_overloaded, 0)
        elif self._be_overloaded not in self.due_ns:
            self.wake(self._be_overloaded, _OVERLOAD_NS)
        if not memory["min_voltage_limit"] <= self._voltage <= memory["max_voltage_limit"]:
            self._fail(_VOLTAGE)
        if self._temperature > memory["temperature_limit"]:
            self._fail(_HEAT)

    def _be_overloaded(self) -> None:
        self._fail(_OVERLOAD)

    def _fail(self, bits: int) -> None:
        """Set bits of the hardware error status; shut down if the register says so."""
        memory = self.memory
        if memory["hardware_error_status"] & bits == bits:
            return
        memory["hardware_error_status"] |= bits
        self.note("error", f"hardware error {bits:02X}h")
        if memory["hardware_error_status"] & memory["shutdown"]:
            self._torque(False)
            self._is_shut_down = True

    def _torque(self, on: bool) -> None:
        if on and self._is_shut_down:
            self.warn("torque on is ignored: shut down; it needs a reboot")
            on = False
        self.memory["torque_enable"] = on
        if on != self.motion.is_on:
            self.motion.power(on)

    def boot(self, now_ns: int) -> None:
        """Begin anew, with power or by the instruction to reboot."""
        self.advance(now_ns)
        self.motion.power(False)
        self.memory.power_on()
        self.motion.forget_turns()
        self.motion.limit_current()
        self._is_shut_down = False
        self._registered = None
        self.cancel_times()
        self._cancel()
        self._booted_ns = self._ready_ns = self._heard_ns = now_ns + self._boot_ns
        self._look()
        if self.memory["startup_configuration"] & 1:
            self._torque(True)

    def _watchdog_ns(self) -> int:
        periods = self.memory["bus_watchdog"]
        if periods <= 0 or not self.motion.is_on:
            return NEVER_NS
        return self._heard_ns + periods * _WATCHDOG_NS

    # --- answers ---------------------------------------------------------------------------------

    def _delay_ns(self) -> int:
        return max(self._turn_round_ns, self.memory["return_delay_time"] * 2 * _US)

    def _reply(self, error: Error, data: bytes = b"") -> None:
        unit, delay_ns = self._answers_as  # as before a write that changes them
        self._answer = status(unit, self._error(error), data)
        self._send_in(delay_ns)

    def _error(self, error: Error) -> int:
        return error | (ALERT if self.memory["hardware_error_status"] else 0)

    def _follow(self, unit: int) -> None:
        """Handle a status of another servo, which ours may follow."""
        if self._before == -1:  # broadcast ping: one step for each id in between
            steps = self.memory["id"] - unit - 1
            if steps >= 0:
                self._send_in(self._turn_round_ns + steps * self._ping_step_ns())
        elif self._before is not None:
            is_late = self.now_ns > self._gives_up_ns
            self._gives_up_ns = self.now_ns + _PATIENCE_NS
            if is_late:
                self._before = None
            elif unit == self._before:
                self._before = None
                self._send_in(self._delay_ns())

    def _extend(self, data: bytes, start_ns: int, now_ns: int) -> None:
        """Collect the bytes of a fast read before our block; add ours when they are complete."""
        if self._fast is None:
            return
        needed, heard = self._fast
        heard += data
        if len(heard) < needed or now_ns > self._gives_up_ns:
            self._fast = None if now_ns > self._gives_up_ns else self._fast
            return
        self._fast = None
        self._answer += crc16(bytes(heard[:needed]) + self._answer)
        self._send_in(0)

    # --- instructions ----------------------------------------------------------------------------

    def _execute(self, heard: Packet) -> None:
        own, secondary = self.memory["id"], self.memory["secondary_id"]
        self._answers_as = own, self._delay_ns()
        is_broadcast = heard.unit == BROADCAST
        if heard.instruction in _GROUPS:
            if is_broadcast:
                self._group(heard)
            return
        if heard.unit == own or is_broadcast:
            self._single(heard, is_broadcast)
        elif heard.unit == secondary and secondary <= ID_MAX:
            self._secondary(heard)

    def _single(self, heard: Packet, is_broadcast: bool) -> None:
        level = self.memory["status_return_level"]
        if heard.instruction == _I.PING:
            model, firmware = self._model.number, self._firmware
            self._reply(Error.NONE, model.to_bytes(2, "little") + bytes((firmware,)))
            if is_broadcast:
                self._before = -1
                self.due_ns[self._send] += max(self.memory["id"] - 1, 0) * self._ping_step_ns()
        elif heard.instruction == _I.READ:
            if not is_broadcast and level >= 1:
                self._reply(*self._read(heard.parameters))
        else:
            rebooting = heard.instruction in (_I.REBOOT, _I.FACTORY_RESET, _I.BACKUP)
            error, follow_up = self._act(heard, is_broadcast)
            if not is_broadcast and level >= 2:
                self._reply(error)
                if rebooting and error is Error.NONE:  # the status goes out before the reboot
                    self.wake(self._send, 0)
                    self._send()
            if follow_up is not None:
                follow_up()

    def _ping_step_ns(self) -> int:
        """Return the time for one id in a broadcast ping, at least that of a status."""
        return max(_PING_STEP_NS, 15 * 10_000_000_000 // BAUD[self.memory["baud_rate"]])

    def _secondary(self, heard: Packet) -> None:
        """Execute an instruction to the secondary id: silent, and only in the RAM."""
        address = int.from_bytes(heard.parameters[:2], "little")
        in_ram = heard.instruction in (_I.WRITE, _I.REG_WRITE) and address >= RAM
        if in_ram or heard.instruction == _I.ACTION:
            self._act(heard, True)

    def _act(self, heard: Packet, is_broadcast: bool) -> tuple[Error, Callable[[], None] | None]:
        """Execute an instruction that changes something; return the error, and what follows it."""
        data = heard.parameters
        if heard.instruction == _I.WRITE:
            return self._write(data), None
        if heard.instruction == _I.REG_WRITE:
            if len(data) < 3:
                return Error.DATA_LENGTH, None
            self._registered = data
            self.memory["registered_instruction"] = 1
            return Error.NONE, None
        if heard.instruction == _I.ACTION:
            registered, self._registered = self._registered, None
            if registered is None:
                return Error.INSTRUCTION, None
            self.memory["registered_instruction"] = 0
            return self._write(registered), None
        if heard.instruction == _I.REBOOT:
            return Error.NONE, self._reboot
        if heard.instruction == _I.FACTORY_RESET:
            return self._reset(data, is_broadcast)
        if heard.instruction == _I.CLEAR and self._firmware >= 42:
            if data != _CLEAR_TURNS:
                return Error.DATA_RANGE, None
            if self.motion.is_moving():
                return Error.RESULT_FAIL, None
            self.motion.forget_turns()
            self.memory["goal_position"] = self.motion.position()
            return Error.NONE, None
        if heard.instruction == _I.BACKUP and self._firmware >= self._model.since_fast:
            return self._back_up(data)
        return Error.INSTRUCTION, None

    def _reboot(self) -> None:
        self.note("info", "reboots")
        self.boot(self.now_ns)

    def _reset(self, data: bytes, is_broadcast: bool) -> tuple[Error, Callable[[], None] | None]:
        keep = _KEEP.get(data[0]) if len(data) == 1 else None
        if keep is None:
            return Error.DATA_RANGE if len(data) == 1 else Error.DATA_LENGTH, None
        if is_broadcast and not keep and self._firmware >= 42:
            return Error.NONE, None  # refused, silently

        def reset() -> None:
            self.memory.factory_reset(keep)
            self._reboot()

        return Error.NONE, reset

    def _back_up(self, data: bytes) -> tuple[Error, Callable[[], None] | None]:
        if data[1:] != _BACKUP or data[0] not in (1, 2):
            return Error.DATA_RANGE, None
        if self.motion.is_on:
            return Error.RESULT_FAIL, None
        if data[0] == 1:
            self.memory.store()
            return Error.NONE, None
        if not self.memory.restore():
            return Error.RESULT_FAIL, None
        return Error.NONE, self._reboot

    # --- registers -------------------------------------------------------------------------------

    def _read(self, data: bytes) -> tuple[Error, bytes]:
        if len(data) != 4:
            return Error.DATA_LENGTH, b""
        address, length = data[0] | data[1] << 8, data[2] | data[3] << 8
        found = self._bytes(address, length)
        return (Error.ACCESS, b"") if found is None else (Error.NONE, found)

    def _bytes(self, address: int, length: int) -> bytes | None:
        memory = self.memory
        self.motion.refresh()
        memory["realtime_tick"] = max(0, self.now_ns - self._booted_ns) // _MS % 32_768
        memory["present_input_voltage"] = self._voltage
        memory["present_temperature"] = self._temperature
        return memory.read(address, length)

    def _write(self, data: bytes) -> Error:
        if len(data) < 3:
            return Error.DATA_LENGTH
        return self.memory.write(data[0] | data[1] << 8, data[2:], self._check, self._written)

    def _check(self, item: Item, value: int) -> Error:
        memory, name = self.memory, item.name
        if item.low is None or item.high is None:
            return Error.ACCESS
        if item.address < RAM and self.motion.is_on:
            return Error.ACCESS
        watchdog = memory["bus_watchdog"]
        if name == "bus_watchdog" and (value < 0 or (watchdog < 0 and value)):
            return Error.DATA_RANGE
        low, high = item.low, item.high
        if name == "goal_position" and memory["operating_mode"] != modes.POSITION:
            low, high = -EXTENDED_MAX, EXTENDED_MAX
        is_wrong = not low <= value <= high or (name in _GOALS and watchdog < 0)
        is_wrong |= name == "operating_mode" and value not in self._model.modes
        if is_wrong:
            return Error.DATA_RANGE
        if name in _LIMITS and abs(value) > memory[_LIMITS[name]]:
            return Error.DATA_LIMIT
        if name == "goal_position" and memory["operating_mode"] == modes.POSITION:
            low, high = memory["min_position_limit"], memory["max_position_limit"]
            return Error.NONE if low <= value <= high else Error.DATA_LIMIT
        return Error.NONE

    def _written(self, values: Mapping[str, int]) -> None:
        """Apply the consequences of a write."""
        memory = self.memory
        if "operating_mode" in values:
            self._enter_mode()
        if "torque_enable" in values:
            self._torque(bool(values["torque_enable"]))
        goals = [name for name in _GOALS if name in values]
        if goals and memory["drive_mode"] & 8 and self._firmware >= self._model.since_fast:
            kept = {name: memory[name] for name in goals}
            self._torque(True)
            for name, value in kept.items():
                memory[name] = value
        if {"goal_current", "current_limit"} & values.keys():
            self.motion.limit_current()
        wanted = {modes.CURRENT: _GOALS[1], modes.VELOCITY: _GOALS[2]}
        if wanted.get(memory["operating_mode"], _GOALS[3]) in values:
            self.motion.go()
        if "baud_rate" in values and self._line_bit_s not in (None, BAUD[memory["baud_rate"]]):
            self.warn("its baud rate is not that of the line; it is unreachable now")

    def _enter_mode(self) -> None:
        memory = self.memory
        memory.reset(("velocity_i", "velocity_p", "position_d", "position_i", "position_p"))
        memory["profile_acceleration"] = memory["profile_velocity"] = 0
        memory["goal_pwm"] = memory["pwm_limit"]
        if "goal_current" in memory.items:
            memory["goal_current"] = memory["current_limit"]
        if memory["operating_mode"] == modes.POSITION:
            self.motion.forget_turns()
        if memory["operating_mode"] == 16:
            self.warn("PWM mode (16) is not emulated; the motor has no current")
        self.motion.limit_current()

    # --- groups ----------------------------------------------------------------------------------

    def _group(self, heard: Packet) -> None:
        data, own = heard.parameters, self.memory["id"]
        places = _places(heard)
        mine = [place for place in places if place[0] == own]
        if not mine:
            return
        if heard.instruction in (_I.SYNC_WRITE, _I.BULK_WRITE):
            for _, address, length, at in mine:
                own_data = data[at : at + length]
                if len(own_data) == length:
                    self._write(address.to_bytes(2, "little") + own_data)
            return
        fast = heard.instruction in _FAST
        if fast and self._firmware < self._model.since_fast:
            return
        index = places.index(mine[0])
        _, address, length, _ = mine[0]
        found = self._bytes(address, length)
        self._gives_up_ns = self.now_ns + _PATIENCE_NS
        if fast:
            self._answer_fast(places, index, found)
            return
        self._reply(Error.NONE if found is not None else Error.ACCESS, found or b"")
        if index:
            self.wake(self._send, 0)
            self._before = places[index - 1][0]

    def _answer_fast(
        self, places: list[tuple[int, int, int, int]], index: int, found: bytes | None
    ) -> None:
        """Prepare our block of the common status."""
        length = places[index][2]
        error = Error.ACCESS if found is None else Error.NONE
        block = bytes((self._error(error), self.memory["id"])) + (found or bytes(length))
        if index == 0:
            total = 1 + sum(4 + place[2] for place in places)
            self._answer = HEADER + bytes((BROADCAST,)) + total.to_bytes(2, "little")
            self._answer += bytes((STATUS,)) + block
            self._answer += crc16(self._answer)
            self._send_in(self._delay_ns())
            return
        self._answer = block
        self._fast = 8 + sum(4 + place[2] for place in places[:index]), bytearray()


def _places(heard: Packet) -> list[tuple[int, int, int, int]]:
    """Return (id, address, length, place of its data) of each servo in a group packet."""
    data, places = heard.parameters, list[tuple[int, int, int, int]]()
    address, length = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
    if heard.instruction in (_I.SYNC_READ, _I.FAST_SYNC_READ):
        return [(unit, address, length, 0) for unit in data[4:]]
    at = 4 if heard.instruction == _I.SYNC_WRITE else 0
    while at < len(data):
        if heard.instruction == _I.SYNC_WRITE:
            places.append((data[at], address, length, at + 1))
            at += 1 + length
            continue
        if at + 5 > len(data):
            break  # the packet ends within an item
        own = int.from_bytes(data[at + 3 : at + 5], "little")
        place = int.from_bytes(data[at + 1 : at + 3], "little")
        places.append((data[at], place, own, at + 5))
        at += 5 + (own if heard.instruction == _I.BULK_WRITE else 0)
    return places


def _rate(line_bit_s: int | None, rates: Sequence[int]) -> dict[str, int]:
    """Return the register of the line's bit rate.

    Raises:
        SettingError: a servo cannot have it.
    """
    if line_bit_s is None:
        return {}
    if line_bit_s not in rates:
        known = ", ".join(map(str, rates))
        raise SettingError(("bus",), f"its bit rate is {line_bit_s} bit/s", f"allowed: {known}")
    return {"baud_rate": rates.index(line_bit_s)}


build: Final = drive_builder(DynamixelTable, Servo, api=1, bus_kinds=("serial",))
