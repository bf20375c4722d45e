"""The servo's states along time, computed on demand with reproducible results.

The state of a tick depends only on the previous state and the commands. The time of the
computation, its portions and its repetitions are therefore free. This module uses that freedom:

- `reach(tick)` computes up to a tick in one go. Without a reader nothing is computed.
- `next_tick(limit)` must know the next change of flags, so it runs *ahead*. The computed states are
  kept as the answer for later. A command discards them.
- For a reading in between, the few ticks up to it are run again from the last state kept. A reader
  tends to be periodic, and there are seldom more than two. So the gaps between readings tend to
  alternate, and states are kept where the next readings are then expected.

The distance to run ahead is learned from how often commands made it useless. Readings must not
influence it: a drive's wake-up time decides its turn among simultaneous events. The wake-up time
may depend on commands, but not on readers.
"""

from typing import Final, final

from motorhil.emulators.firmware import nonlinear_servo, servo
from motorhil.emulators.firmware.nonlinear_tables import Conditions, ExtrasTables
from motorhil.emulators.firmware.servo_tables import LoadTable, ServoTables, StepTable, TickTable

_BUDGET_MAX: Final = 64  # ticks run ahead at most
_PATIENCE_MAX: Final = 64  # maximum undisturbed ticks to wait before running ahead again
# While only the temperature changes, few ticks are computed, so more are run ahead.
_STILL_MIN: Final = 32
_STILL_MAX: Final = 10_000

