"""One axis of a drive: profile generator, servo and plant, advanced lazily and exactly.

Nothing here runs by itself. `at(now_ns)` makes the readings those of the last servo tick at or
before `now_ns`; commands take effect at the tick after it; `next_event_ns` says when to come back.
What the readings are never depends on who looked, or when, or how often.

Positions are increments of the encoder. Tick k is at k * tick_ns.
"""

from typing import final

from emulators.firmware import flags as f
from emulators.firmware import profile
from emulators.firmware.gains import ServoGains
from emulators.plant.dc_motor import PI, MotorPlant

_OFF = 0
_POSITION = 1
_VELOCITY = 2


@final
class Axis:
    """One motor with everything a drive's firmware does to it; sans-I/O, no clock.

    `flags` (see emulators.firmware.flags) are those at the last `at`, except that a command changes
    them at once: a move sets PROFILE_ACTIVE and takes IN_TARGET_WINDOW away until it is over.
    """

    def __init__(
        self,
        plant: MotorPlant,
        gains: ServoGains,
        tick_ns: int = 1_000_000,
        current_steps: int = 10,
        initial_position_inc: int = 0,
    ) -> None:
        self.flags = 0
        self._plant = plant
        self._gains = gains
        self._tick_ns = tick_ns
        self._current_steps = current_steps
        self._tick = 0
        self._origin = 0
        self._offset = 0
        self._mode = _OFF
        self._profile = profile.hold(float(initial_position_inc))
        self._demand = float(initial_position_inc)
        self._velocity = 0.0
        self._target = float(initial_position_inc)
        self._wanted = 0.0
        self._cyclic = True
        self._in_target_ticks = 0

    # --- time ---------------------------------------------------------------------------------

    def at(self, now_ns: int) -> None:
        """Readings and flags are now those of tick now_ns // tick_ns. Changes no behaviour."""
        tick = now_ns // self._tick_ns
        while self._tick < tick:
            self._tick += 1
            self._step()

    def next_event_ns(self, limit_ns: int | None = None) -> int | None:
        """When to call `at` and look again [ns], counted from the last `at`.

        It is the next tick at which the flags change, or an earlier time at which work must go on,
        never later than `limit_ns`; None: nothing will ever change without a command.
        """
        if self._at_rest():
            return None
        next_ns = (self._tick + 1) * self._tick_ns
        return next_ns if limit_ns is None or next_ns < limit_ns else limit_ns

    # --- readings, at the time of the last at() -------------------------------------------------

    def position_inc(self) -> int:
        """What the encoder counts, from the zero that was set."""
        return int(self._demand) + self._offset

    def velocity_inc_s(self) -> float:
        """Velocity as measured by the firmware from the encoder; exactly 0.0 at standstill."""
        return self._velocity * 1e9 / self._tick_ns

    def demand_inc(self) -> int:
        """Where the axis should be now; the actual position where no position is controlled."""
        return int(self._demand) + self._offset

    def demand_velocity_inc_s(self) -> float:
        """How fast the axis should be now."""
        return self._velocity * 1e9 / self._tick_ns

    def target_inc(self) -> int:
        """Where the last move, ramp or hold ends; the actual position where there is none."""
        return int(self._target) + self._offset

    def following_error_inc(self) -> int:
        """Demand minus actual position; 0 where no position is controlled."""
        return 0

    def current_a(self) -> float:
        """Motor current."""
        return 0.0

    def current_demand_a(self) -> float:
        """Current asked for by the velocity loop, after the limit."""
        return 0.0

    def torque_n_m(self) -> float:
        """Torque of the motor times the gear ratio: friction and inertia not taken off."""
        return self.current_a() * self._plant.torque_constant_n_m_a * self._plant.gear_ratio

    def output_position_rad(self) -> float:
        """The truth behind the gear, not quantised; `set_position` does not move it."""
        turns = self._demand / self._plant.encoder_increments_rev
        return turns * 2.0 * PI / self._plant.gear_ratio

    def output_velocity_rad_s(self) -> float:
        """The truth behind the gear, not quantised."""
        turns_s = self.velocity_inc_s() / self._plant.encoder_increments_rev
        return turns_s * 2.0 * PI / self._plant.gear_ratio

    # --- commands, from the tick after the last at() --------------------------------------------

    def power(self, on: bool) -> None:
        """On: the position is held where it is. Off: no current flows, the motor coasts."""
        self._mode = _POSITION if on else _OFF
        self._command(profile.hold(self._demand), cyclic=True)
        self.flags = f.POWERED if on else 0

    def move_to(
        self,
        target_inc: int,
        velocity_inc_s: float,
        acceleration_inc_s2: float,
        deceleration_inc_s2: float,
    ) -> None:
        """Come to rest at the target by a trapezoid, from the present demand.

        With velocity 0 the axis ramps to rest where it is and the profile stays active.

        Raises:
            ValueError: velocity < 0, or acceleration or deceleration <= 0.
            RuntimeError: power is off.
        """
        self._require_power()
        tick_s = self._tick_ns / 1e9
        self._target = float(target_inc - self._offset)
        pieces = profile.move(
            self._demand,
            self._velocity,
            self._target,
            velocity_inc_s * tick_s,
            acceleration_inc_s2 * tick_s * tick_s,
            deceleration_inc_s2 * tick_s * tick_s,
        )
        self._mode = _POSITION
        self._command(pieces, cyclic=False)

    def run_at(
        self, velocity_inc_s: float, acceleration_inc_s2: float, deceleration_inc_s2: float
    ) -> None:
        """Reach this velocity and keep it, by the velocity loop alone.

        Raises:
            ValueError: acceleration or deceleration <= 0.
            RuntimeError: power is off.
        """
        self._require_power()
        tick_s = self._tick_ns / 1e9
        pieces = profile.ramp(
            self._demand,
            self._velocity,
            velocity_inc_s * tick_s,
            acceleration_inc_s2 * tick_s * tick_s,
            deceleration_inc_s2 * tick_s * tick_s,
        )
        self._mode = _VELOCITY
        self._command(pieces, cyclic=False)

    def ramp_to_rest(self, deceleration_inc_s2: float) -> None:
        """Brake along a ramp, then hold where it ends (quick stop, halt).

        Raises:
            ValueError: deceleration <= 0.
            RuntimeError: power is off.
        """
        self._require_power()
        tick_s = self._tick_ns / 1e9
        size = deceleration_inc_s2 * tick_s * tick_s
        pieces = profile.ramp(self._demand, self._velocity, 0.0, size, size)
        self._mode = _POSITION
        self._target = pieces[-1][2]
        self._command(pieces, cyclic=False)

    def follow(self, position_inc: int, over_ns: int) -> None:
        """Go evenly from the present demand to this one in `over_ns`, then hold (csp).

        It is no profile: PROFILE_ACTIVE and IN_TARGET_WINDOW stay off.

        Raises:
            RuntimeError: power is off.
        """
        self._require_power()
        self._mode = _POSITION
        self._target = float(position_inc - self._offset)
        pieces = profile.line(self._demand, self._target, over_ns / self._tick_ns)
        self._command(pieces, cyclic=True)

    def hold(self) -> None:
        """Stand at the present demand at once, without a ramp.

        Raises:
            RuntimeError: power is off.
        """
        self._require_power()
        self._mode = _POSITION
        self._command(profile.hold(self._demand), cyclic=False)

    def set_windows(
        self,
        *,
        target_window_inc: int | None = None,
        target_window_ns: int | None = None,
        following_window_inc: int | None = None,
        following_window_ns: int | None = None,
        velocity_window_inc_s: float | None = None,
        velocity_window_ns: int | None = None,
        velocity_threshold_inc_s: float | None = None,
        velocity_threshold_ns: int | None = None,
    ) -> None:
        """The flags' windows and how long they must hold; None leaves one as it was.

        A flag changes at the first tick at which its condition has held for the time. To switch a
        window off, make it huge.
        """

    def set_load(self, torque_n_m: float) -> None:
        """The load's torque at the output; positive turns towards negative positions."""

    def set_current_limit(self, current_a: float) -> None:
        """The velocity loop asks for no more than this, nor than the plant's current_max_a."""

    def set_position(self, position_inc: int) -> None:
        """The present position is called `position_inc` from now on; nothing moves (homing)."""
        self._offset = position_inc - int(self._demand)

    def set_position_offset(self, offset_inc: int) -> None:
        """Positions are the encoder's own plus this from now on; nothing moves."""
        self._offset = offset_inc

    def position_offset_inc(self) -> int:
        """What is added to the encoder's own position."""
        return self._offset

    # --- inside -----------------------------------------------------------------------------------

    def _require_power(self) -> None:
        if self._mode == _OFF:
            raise RuntimeError("the power stage is off: call power(True) first")

    def _command(self, pieces: profile.Profile, *, cyclic: bool) -> None:
        self._profile = pieces
        self._origin = self._tick
        self._cyclic = cyclic
        self._in_target_ticks = 0
        self.flags = f.POWERED if cyclic else f.POWERED | f.PROFILE_ACTIVE

    def _at_rest(self) -> bool:
        active = self.flags & f.PROFILE_ACTIVE != 0
        return self._mode == _OFF or (
            not active and self._tick - self._origin > profile.duration_ticks(self._profile) + 1
        )

    def _step(self) -> None:
        t = float(self._tick - self._origin)
        position, self._velocity = profile.demand_at(self._profile, t)
        self._demand = (position + 0.5) // 1.0
        flags = 0 if self._mode == _OFF else f.POWERED
        if t < profile.duration_ticks(self._profile):
            if not self._cyclic:
                flags |= f.PROFILE_ACTIVE
        elif self._mode == _POSITION and not self._cyclic:
            flags |= f.IN_TARGET_WINDOW
        if self._velocity == 0.0:
            flags |= f.SPEED_ZERO
        elif t >= profile.duration_ticks(self._profile):
            flags |= f.IN_VELOCITY_WINDOW
        self.flags = flags
