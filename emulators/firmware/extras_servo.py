"""The servo with a nonlinear plant behind it, tick by tick.

This is the counterpart of `servo.run`. The plant's tick is `extras_step.tick`. The servo's part
(encoder, loops, flags) comes from `servo.run` itself, with tables that move nothing.

Temperature and I2t are slow, so they are updated only every `slow_ticks` ticks, from the losses of
the ticks in between. The losses are counted in integers, whose sums are exact however the ticks are
grouped. Where nothing else changes, the ticks up to the next update are skipped, and the results
stay the same to the last bit. A motor that holds still while it cools costs one update every SLOW_S
seconds. Once its temperature is steady too, it costs nothing.

The state contains, in addition to that of `servo.run`: the load's speed [rad/s] and position
[increments], both on the motor's side; the DC link [V]; winding and housing [degC]; the I2t level,
0..1; losses since the last update and in the last tick [counts]; 1.0 if that tick changed nothing
else.
"""

from typing import Final

from emulators.firmware import extras_step, servo
from emulators.firmware.extras_tables import Conditions, ExtrasTables
from emulators.firmware.flags import (
    AT_STOP,
    I2T_LIMIT,
    I2T_WARNING,
    OF_EXTRAS,
    OUTSIDE_GATE,
    OVER_TEMPERATURE,
    OVER_VOLTAGE,
    TEMPERATURE_WARNING,
    UNDER_VOLTAGE,
)

E_LOAD_SPEED: Final = 0
E_LOAD_POSITION: Final = 1
E_DC_LINK: Final = 2
E_WINDING: Final = 3
E_HOUSING: Final = 4
E_I2T: Final = 5
E_LOSSES: Final = 6
E_LAST: Final = 7
E_STILL: Final = 8

_AT_REST: Final = -1.0  # losses: every tick since the last update was like the last one
_SETTLED_K: Final = 1e-9  # a change of temperature per update that is small enough to ignore


def standing(tables: ExtrasTables, count: float, source_v: float) -> servo.State:
    """Return the state of a motor without power, at rest at `count` and at ambient temperature."""
    extras = (
        *(0.0, count + 0.5, source_v),
        *(tables.ambient_c, tables.ambient_c, 0.0, 0.0, 0.0, 0.0),
    )
    return (*servo.standing(count)[:19], extras)


def is_still(state: servo.State) -> bool:
    """Return True if the last tick changed only the slow values."""
    return state[servo.I_EXTRAS][E_STILL] == 1.0


def own_flags(
    tables: ExtrasTables,
    conditions: Conditions,
    xl: float,
    supply: float,
    winding: float,
    level: float,
) -> int:
    """Return the flags of nonlinear plants, which `servo.run` does not set."""
    _, _, high_v, low_v, limit_c, warning_c, i2t_warning, gate_low, gate_high = conditions
    flags = 0
    if supply > high_v:
        flags = OVER_VOLTAGE
    elif supply < low_v:
        flags = UNDER_VOLTAGE
    if tables.has_heat and winding >= warning_c:
        flags |= TEMPERATURE_WARNING
    if tables.has_heat and winding >= limit_c:
        flags |= OVER_TEMPERATURE
    if tables.has_i2t and level >= i2t_warning:
        flags |= I2T_WARNING
    if level >= 1.0:
        flags |= I2T_LIMIT
    if xl >= tables.high or xl <= tables.low:
        flags |= AT_STOP
    count = servo.whole(xl)
    if count < gate_low or count >= gate_high:
        flags |= OUTSIDE_GATE
    return flags


def reckon(
    tables: ExtrasTables, winding: float, housing: float, level: float, losses: float
) -> tuple[float, float, float]:
    """Return winding, housing [degC] and I2t level after `slow_ticks` ticks with these losses."""
    square = losses / (tables.heat_scale * tables.slow_ticks)
    if tables.has_i2t:
        level += (square - tables.i2t_square) * tables.i2t_rise
        level = 0.0 if level < 0.0 else 1.0 if level > 1.0 else level
    if tables.has_heat:
        ww, wh, wp, hw, hh, hp = tables.warming
        ambient = tables.ambient_c
        power = tables.resistance_ohm(tables.index(winding)) * square
        dw = winding - ambient
        dh = housing - ambient
        winding1 = ambient + (ww * dw + wh * dh + wp * power)
        housing1 = ambient + (hw * dw + hh * dh + hp * power)
        if not (
            -_SETTLED_K < winding1 - winding < _SETTLED_K
            and -_SETTLED_K < housing1 - housing < _SETTLED_K
        ):
            return winding1, housing1, level
    return winding, housing, level


