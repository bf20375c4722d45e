"""The servo and the linear motor behind it, tick by tick.

`run` is a pure function of a state tuple. A servo tick (for example 1 kHz) has four steps:

1. The motor advances by one tick with the current demand of the previous tick. The current loop
   runs several steps meanwhile (10 kHz). See `ServoTables` for how ten steps become one map.
2. The encoder is read: whole increments. The velocity is a moving average. The velocity loop uses
   two ticks, because a longer average would be too late. All other users get four ticks, because a
   shorter average would be too coarse. Both are exactly zero once the shaft has stood still.
3. Position loop (P, with velocity feedforward), velocity loop (PI, with acceleration feedforward),
   current limit, conditional integration. In torque control none of these loops runs, and the
   profile is one of current. Position and slope of its pieces are then amperes, and amperes per
   tick. Their velocity is the speed limit. The velocity loop's integrator follows the current, so
   that a change of mode causes no jump. Impedance control is torque control with another current:
   stiffness times the distance from a position, plus damping times the difference from a velocity,
   plus a constant.
4. The flags are set.

Standstill is exact. The rotor sticks with speed 0.0 while the torque on it is within the Coulomb
friction. With equal counts, velocity and following error are zero. The current loop of a blocked
motor is stepped as deviations from its steady state. There is a norm in which each tick shrinks
them. Once rounding prevents that, they are set to zero. A norm that falls strictly among finitely
many floats must end, so last bits cannot oscillate for ever. An axis at rest therefore reaches a
state that maps onto itself bit for bit, and `run` reports that.

Within this module velocities are increments per tick. The position x is half an increment ahead, so
that the encoder's count is its floor. Only + - * / are used.

Most ticks take all their steps at once (see `ServoTables`). Two functions take the steps singly.
They are needed where the voltage is clipped, or where the rotor stops or starts within the
tick.
"""

from typing import Final

from motorhil.emulators.firmware.flags import (
    CURRENT_REACHED,
    CURRENT_SATURATED,
    FOLLOWING_ERROR,
    IN_TARGET_WINDOW,
    IN_VELOCITY_WINDOW,
    OUTSIDE_GATE,
    POWERED,
    PROFILE_ACTIVE,
    SPEED_EXCEEDED,
    SPEED_ZERO,
)
from motorhil.emulators.firmware.profile import UNLIMITED, Profile
from motorhil.emulators.firmware.servo_tables import LoadTable, StepTable, TickTable

OFF: Final = 0
POSITION: Final = 1
VELOCITY: Final = 2
TORQUE: Final = 3
FED: Final = 4  # POSITION with the pieces' velocities fed forward unchanged
IMPEDANCE: Final = 5  # TORQUE with the current of `profile.impedance`

# powered; current, integrator of the current loop, speed [rad/s], position; integrator of the
# velocity loop, current demand; counts of this tick and the three before; position and velocity
# demand; measured velocity; flags; ticks in the target window, beyond the following error window,
# within the speed threshold (< 0: beyond it), in the velocity window (each counts up to its limit);
# the additional state of a nonlinear plant (see nonlinear_servo; empty for a linear one).
State = tuple[
    bool,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    float,
    int,
    int,
    int,
    int,
    int,
    tuple[float, ...],
]
I_CURRENT: Final = 1
I_SPEED: Final = 3
I_POSITION: Final = 4
I_HELD: Final = 5
I_WANTED: Final = 6
I_COUNT: Final = 7
I_DEMAND: Final = 11
I_DEMAND_VELOCITY: Final = 12
I_VELOCITY: Final = 13
I_FLAGS: Final = 14
I_EXTRAS: Final = 19

# The commands: mode; the tick at which the profile starts; the profile time until which
# PROFILE_ACTIVE is set (below 0: never); the profile; True if there is a target, and its position
# (or current); the target velocity of run_at, or the tolerance of the current; current limits,
# forwards and backwards, both >= 0.
Orders = tuple[int, int, float, Profile, bool, float, float, float, float]

# Half widths: target and following error [increments], speed threshold and velocity
# [increments/tick]; the number of consecutive ticks each must hold, this one included; the gate:
# the least count inside, and the least count above it that is outside.
Windows = tuple[float, float, float, float, int, int, int, int, float, float]

# Adding it to a number smaller than _EXACT leaves no room for a fraction, and so rounds it.
_ROUNDS: Final = 1.5 * 2.0**52
_EXACT: Final = 2.0**51


