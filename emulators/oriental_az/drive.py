"""An AZ drive: direct data operation, stored data, inputs and outputs.

The block 0058h to 0065h describes an operation. Writing the trigger behind it makes it effective at
once, in mid-motion as well. Writing the same trigger value again has no effect, unless the drive
clears the trigger after execution (a parameter of the drive; here a key of the rig).

Its encoder is absolute: the drive knows its position from power-on, also after a loss of power.
"""

from collections.abc import Callable, Mapping
from typing import Final, final

from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import NEVER_NS
from motorhil.emulators.modbus.drive import ModbusDrive
from motorhil.emulators.modbus.registers import RegisterBank
from motorhil.emulators.modbus.server import Identification
from motorhil.emulators.modbus.settings import DriveBuilder, ModbusDriveSettings
from motorhil.emulators.oriental_az import registers as r
from motorhil.emulators.oriental_az.settings import OrientalTable

_FUNCTIONS: Final = (0x03, 0x06, 0x08, 0x10, 0x17)
_AUTO_OFF_NS: Final = 4_000_000
_MS: Final = 1_000_000
_HOME_SPEED_HZ: Final = 5000  # of ZHOME
_DEVIATION_TURNS: Final = 3.0
"""The key of the drive parameter of that name, whose address is not known."""