def run(
    tables: ExtrasTables,
    conditions: Conditions,
    windows: servo.Windows,
    orders: servo.Orders,
    state: servo.State,
    tick: int,
    ticks: int,
    watch: bool,
) -> tuple[servo.State, int, bool]:
    """Return the state after up to `ticks` ticks, like `servo.run`.

    The function is long on purpose: smaller ones would have to pass all unpacked values back and
    forth.
    """
    load, source = conditions[0], conditions[1]
    watched = state[servo.I_FLAGS]
    wl, xl, supply, winding, housing, level, losses, last, still = state[servo.I_EXTRAS]
    slow = tables.slow_ticks
    is_slow = tables.has_heat or tables.has_i2t
    if losses == _AT_REST:
        losses = last * (tick % slow)
    known = watched & ~OF_EXTRAS
    if known & OUTSIDE_GATE and windows[8] <= state[servo.I_COUNT] < windows[9]:
        known &= ~OUTSIDE_GATE  # the output is outside, not the motor
    own = watched & ~known
    own_before = own
    bare: servo.State = (*state[:14], known, *state[15:19], ())
    last_piece = orders[1] + orders[3][-1][1]
    made = 0
    resting = False
    while made < ticks:
        before = bare
        wl0, xl0, supply0 = wl, xl, supply
        index = tables.index(winding)
        # fmt: off
        (on, i, u, w, x, hold_a, wanted, c0, c1, c2, c3, demand, demand_v, velocity,
         flags, in_target, behind, slowly, in_velocity, none) = bare
        # fmt: on
        i, u, w, x, wl, xl, supply, squares = extras_step.tick(
            tables, index, on, load, source, wanted, i, u, w, x, wl, xl, supply
        )
        # fmt: off
        bare = (on, i, u, w, x, hold_a, wanted, c0, c1, c2, c3, demand, demand_v, velocity,
                flags, in_target, behind, slowly, in_velocity, none)
        # fmt: on
        bare, _, _ = servo.run(
            *(tables.servo, tables.no_steps, 0, tables.no_load, windows, orders, bare),
            *(tick + made, 1, False),
        )
        made += 1
        if is_slow:
            last = servo.whole(squares * tables.heat_scale + 0.5)
            losses += last
            if (tick + made) % slow == 0:
                winding, housing, level = reckon(tables, winding, housing, level, losses)
                losses = 0.0
        own = own_flags(tables, conditions, xl, supply, winding, level)
        still = 0.0
        if watch and bare[servo.I_FLAGS] | own != watched:
            break
        if not (
            (w == 0.0 and wl == 0.0 and wl0 == 0.0 and xl == xl0 and supply == supply0)
            and (not on or tick + made >= last_piece)
            and bare == before
            and repr(bare) == repr(before)
        ):
            continue
        still = 1.0
        # Only the slow values have changed, and nothing else changes until they make a difference.
        if not is_slow:
            resting = True
            break
        while made < ticks:
            skipped = min(slow - (tick + made) % slow, ticks - made)
            losses += last * skipped
            made += skipped
            if (tick + made) % slow:
                break
            was = (winding, housing, level)
            winding, housing, level = reckon(tables, winding, housing, level, losses)
            if losses == last * slow and was == (winding, housing, level):
                losses = _AT_REST
                resting = True
                break
            losses = 0.0
            own = own_flags(tables, conditions, xl, supply, winding, level)
            if tables.index(winding) != index or own != own_before:
                break
        if resting or (watch and bare[servo.I_FLAGS] | own != watched):
            break
    extras = (wl, xl, supply, winding, housing, level, losses, last, still)
    state = (*bare[:14], bare[servo.I_FLAGS] | own, *bare[15:19], extras)
    return state, made, resting
