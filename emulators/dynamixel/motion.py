"""Motor of a servo: modes, goals and profiles of the control table on an axis.

Positions of the table are counts: encoder count (0 to 4095 in one turn), turns since then, and
homing offset. The encoder reads 2048 at the zero of the output.

Choices of this emulator, where the maker publishes nothing: the control gains are kept without
effect, as the servo is the rig's; so are goal PWM and the operating mode for PWM (16), in which the
motor has no current. At torque on, the goal is the present position, or a velocity or current of 0.
The current is the motor's own, in all models. The present velocity is the output's, without noise.

Source: the maker's manuals, for profiles 64 V/A [ms] and 64 counts/V [ms].
"""

from math import pi
from typing import Final, final

from motorhil.emulators.api import Axis, MotorPlant
from motorhil.emulators.api import flags as f
from motorhil.emulators.dynamixel.memory import Memory
from motorhil.emulators.dynamixel.table import (
    CENTRE,
    COUNTS_S,
    COUNTS_S2,
    PWM_MAX,
    TURN,
    Model,
)

CURRENT: Final = 0
VELOCITY: Final = 1
POSITION: Final = 3
EXTENDED: Final = 4
CURRENT_BASED: Final = 5
_POSITIONS: Final = (POSITION, EXTENDED, CURRENT_BASED)
_REVERSE: Final = 1
_TIME_BASED: Final = 4
_AT_ONCE: Final = 1e12  # of a ramp without duration [counts/s^2]
_STEP: Final = 1e9  # of a profile without velocity [counts/s]
_OFFSET_MAX: Final = 1024  # in position mode
_IN_POSITION: Final = 10  # counts
_FOLLOWING: Final = 100  # counts


