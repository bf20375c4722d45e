"""The servo with a nonlinear plant behind it, tick by tick.

This is the counterpart of `servo.run`. The plant's tick is `plant_tick`. The servo's part
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

A plant has one or two bodies. Its step is passive by construction. Within a substep each body moves
exactly under a torque that is held. The energy that a torque takes out of a body is therefore the
torque times the distance. The rules are:

- Friction opposes the motion. A body that friction alone would reverse stops. A body that other
  torques reverse moves without friction in that substep.
- The coupling torque is the spring's mean over the substep if it touches at both ends (the
  trapezoidal rule: no gain, no loss). If it begins to touch, it is the spring's torque at the end,
  which takes more energy than it stores. If it ceases to touch, it is just enough to separate the
  flanks.
- An end stop takes the load's speed and gives back `restitution` of it.

A body at rest whose torques are within its friction stays where it is, to the last bit.
"""

from typing import Final

from motorhil.emulators.firmware import servo
from motorhil.emulators.firmware.flags import (
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
from motorhil.emulators.firmware.nonlinear_tables import Conditions, ExtrasTables, StepNumbers
from motorhil.emulators.firmware.servo import whole

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

_DC_LINK_MIN_V: Final = 1e-3


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
        i, u, w, x, wl, xl, supply, squares = plant_tick(
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


def wave(p: float) -> float:
    """Return an approximate sine of period 1, within 0.1 %, from parabolas and their square."""
    p -= whole(p)
    y = 16.0 * p * (0.5 - p) if p < 0.5 else -16.0 * (p - 0.5) * (1.0 - p)
    return y * (0.775 + 0.225 * (y if y > 0.0 else -y))


def one_body(
    t: StepNumbers, on: bool, load: float, v: float, i: float, w: float, x: float
) -> tuple[float, float, float, bool]:
    """Return current, speed and position after a substep of a rigid plant.

    The fourth result is True if nothing moved; the current is then returned unchanged.
    """
    outer = -load
    if t.cogging != 0.0:
        outer += t.cogging * wave((x - 0.5) * t.cogging_inc)
    if t.gravity != 0.0:
        outer -= t.gravity * wave((x - 0.5) * t.gravity_inc - t.gravity_zero)
    friction = t.coulomb + t.more / (1.0 + w * w * t.stribeck)
    if w == 0.0:
        net = t.k * i + outer
        if -friction <= net <= friction:
            return i, w, x, True
        forward = net > 0.0
        if x >= t.high if forward else x <= t.low:
            return i, w, x, True
    else:
        forward = w > 0.0
    outer += -friction if forward else friction
    if on:
        i1 = t.ii * i + t.iw * w + t.iv * v + t.it * outer
        w1 = t.wi * i + t.ww * w + t.wv * v
        way = t.xi * i + t.xw * w + t.xv * v
        wt, xt, it = t.wt, t.xt, t.it
    else:
        i1 = i
        it = 0.0
        w1 = t.coast_w * w
        way = t.coast_x * w
        wt, xt = t.coast_wt, t.coast_xt
    end = w1 + wt * outer
    if end < 0.0 if forward else end > 0.0:
        if w == 0.0:
            return i, w, x, True
        free = outer + friction if forward else outer - friction
        turned = w1 + wt * free
        if turned < 0.0 if forward else turned > 0.0:
            x1 = x + (way + xt * free)
            end = turned
            i1 += it * (free - outer)
        else:
            x1 = x + (way - xt * w1 / wt)
            end = 0.0
            i1 -= it * (w1 / wt + outer)
    else:
        x1 = x + (way + xt * outer)
    if x1 > t.high:
        x1 = t.high
        end = 0.0 - t.restitution * positive(end if end < w else w)
    elif x1 < t.low:
        x1 = t.low
        end = t.restitution * positive(-(end if end > w else w))
    return i1, end, x1, False


def positive(value: float) -> float:
    """Return the value, or 0.0 if it is negative."""
    return value if value > 0.0 else 0.0


def coupling(t: StepNumbers, twist: float, free: float, give: float) -> float:
    """Return the torque from rotor to load over a substep [N m].

    The difference rotor minus load [increments] is `twist` before the substep. After it, the
    difference is `free` without a torque, and smaller by `give` for each newton metre.
    """
    half = 0.5 * t.spring + t.damper
    gap = t.gap
    if gap == 0.0:
        return (half * free + (0.5 * t.spring - t.damper) * twist) / (1.0 + give * half)
    if free < 0.0:
        return -coupling(t, -twist, -free, give)
    if free <= gap:
        return 0.0
    if twist <= gap:  # it begins to touch
        both = t.spring + t.damper
        return both * (free - gap) / (1.0 + give * both)
    torque = half * (free - gap) + (0.5 * t.spring - t.damper) * (twist - gap)
    torque = positive(torque / (1.0 + give * half))  # flanks do not pull
    if free - give * torque < gap:
        torque = (free - gap) / give
    return torque


def two_bodies(
    t: StepNumbers,
    on: bool,
    load: float,
    v: float,
    i: float,
    w: float,
    x: float,
    wl: float,
    xl: float,
) -> tuple[float, float, float, float, float, bool]:
    """Return current, rotor and load after a substep of two bodies.

    A body at rest is first assumed to stay there, and a moving one to continue. The torque between
    them follows. Then a body that it sets free moves, and a body that reverses within the substep
    stops. The torque is computed again after each change, and each change happens at most once to
    each body.

    The last result is True if the rotor stood; the current is then returned unchanged.

    The function is long on purpose: a call for each body would double the cost.
    """
    twist = x - xl
    # the rotor alone
    outer = 0.0
    if t.cogging != 0.0:
        outer = t.cogging * wave((x - 0.5) * t.cogging_inc)
    friction = t.coulomb + t.more / (1.0 + w * w * t.stribeck)
    forward = w > 0.0
    stands = w == 0.0
    may_leave = stands
    wt = xt = w1 = way = stopping = 0.0
    has_stopped = False
    # the load alone
    push = -load
    if t.gravity != 0.0:
        push -= t.gravity * wave((xl - 0.5) * t.gravity_inc - t.gravity_zero)
    load_forward = wl > 0.0
    rubs = t.load_coulomb
    load_may_leave = wl == 0.0
    lt = lxt = wl1 = load_way = 0.0
    if not stands:
        outer += -friction if forward else friction
        if on:
            wt, xt = t.wt, t.xt
            w1 = t.wi * i + t.ww * w + t.wv * v + wt * outer
            way = t.xi * i + t.xw * w + t.xv * v + xt * outer
        else:
            wt, xt = t.coast_wt, t.coast_xt
            w1 = t.coast_w * w + wt * outer
            way = t.coast_x * w + xt * outer
    if not load_may_leave:
        push += -rubs if load_forward else rubs
        lt, lxt = t.load_wt, t.load_xt
        wl1 = t.load_w * wl + lt * push
        load_way = t.load_x * wl + lxt * push
    # both bodies
    while True:
        torque = coupling(t, twist, twist + way - load_way, xt + lxt)
        if may_leave:
            net = t.k * i + outer - torque
            if not -friction <= net <= friction:
                may_leave = stands = False
                forward = net > 0.0
                outer += -friction if forward else friction
                if on:
                    wt, xt = t.wt, t.xt
                    w1 = t.wi * i + t.wv * v + wt * outer
                    way = t.xi * i + t.xv * v + xt * outer
                else:
                    wt, xt = t.coast_wt, t.coast_xt
                    w1 = wt * outer
                    way = xt * outer
                continue
        if load_may_leave:
            net = torque + push
            load_forward = net > 0.0
            if not -rubs <= net <= rubs and (xl < t.high if load_forward else xl > t.low):
                load_may_leave = False
                push += -rubs if load_forward else rubs
                lt, lxt = t.load_wt, t.load_xt
                wl1 = lt * push
                load_way = lxt * push
                continue
        if wt != 0.0:
            end = w1 - wt * torque
            if end < 0.0 if forward else end > 0.0:
                turned = end + wt * friction if forward else end - wt * friction
                if w != 0.0 and (turned < 0.0 if forward else turned > 0.0):
                    free = friction if forward else -friction
                    outer += free
                    w1 += wt * free
                    way += xt * free
                    friction = 0.0
                    forward = not forward
                else:
                    stands = w == 0.0
                    way = 0.0 if stands else way - xt * w1 / wt
                    stopping = outer - w1 / wt
                    has_stopped = True
                    w1 = wt = xt = 0.0
                continue
        if lt != 0.0:
            end = wl1 + lt * torque
            if end < 0.0 if load_forward else end > 0.0:
                turned = end + lt * rubs if load_forward else end - lt * rubs
                if wl != 0.0 and (turned < 0.0 if load_forward else turned > 0.0):
                    free = rubs if load_forward else -rubs
                    wl1 += lt * free
                    load_way += lxt * free
                    rubs = 0.0
                    load_forward = not load_forward
                else:
                    load_way = 0.0 if wl == 0.0 else load_way - lxt * wl1 / lt
                    wl1 = lt = lxt = 0.0
                continue
            xl1 = xl + (load_way + lxt * torque)
            if xl1 > t.high:
                load_way = t.high - xl
                wl1 = 0.0 - t.restitution * positive(end if end < wl else wl)
                lt = lxt = 0.0
                continue
            if xl1 < t.low:
                load_way = t.low - xl
                wl1 = t.restitution * positive(-(end if end > wl else wl))
                lt = lxt = 0.0
                continue
        break
    i1 = i
    if on and not stands:
        i1 = t.ii * i + t.iw * w + t.iv * v
        i1 += t.it * (stopping if has_stopped else outer - torque)
    xl1 = xl + (load_way + lxt * torque)
    xl1 = t.high if xl1 > t.high else t.low if xl1 < t.low else xl1
    return i1, w1 - wt * torque, x + (way - xt * torque), wl1 + lt * torque, xl1, stands


def dc_link(t: ExtrasTables, v: float, source: float, power: float) -> float:
    """Return the DC-link voltage after an implicit step in which the motor draws `power` [W]."""
    leak = t.bleed_1_ohm + (t.chopper_1_ohm if v > t.chopper_v else 0.0)
    alone = v - t.per_farad * power / v
    v1 = alone / (1.0 + t.per_farad * leak)
    if v1 < source:  # the rectifier conducts
        g = t.source_1_ohm
        v1 = (alone + t.per_farad * g * source) / (1.0 + t.per_farad * (leak + g))
    return v1 if v1 > _DC_LINK_MIN_V else _DC_LINK_MIN_V


def plant_tick(
    tables: ExtrasTables,
    index: int,
    on: bool,
    load: float,
    source: float,
    wanted: float,
    i: float,
    u: float,
    w: float,
    x: float,
    wl: float,
    xl: float,
    supply: float,
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return the state after one tick, and the mean square of the current.

    The results are current, integrator, rotor, load, DC link and mean square current. The voltage
    is clipped to the DC link's, and the integrator then grows only back towards the inside, as in
    `servo.steps`. The current of a motor at standstill is computed as deviations from its
    steady state.

    The function is long on purpose: it passes all its values on to `two_bodies`.
    """
    t = tables.at(index)
    if not on:
        i = u = wanted = 0.0
    base = t.resistance * wanted
    error = wanted - i
    s = u - base
    began_e = error
    began_s = s
    stood = on
    is_idle = not on and not t.two_bodies and w == 0.0
    squares = 0.0
    if not tables.has_dc_link:
        supply = source
    for _ in range(tables.count):
        deviation = tables.kp * error + s
        v = deviation + base
        grows = on
        if v > supply:
            v = supply
            deviation = v - base
            grows = error < 0.0
            stood = False
        elif v < -supply:
            v = -supply
            deviation = v - base
            grows = error > 0.0
            stood = False
        first_error = error
        for _ in range(tables.substeps):
            i = wanted - error
            if t.two_bodies:
                i1, w, x, wl, xl, stands = two_bodies(t, on, load, v, i, w, x, wl, xl)
            else:
                i1, w, x, stands = one_body(t, on, load, v, i, w, x)
                wl = w
                xl = x
            if not stands:
                stood = False
                error = wanted - i1
            elif on:
                error = t.decay * error - t.gain * deviation
        if grows:
            s += tables.ki * first_error
        i = wanted - error
        squares += i * i
        before = supply
        if tables.has_dc_link:
            supply = dc_link(tables, supply, source, v * i)
        if is_idle and supply == before and w == 0.0:
            break  # one body, no current, no motion: the next step would be the same
    if stood:
        ee, es, ss = tables.norm(index)
        m = ee * began_e * began_e + es * began_e * began_s + ss * began_s * began_s
        if ee * error * error + es * error * s + ss * s * s >= m:
            error = s = 0.0  # only rounding keeps the deviation from shrinking
    return wanted - error, s + base, w, x, wl, xl, supply, squares / tables.count