@final
class OrientalAz(ModbusDrive):
    """The drive; `register_map` documents its registers.

    Raises: as `ModbusDrive`.
    """

    def __init__(self, settings: ModbusDriveSettings) -> None:
        names = {0: "motorhil", 1: "AZ drive", 2: "1.0"}
        super().__init__(settings, RegisterBank(r.ROWS), Identification(names), _FUNCTIONS)
        self._clears_trigger = settings.trigger_auto_clear  # after execution
        self._auto_off_ns = NEVER_NS
        self._inputs = 0  # both words, previous state
        self._is_home = False
        self._goes_home = False
        self._clear_later = False  # clear the trigger after the request that wrote it
        self._counts: dict[str, int] = {}  # of the block: values effective since the last trigger
        self._bind()

    def _bind(self) -> None:
        bank = self.bank
        bank.on_read("outputs", self.outputs)
        bank.on_read("command_position", lambda: self.steps(self.axis.demand_inc()))
        bank.on_read("feedback_position", lambda: self.steps(self.axis.position_inc()))
        bank.on_read("command_speed", lambda: self._hz(self.axis.demand_velocity_inc_s()))
        bank.on_read("feedback_speed", lambda: self._hz(self.axis.velocity_inc_s()))
        bank.on_read("feedback_speed_rpm", self._rpm)
        bank.on_write("trigger", self._triggered)
        bank.on_write("inputs", lambda value: self._input_words(value, None))
        bank.on_write("inputs_auto_off", lambda value: self._input_words(None, value))
        bank.on_write("alarm_reset", self._maintained(self._reset_alarm))
        bank.on_write("preset", self._maintained(self._preset))

    # --- units ---------------------------------------------------------------------------------

    def _steps_turn(self) -> tuple[int, int]:
        """Return the steps per turn, as a fraction."""
        return r.STEPS_PER_TURN * self.bank["gear_b"], self.bank["gear_a"]

    def steps(self, inc: int) -> int:
        """Convert encoder increments to steps, rounded to the nearest."""
        steps, turns = self._steps_turn()
        whole = turns * self.turn_inc
        return (2 * inc * steps + whole) // (2 * whole)

    def inc(self, steps: int) -> int:
        """Convert steps to encoder increments, rounded to the nearest."""
        whole, turns = self._steps_turn()
        return (2 * steps * turns * self.turn_inc + whole) // (2 * whole)

    def inc_s(self, hz: float) -> float:
        """Convert a velocity from [Hz] to [inc/s], or an acceleration from [Hz/s] to [inc/s^2]."""
        steps, turns = self._steps_turn()
        return hz * turns * self.turn_inc / steps

    def _hz(self, inc_s: float) -> int:
        steps, turns = self._steps_turn()
        return int((inc_s * steps / (turns * self.turn_inc) + 0.5) // 1.0)

    def _rpm(self) -> int:
        return int((self.axis.velocity_inc_s() * 60.0 / self.turn_inc + 0.5) // 1.0)

    # --- values read -----------------------------------------------------------------------------

    def is_excited(self) -> bool:
        """Return whether the motor has current."""
        return not self._inputs & r.FREE and not self.bank["alarm"]

    def is_moving(self) -> bool:
        """Return whether an operation is in progress."""
        return bool(self.axis.flags & f.PROFILE_ACTIVE) or self.axis.demand_velocity_inc_s() != 0.0

    def outputs(self) -> int:
        """Return the outputs, 007Eh and 007Fh."""
        moving = self.is_excited() and self.is_moving()
        word = r.ALARM if self.bank["alarm"] else 0
        word |= r.MOVE if moving else 0
        word |= r.HOME_END if self._is_home else 0
        if self.is_excited():
            word |= 0 if moving or self._inputs & r.STOP else r.READY
            word |= r.IN_POSITION if self.axis.flags & f.IN_TARGET_WINDOW else 0
        return word

    # --- direct data operation -------------------------------------------------------------------

    def _triggered(self, value: int) -> int:
        bank = self.bank
        if value == 0 or (value == bank["trigger"] and not self._clears_trigger):
            return 0
        if value == r.TRIGGER_ALL:
            self._counts = {name: bank[name] for name in r.TRIGGERS.values()}
        elif self._counts:
            self._counts[r.TRIGGERS[value]] = bank[r.TRIGGERS[value]]
        else:
            self.tell("warning", f"trigger {value} ignored: nothing was triggered before")
            return 0
        self._operate(self._counts)
        if self._clears_trigger:
            self._clear_later = True
        return 0

    def _operate(self, data: Mapping[str, int]) -> None:
        axis = self.axis
        kind = data["operation_type"]
        if kind not in r.TYPES:
            self.tell("warning", f"operation type {kind} ignored: it has no such")
            return
        if not self.is_excited() or (self._inputs & r.STOP and kind not in (0, 32)):
            self.tell("warning", f"operation type {kind} ignored: the motor may not move")
            return
        slower = self.inc_s(data["deceleration"])
        axis.set_current_limit(self.settings.plant.current_max_a * data["current"] / 1000.0)
        self._is_home = self._goes_home = False
        if kind == r.STOP_AT_ONCE:
            axis.hold()
        elif kind == r.DECELERATE:
            axis.ramp_to_rest(slower)
        elif kind == r.CONTINUOUS:
            axis.run_at(self.inc_s(data["speed"]), self.inc_s(data["rate"]), slower)
        else:
            steps = data["position"]
            if kind == r.RELATIVE_TO_COMMAND:
                target = self.inc(steps) + axis.demand_inc()
            elif kind == r.RELATIVE_TO_FEEDBACK:
                target = self.inc(steps) + axis.position_inc()
            else:
                target = self.inc(steps + self.wraps(self.steps(axis.demand_inc())))
            self._go(target, abs(data["speed"]), data["rate"], slower)

    def _go(self, target_inc: int, hz: int, rate_hz_s: int, slower: float) -> None:
        self.axis.move_to(target_inc, self.inc_s(hz), self.inc_s(rate_hz_s), slower)

    # --- inputs ----------------------------------------------------------------------------------

    def _input_words(self, held: int | None, pulsed: int | None) -> int:
        held = self.bank["inputs"] if held is None else held
        if pulsed is not None and pulsed:
            self._auto_off_ns = self.now_ns + _AUTO_OFF_NS
        pulsed = self.bank["inputs_auto_off"] if pulsed is None else pulsed
        self._see_inputs(held | pulsed)
        return 0

    def _see_inputs(self, word: int) -> None:
        before, self._inputs = self._inputs, word
        rising = word & ~before
        if rising & r.ALARM_RESET:
            self._reset_alarm()
        if (word ^ before) & r.FREE:
            self.axis.power(self.is_excited())
        if not self.is_excited():
            return
        slower = self.inc_s(self.bank["data0_deceleration"])
        number = word & r.M_MASK
        if rising & r.STOP and self.is_moving():
            self.axis.ramp_to_rest(slower)
        if word & r.STOP:
            return
        if rising & r.START:
            names = r.TRIGGERS.values()
            data = {n: self.bank[f"data{number}_{n}"] for n in names if n != "data_number"}
            self._operate(data)
        elif rising & r.ZHOME:
            self._is_home, self._goes_home = False, True
            self._go(0, _HOME_SPEED_HZ, self.bank["data0_rate"], slower)
        elif (word ^ before) & (r.FORWARD | r.BACKWARD):
            self._run(word, number)

    def _run(self, word: int, number: int) -> None:
        """Run by FW-POS or RV-POS, as long as one of them is on."""
        way = bool(word & r.FORWARD) - bool(word & r.BACKWARD)
        slower = self.inc_s(self.bank[f"data{number}_deceleration"])
        self._is_home = self._goes_home = False
        if way:
            speed = way * abs(self.bank[f"data{number}_speed"])
            self.axis.run_at(self.inc_s(speed), self.inc_s(self.bank[f"data{number}_rate"]), slower)
        else:
            self.axis.ramp_to_rest(slower)

    # --- maintenance -----------------------------------------------------------------------------

    def _maintained(self, action: Callable[[], None]) -> Callable[[int], int]:
        """Return a writer that executes a command when its register is set to 1."""

        def write(value: int) -> int:
            if value == 1:
                action()
            return 0

        return write

    def _reset_alarm(self) -> None:
        if self.bank["alarm"]:
            self.bank["alarm"] = 0
            self.tell("info", "alarm reset")
            self.axis.power(self.is_excited())

    def _preset(self) -> None:
        if not self.is_moving():
            self.axis.set_position(0)
            self._is_home = True

    # --- events ----------------------------------------------------------------------------------

    def power_on(self) -> None:
        """Excite the motor and hold the known position."""
        self._inputs = 0
        self._auto_off_ns = NEVER_NS
        self._is_home = self._goes_home = False
        self._counts = {}
        window_inc = round(_DEVIATION_TURNS * self.turn_inc)
        self.axis.set_windows(following_window_inc=window_inc, following_window_ns=1 * _MS)
        self.axis.power(True)

    def power_off(self) -> None:
        """Forget everything except the position."""
        self._auto_off_ns = NEVER_NS

    def settle(self) -> None:
        """Clear the trigger, switch pulsed inputs off and check the deviation."""
        if self._clear_later:
            self._clear_later = False
            self.bank["trigger"] = 0
        if self.now_ns >= self._auto_off_ns:
            self._auto_off_ns = NEVER_NS
            self.bank["inputs_auto_off"] = 0
            self._see_inputs(self.bank["inputs"])
        if self.axis.flags & f.FOLLOWING_ERROR and self.is_excited():
            self.alarm(r.EXCESSIVE_DEVIATION)
        if self._goes_home and not self.axis.flags & f.PROFILE_ACTIVE:
            self._goes_home, self._is_home = False, True

    def wake_ns(self) -> int:
        """Return when pulsed inputs go off."""
        return self._auto_off_ns

    def alarm(self, code: int) -> None:
        """Raise the alarm; the motor has no current."""
        text = r.ALARMS.get(code)
        self.tell("error", f"alarm {code:02X}h" + (f" ({text})" if text else ""))
        self.bank["alarm"] = code
        self.axis.power(False)

    def own_truth(self) -> Mapping[str, float]:
        """Return its output word and its alarm."""
        return {"outputs": float(self.outputs()), "alarm": float(self.bank["alarm"])}


build: Final = DriveBuilder(OrientalAz, r.ROWS, OrientalTable)