RESTS: Final = -1
_NEVER: Final = 1 << 62
NO_CONDITIONS: Final[Conditions] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@final
class Timeline:
    """The state at one tick, which only moves forward, and the states computed beyond it.

    Attributes:
        tick: the present tick.
        state: the state at `tick`, for all readers.
        resting: True if `state` is also the state of every later tick.
        commands: number of commands so far.
    """

    def __init__(
        self,
        tables: ServoTables,
        load_torque_n_m: float,
        windows: servo.Windows,
        orders: servo.Orders,
        state: servo.State,
        extras: ExtrasTables | None = None,
        conditions: Conditions = NO_CONDITIONS,
    ) -> None:
        self._extras: ExtrasTables | None = extras
        self._conditions: Conditions = conditions
        self._tables: ServoTables = tables
        self._tick_table: TickTable = tables.tick
        self._step_table: StepTable = tables.step
        self._current_steps: Final = tables.current_steps

        self._load: LoadTable = tables.load(load_torque_n_m)
        self._windows: servo.Windows = windows
        self._orders: servo.Orders = orders

        self.tick: int = 0
        self.state: servo.State = state
        self.resting: bool = False
        self.commands: int = 0

        self._ahead_tick = 0
        self._ahead: servo.State = state
        self._ahead_resting = False
        self._between: list[tuple[int, servo.State]] = []

        self._budget = 1  # ticks to run ahead
        self._still = 0  # the same while only the temperature has changed since the last command
        self._patience = 0  # ticks to wait after the next useless run ahead
        self._wait = 0  # ticks left to wait
        self._commanded = False  # since the last `next_tick`
        self._look_tick = 0  # the last reading at a tick before `_ahead_tick`
        self._look_gap = 0  # ticks between the last two readings
        self._gap_before = 0  # ticks between the two before; two readers make gaps alternate

    # --- time -------------------------------------------------------------------------------------

    def reach(self, tick: int) -> None:
        """Advance `state` to `tick`, which must not be before the present one."""
        if tick < self._ahead_tick:
            if tick == self.tick:
                return
            self._gap_before = self._look_gap
            self._look_gap = tick - self._look_tick
            self._look_tick = tick
            self.state = self._look_between(tick)
        else:
            if tick > self._ahead_tick and not self._ahead_resting:
                self._ahead, _, self._ahead_resting = self._run(
                    self._ahead_tick, self._ahead, tick - self._ahead_tick, False
                )
            self._ahead_tick = tick
            self._between.clear()
            self.state = self._ahead
            self.resting = self._ahead_resting
        self.tick = tick

    def next_tick(self, limit_tick: int) -> int:
        """Return the next tick > `tick` at which the flags change, or before which they do not.

        `RESTS` if they never change again. The result can be beyond the limit, but no tick is
        computed there.
        """
        if self.resting:
            return RESTS
        if self._ahead_tick <= self.tick:
            if not self._commanded:
                self._learn()
            self._commanded = False
            budget = self._still if self._still > self._budget else self._budget
            self._run_ahead(min(self.tick + budget, limit_tick))
        ahead_tick = self._ahead_tick
        if self._ahead_resting:  # without a change of flags on the way
            return RESTS
        if ahead_tick == limit_tick and self._ahead[servo.I_FLAGS] == self.state[servo.I_FLAGS]:
            return limit_tick + 1
        return ahead_tick if ahead_tick > self.tick else self.tick + 1

    # --- commands ---------------------------------------------------------------------------------

    def order(self, orders: servo.Orders, state: servo.State) -> None:
        """Apply new orders from the next tick on; `state` is the present state under them."""
        self._drop_ahead()
        self._orders = orders
        self.state = self._ahead = state

    def set_load(self, torque_n_m: float) -> None:
        """Set the load torque at the output."""
        self._drop_ahead()
        self._load = self._tables.load(torque_n_m)

    def set_conditions(self, conditions: Conditions) -> None:
        """Set the conditions of a nonlinear plant."""
        self._drop_ahead()
        self._conditions = conditions

    def set_tables(
        self, tables: ServoTables, load_torque_n_m: float, extras: ExtrasTables | None = None
    ) -> None:
        """Set new tables (other gains) from the next tick on, with the same load."""
        self._drop_ahead()
        self._extras = extras
        self._tables = tables
        self._tick_table = tables.tick
        self._step_table = tables.step
        self._load = tables.load(load_torque_n_m)

    def set_windows(self, windows: servo.Windows) -> None:
        """Set the windows from the next tick on."""
        self._drop_ahead()
        self._windows = windows

    # --- internals --------------------------------------------------------------------------------

    def _run(
        self, tick: int, state: servo.State, ticks: int, watch: bool
    ) -> tuple[servo.State, int, bool]:
        if self._extras is not None:
            return nonlinear_servo.run(
                self._extras,
                self._conditions,
                self._windows,
                self._orders,
                state,
                tick,
                ticks,
                watch,
            )
        return servo.run(
            self._tick_table,
            self._step_table,
            self._current_steps,
            self._load,
            self._windows,
            self._orders,
            state,
            tick,
            ticks,
            watch,
        )

    def _look_between(self, tick: int) -> servo.State:
        """Return the state of a tick before `_ahead_tick`, from the nearest state kept."""
        start, state = self.tick, self.state
        while self._between and self._between[0][0] <= tick:
            start, state = self._between.pop(0)
        if start < tick:
            state, _, _ = self._run(start, state, tick - start, False)
        return state

    def _run_ahead(self, stop: int) -> None:
        """Run on from `_ahead_tick` until `stop`, a change of flags, or rest."""
        flags = self._ahead[servo.I_FLAGS]
        while self._ahead_tick < stop and not self._ahead_resting:
            ticks = min(stop, self._next_look()) - self._ahead_tick
            self._ahead, made, self._ahead_resting = self._run(
                self._ahead_tick, self._ahead, ticks, True
            )
            self._ahead_tick += made
            if self._ahead[servo.I_FLAGS] != flags:
                break
            if self._ahead_tick < stop:
                self._between.append((self._ahead_tick, self._ahead))

    def _next_look(self) -> int:
        """Return the tick after `_ahead_tick` at which the next reading is expected."""
        gap = self._gap_before
        period = gap + self._look_gap
        if period == 0:
            return _NEVER
        since = (self._ahead_tick - self._look_tick) % period
        return self._ahead_tick - since + (gap if since < gap else period)

    def _drop_ahead(self) -> None:
        """Discard the states run ahead, because of a command."""
        if self._ahead_tick > self.tick and not self._ahead_resting:
            self._budget = 0
            self._patience = min(2 * self._patience + 1, _PATIENCE_MAX)
            self._wait = self._patience
        self._still = 0
        self.commands += 1
        self._commanded = True
        self._ahead_tick = self.tick
        self._ahead = self.state
        self._ahead_resting = False
        self.resting = False
        self._between.clear()

    def _learn(self) -> None:
        """Run ahead further next time, or wait less, because the last run ahead was useful."""
        if self._extras is not None:
            is_still = nonlinear_servo.is_still(self.state)
            self._still = min(_STILL_MIN + 2 * self._still, _STILL_MAX) if is_still else 0
        if self._wait > 0:
            self._wait -= 1
        elif self._budget == 0:
            self._budget = 1
        elif self._budget < _BUDGET_MAX:
            self._budget *= 2
        else:
            self._patience = 0
