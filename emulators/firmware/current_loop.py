"""The current loop in single steps, for servo ticks near its limits.

Most ticks take all their steps at once (see `ServoTables`). These two functions take the steps
singly. They are needed where the voltage is clipped, or where the rotor stops or starts within the
tick.
"""

from emulators.firmware.servo_tables import StepTable


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