def steps(
    table: StepTable,
    count: int,
    load: float,
    wanted: float,
    i: float,
    u: float,
    w: float,
    x: float,
) -> tuple[float, float, float, float]:
    """Return current, integrator, speed and position after `count` single steps.

    The voltage is clipped to the supply. The integrator then grows only back towards the inside. A
    rotor that passes through standstill stops for the rest of the step. It leaves again in the
    first step at whose start or end the torque exceeds the friction.
    """
    # fmt: off
    (ii, iw, iv, it, wi, ww, wv, wt, xi, xw, xv, xt, _, _, _, _,
     decay, gain, kp, ki, resistance, k, supply, friction) = table
    # fmt: on
    base = resistance * wanted
    error = wanted - i
    s = u - base
    for _ in range(count):
        v = kp * error + (s + base)
        clipped = False
        grows = True
        if v > supply:
            v = supply
            clipped = True
            grows = error < 0.0
        elif v < -supply:
            v = -supply
            clipped = True
            grows = error > 0.0
        i = wanted - error
        if w == 0.0:
            if clipped:
                e1 = wanted - (decay * i + gain * v)
            else:  # as a deviation from the steady current, which decays exactly to zero
                e1 = decay * error - gain * (kp * error + s)
            net = k * i - load
            net1 = k * (wanted - e1) - load
            if -friction <= net <= friction and -friction <= net1 <= friction:
                if grows:
                    s += ki * error
                error = e1
                continue
            forward = net1 > friction or (net1 >= -friction and net > friction)
        else:
            forward = w > 0.0
        torque = -load - friction if forward else -load + friction
        i1 = ii * i + iw * w + iv * v + it * torque
        x1 = x + (xi * i + xw * w + xv * v + xt * torque)
        w1 = wi * i + ww * w + wv * v + wt * torque
        if w1 < 0.0 if forward else w1 > 0.0:
            if w == 0.0:
                x1 = x  # it did not leave after all
            w1 = 0.0
        x = x1
        w = w1
        if grows:
            s += ki * error
        error = wanted - i1
    return wanted - error, s + base, w, x


def coast_steps(
    table: StepTable, count: int, load: float, w: float, x: float
) -> tuple[float, float]:
    """Return speed and position after `count` steps without current; stops as in `steps`."""
    # fmt: off
    (_, _, _, _, _, _, _, _, _, _, _, _, ww, wt, xw, xt, _, _, _, _, _, _, _, friction) = table
    # fmt: on
    for _ in range(count):
        forward = w > 0.0
        if w == 0.0:
            if -friction <= load <= friction:
                break
            forward = load < 0.0
        torque = -load - friction if forward else -load + friction
        x += xw * w + xt * torque
        w = ww * w + wt * torque
        if w < 0.0 if forward else w > 0.0:
            w = 0.0
    return w, x


def whole(x: float) -> float:
    """Return the largest whole number <= x, without the division that x // 1.0 compiles to."""
    if not -_EXACT < x < _EXACT:
        return x // 1.0
    rounded = x + _ROUNDS - _ROUNDS
    return rounded - 1.0 if rounded > x else rounded


def standing(count: float) -> State:
    """Return the state of a motor without power that has always stood at `count`."""
    return (
        *(False, 0.0, 0.0, 0.0, count + 0.5, 0.0, 0.0),
        *(count, count, count, count, count, 0.0, 0.0),
        *(SPEED_ZERO, 0, 0, 1 << 30, 0, ()),
    )