@final
class Motion:
    """The motor; its memory has the goals.

    Attributes:
        axis: the motor with its profile generator and servo.
        is_on: whether the motor has torque.
    """

    def __init__(self, axis: Axis, plant: MotorPlant, memory: Memory, model: Model) -> None:
        self.axis: Final = axis
        self.is_on: bool = False
        self._plant = plant
        self._memory = memory
        self._model = model
        self._inc_count: Final = plant.encoder_increments_rev * plant.gear_ratio / TURN
        self._turned = 0  # counts of whole turns that the position leaves out
        self._profile = 0  # bits 5 and 4 of the moving status

    # --- power -----------------------------------------------------------------------------------

    def power(self, on: bool) -> None:
        """Switch the torque; on: hold the present position, or rest."""
        memory, mode = self._memory, self._memory["operating_mode"]
        if on and mode == POSITION:
            self.forget_turns()
        self.is_on = on
        self.axis.power(on and mode != 16)
        self._profile = 0
        if on:
            memory["goal_position"] = self.position()
            memory["goal_velocity"] = 0
            if mode == CURRENT:
                memory["goal_current"] = 0
            self.limit_current()
            if mode in (CURRENT, VELOCITY):
                self.go()

    def forget_turns(self) -> None:
        """Fall back to one turn."""
        self._turned = self._encoder() // TURN * TURN

    def limit_current(self) -> None:
        """Apply the limits of the current."""
        memory, unit_a = self._memory, self._model.current_unit_a
        amps = self._plant.current_max_a
        if unit_a:
            based = memory["operating_mode"] == CURRENT_BASED
            amps = abs(memory["goal_current" if based else "current_limit"]) * unit_a
        self.axis.set_current_limit(amps)

    # --- goals -----------------------------------------------------------------------------------

    def go(self) -> None:
        """Begin to follow the goal of the mode; without torque, do nothing."""
        memory, axis = self._memory, self.axis
        mode = memory["operating_mode"]
        if not self.is_on or mode == 16:
            return
        ramp, speed = memory["profile_acceleration"], memory["profile_velocity"]
        if mode in _POSITIONS:
            self._move(memory["goal_position"], speed, ramp)
        elif mode == VELOCITY:
            goal = memory["goal_velocity"]
            steep = ramp * COUNTS_S2 if ramp else _AT_ONCE
            if ramp and memory["drive_mode"] & _TIME_BASED:
                steep = max(abs(goal) * COUNTS_S * 1000.0 / ramp, 1.0)
            steep *= self._inc_count
            axis.run_at(self._sign() * goal * COUNTS_S * self._inc_count, steep, steep)
        else:
            amps = self._sign() * memory["goal_current"] * self._model.current_unit_a
            axis.apply_current(amps, float("inf"))

    def _move(self, goal: int, speed: int, ramp: int) -> None:
        target = self._target_inc(goal)
        counts_s, counts_s2 = speed * COUNTS_S, ramp * COUNTS_S2 if ramp else _AT_ONCE
        if speed and self._memory["drive_mode"] & _TIME_BASED:
            rising_s = min(ramp, speed / 2.0) / 1e3
            way = abs(target - self.axis.demand_inc()) / self._inc_count
            counts_s = max(way / (speed / 1e3 - rising_s), COUNTS_S2 * 1e-6)
            counts_s2 = counts_s / rising_s if rising_s else _AT_ONCE
        self._profile = 0x00 if not speed else 0x30 if ramp else 0x10
        if not speed:
            counts_s, counts_s2 = _STEP, _AT_ONCE
        steep = counts_s2 * self._inc_count
        self.axis.move_to(target, counts_s * self._inc_count, steep, steep)

    def stop(self) -> None:
        """Stop at once, and hold the position."""
        if self.is_on and self._memory["operating_mode"] != 16:
            self._profile = 0
            self.axis.ramp_to_rest(_AT_ONCE * self._inc_count)

    # --- values read -----------------------------------------------------------------------------

    def position(self, inc: int | None = None) -> int:
        """Return the present position, or that of a count of the axis."""
        return self._encoder(inc) - self._turned + self._offset()

    def is_moving(self) -> bool:
        """Return whether a position profile runs, or the velocity is above the threshold."""
        speed = abs(self._velocity(self._counts_s()))
        return self.is_profiling() or speed > self._memory["moving_threshold"]

    def is_profiling(self) -> bool:
        """Return whether a position profile runs."""
        by_position = self._memory["operating_mode"] in _POSITIONS
        return by_position and bool(self.axis.flags & f.PROFILE_ACTIVE)

    def refresh(self) -> None:
        """Write the present values of the motor to the memory."""
        memory, axis = self._memory, self.axis
        amps, volts, plant = axis.current_a(), axis.winding_v(), self._plant
        unit_a = self._model.current_unit_a or plant.current_max_a / 1000.0
        sign = self._sign()
        memory["moving"] = self.is_moving()
        memory["moving_status"] = self._moving_status()
        pwm = round(PWM_MAX * volts / plant.supply_v)
        memory["present_pwm"] = sign * max(-PWM_MAX, min(PWM_MAX, pwm))
        memory["present_current"] = sign * round(amps / unit_a)
        memory["present_velocity"] = self._velocity(self._counts_s())
        memory["present_position"] = self.position()
        memory["velocity_trajectory"] = self._velocity(
            axis.demand_velocity_inc_s() / self._inc_count
        )
        memory["position_trajectory"] = self.position(axis.demand_inc())

    def _moving_status(self) -> int:
        if self._memory["operating_mode"] not in _POSITIONS or not self.is_on:
            return 0
        runs = self.is_profiling()
        error = abs(self.axis.following_error_inc()) / self._inc_count
        arrived = not runs and error <= _IN_POSITION
        return self._profile | (8 if error > _FOLLOWING else 0) | (2 if runs else 0) | arrived

    # --- units -----------------------------------------------------------------------------------

    def _sign(self) -> int:
        return -1 if self._memory["drive_mode"] & _REVERSE else 1

    def _offset(self) -> int:
        offset = self._memory["homing_offset"]
        in_one_turn = self._memory["operating_mode"] == POSITION
        return 0 if in_one_turn and abs(offset) > _OFFSET_MAX else offset

    def _encoder(self, inc: int | None = None) -> int:
        counts = int((self.axis.position_inc() if inc is None else inc) // self._inc_count)
        return self._sign() * counts + CENTRE

    def _target_inc(self, goal: int) -> int:
        """Return the axis's increments in the middle of a count."""
        counts = goal - self._offset() + self._turned - CENTRE
        return int((self._sign() * counts + 0.5) * self._inc_count // 1.0)

    def _counts_s(self) -> float:
        return self.axis.output_velocity_rad_s() * TURN / (2.0 * pi)

    def _velocity(self, counts_s: float) -> int:
        return round(self._sign() * counts_s / COUNTS_S)
