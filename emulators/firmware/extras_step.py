"""One servo tick of a nonlinear plant: current loop, supply, and one or two bodies.

The step is passive by construction. Within a substep each body moves exactly under a torque that is
held. The energy that a torque takes out of a body is therefore the torque times the distance. The
rules are:

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

from emulators.firmware.extras_tables import ExtrasTables, StepNumbers
from emulators.firmware.servo import whole

_DC_LINK_MIN_V: Final = 1e-3


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


def tick(
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
    `current_loop.steps`. The current of a motor at standstill is computed as deviations from its
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