def run(  # noqa: C901, PLR0913 -- hot loop: a call costs a row of the map
    table: TickTable,
    step_table: StepTable,
    current_steps: int,
    load_table: LoadTable,
    windows: Windows,
    orders: Orders,
    state: State,
    tick: int,
    ticks: int,
    watch: bool,
) -> tuple[State, int, bool]:
    """Return the state after up to `ticks` ticks, starting with `state` at `tick`.

    The function stops early at the first tick whose flags differ from the state's (if `watch`). It
    also stops at a state that the next tick would not change.

    The function is long on purpose: a call or an attribute costs as much here as a row of the map.

    Returns:
        The new state, the number of ticks made, and True if the axis is at rest for ever.
    """
    # fmt: off
    (ii, iu, iw, ir, ui, uu, uw, ur, wi, wu, ww, wr, xi, xu, xw, xr,
     resistance, k, guard_e, guard_d, bend,
     ee, es, se, ss, norm_ee, norm_es, norm_ss, volts_e, volts_s, torque_guard,
     supply, friction, coast_w, coast_x, kp, feed_v, kp_v, ki_v, feed_a) = table
    (load, volts_max, bend_least,
     fi, fu, fw, fx, fcw, fcx, bi, bu, bw, bx, bcw, bcx) = load_table
    (target_window, following_window, slow, velocity_window, need_t, need_f, need_z, need_v,
     gate_low, gate_high) = windows
    mode, origin, active, profile, has_target, target, run_velocity, limit, back = orders
    (on, i, u, w, x, hold_a, wanted, c0, c1, c2, c3, demand, demand_v, velocity,
     flags, in_target, behind, still, in_velocity, extras) = state
    # fmt: on
    before = state
    watched = flags
    t = float(tick - origin)
    index = 0
    last = len(profile) - 1
    end, start, p, slope, half, v, change = profile[0]
    if mode == VELOCITY:
        feed_v = 1.0
    elif mode == FED:
        mode = POSITION
        feed_v = 1.0
    made = 0
    resting = False
    while made < ticks:
        made += 1
        # 1. the motor
        if on:
            error = wanted - i
            if w != 0.0:
                m = u - resistance * wanted - k * w
                m = guard_e * (error if error > 0.0 else -error) + guard_d * (m if m > 0.0 else -m)
                dip = bend * m + bend_least
                one_by_one = True
                if m - u < volts_max and m + u < volts_max:
                    if w > dip:
                        w1 = wi * i + wu * u + ww * w + wr * wanted + fw
                        if w1 > dip:
                            one_by_one = False
                            x += xi * i + xu * u + xw * w + xr * wanted + fx
                            i1 = ii * i + iu * u + iw * w + ir * wanted + fi
                            u = ui * i + uu * u + uw * w + ur * wanted + fu
                            i = i1
                            w = w1
                    elif w < -dip:
                        w1 = wi * i + wu * u + ww * w + wr * wanted + bw
                        if w1 < -dip:
                            one_by_one = False
                            x += xi * i + xu * u + xw * w + xr * wanted + bx
                            i1 = ii * i + iu * u + iw * w + ir * wanted + bi
                            u = ui * i + uu * u + uw * w + ur * wanted + bu
                            i = i1
                            w = w1
                if one_by_one:
                    i, u, w, x = steps(step_table, current_steps, load, wanted, i, u, w, x)
            else:
                base = resistance * wanted
                s = u - base
                m = volts_e * (error if error > 0.0 else -error) + volts_s * (s if s > 0.0 else -s)
                net = k * wanted - load
                slack = friction - torque_guard * m
                if -slack <= net <= slack and m - base < supply and m + base < supply:
                    i = wanted - (ee * error + es * s)
                    u = base + (se * error + ss * s)
                    e1 = wanted - i
                    s1 = u - base
                    m = norm_ee * error * error + norm_es * error * s + norm_ss * s * s
                    if norm_ee * e1 * e1 + norm_es * e1 * s1 + norm_ss * s1 * s1 >= m:
                        i = wanted  # only rounding keeps the deviation from shrinking
                        u = base
                else:
                    i, u, w, x = steps(step_table, current_steps, load, wanted, i, u, w, x)
        elif w > 0.0:
            w1 = coast_w * w + fcw
            if w1 > 0.0:
                x += coast_x * w + fcx
                w = w1
            else:
                w, x = coast_steps(step_table, current_steps, load, w, x)
        elif w < 0.0:
            w1 = coast_w * w + bcw
            if w1 < 0.0:
                x += coast_x * w + bcx
                w = w1
            else:
                w, x = coast_steps(step_table, current_steps, load, w, x)
        elif load > friction or load < -friction:
            w, x = coast_steps(step_table, current_steps, load, w, x)
        # 2. the encoder
        t += 1.0
        c4 = c3
        c3 = c2
        c2 = c1
        c1 = c0
        c0 = whole(x)
        velocity = (c0 - c4) * 0.25
        # 3. the servo
        if mode == OFF:
            on = False
            i = u = hold_a = wanted = 0.0
            demand = c0
            demand_v = 0.0
            flags = in_target = behind = in_velocity = 0
        elif mode >= TORQUE:
            on = True
            flags = POWERED
            demand = c0
            demand_v = 0.0
            in_target = behind = in_velocity = 0
            while t >= end:
                index += 1
                end, start, p, slope, half, v, change = profile[index]
            if mode == IMPEDANCE:  # slope, half and change: stiffness, damping, current
                wanted = slope * (p - c0) + half * (v - (c0 - c2) * 0.5) + change
                demand_v = v
                if slope != 0.0:
                    demand = whole(p + 0.5)
            else:
                wanted = p + (t - start) * slope
            if v < UNLIMITED and mode == TORQUE:
                # limit the current so that the speed does not pass v: the velocity loop in its
                # incremental form, which starts from the current itself
                held = hold_a - kp_v * (c0 - c1 - c2 + c3) * 0.5 - ki_v * (c0 - c2) * 0.5
                most = held + ki_v * v
                least = held - ki_v * v
                if wanted > most:
                    wanted = most
                    flags |= CURRENT_SATURATED
                elif wanted < least:
                    wanted = least
                    flags |= CURRENT_SATURATED
            if wanted > limit:
                wanted = limit
                flags |= CURRENT_SATURATED
            elif wanted < -back:
                wanted = -back
                flags |= CURRENT_SATURATED
            hold_a = wanted
            if t < active:
                flags |= PROFILE_ACTIVE
            elif -run_velocity <= target - i <= run_velocity:
                flags |= CURRENT_REACHED
        else:
            on = True
            flags = POWERED
            while t >= end:
                index += 1
                end, start, p, slope, half, v, change = profile[index]
            s = t - start
            demand_v = v + s * change
            # the average is one tick old: compare it with the demand of that moment
            error_v = feed_v * (v + (s - 1.0) * change if s > 1.0 else v) - (c0 - c2) * 0.5
            if mode == POSITION:
                demand = whole(p + s * (slope + s * half) + 0.5)
                error = demand - c0
                error_v += kp * error
                if error > following_window or error < -following_window:
                    if behind < need_f:
                        behind += 1
                    if behind >= need_f:
                        flags |= FOLLOWING_ERROR
                else:
                    behind = 0
            else:
                demand = c0
                behind = 0
            wanted = kp_v * error_v + hold_a + feed_a * change
            if wanted > limit:
                wanted = limit
                flags |= CURRENT_SATURATED
                if error_v < 0.0:
                    hold_a += ki_v * error_v
            elif wanted < -back:
                wanted = -back
                flags |= CURRENT_SATURATED
                if error_v > 0.0:
                    hold_a += ki_v * error_v
            else:
                hold_a += ki_v * error_v
            # 4. the flags
            if t < active:
                flags |= PROFILE_ACTIVE
                in_target = 0
            elif has_target:
                s = target - c0
                if -target_window <= s <= target_window:
                    if in_target < need_t:
                        in_target += 1
                    if in_target >= need_t:
                        flags |= IN_TARGET_WINDOW
                else:
                    in_target = 0
            if mode == VELOCITY:
                s = velocity - run_velocity
                if -velocity_window <= s <= velocity_window:
                    if in_velocity < need_v:
                        in_velocity += 1
                    if in_velocity >= need_v:
                        flags |= IN_VELOCITY_WINDOW
                else:
                    in_velocity = 0
        if -slow <= velocity <= slow:
            if still < need_z:
                still = still + 1 if still > 0 else 1
            if still >= need_z:
                flags |= SPEED_ZERO
        else:
            if still > -need_z:
                still = still - 1 if still < 0 else -1
            if still <= -need_z:
                flags |= SPEED_EXCEEDED
        if c0 < gate_low or c0 >= gate_high:  # a chained comparison compiles to slower code
            flags |= OUTSIDE_GATE
        if watch and flags != watched:
            break
        if w == 0.0 and c0 == c4 and (mode == OFF or index == last):
            # fmt: off
            after = (on, i, u, w, x, hold_a, wanted, c0, c1, c2, c3, demand, demand_v, velocity,
                     flags, in_target, behind, still, in_velocity, extras)
            # fmt: on
            if after == before and repr(after) == repr(before):  # repr: 0.0 is not -0.0
                resting = True
                break
            before = after
    # fmt: off
    return (on, i, u, w, x, hold_a, wanted, c0, c1, c2, c3, demand, demand_v, velocity,
            flags, in_target, behind, still, in_velocity, extras), made, resting
    # fmt: on
