"""Profile generator: demands as pieces of constant acceleration, in closed form.

Time is counted in servo ticks from the moment of the command. Velocities are therefore increments
per tick, and accelerations increments per tick^2. A profile is a tuple of consecutive pieces; the
last one never ends. The demand at any time follows directly from the piece that contains it.
Nothing is accumulated, so earlier queries have no influence.

Only + - * / and sqrt are used, so the same command gives the same demands on every machine.

Source: Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), ch. 3,
trapezoidal velocity profile with non-null initial velocity.
"""

from math import sqrt
from typing import Final

# end, start, position, slope, half acceleration, velocity, acceleration. At s = t - start:
#   position demand = position + s * (slope + s * half acceleration)
#   velocity demand = velocity + s * acceleration
# (slope and velocity differ only after the end of a cyclic demand, where its velocity is still fed
# forward for one tick.)
Piece = tuple[float, float, float, float, float, float, float]
Profile = tuple[Piece, ...]

FOREVER: Final = 1e300
UNLIMITED: Final = 1e300  # a speed above any motor's


def hold(position: float) -> Profile:
    """Return a profile that holds `position` for ever."""
    return ((FOREVER, 0.0, position, 0.0, 0.0, 0.0, 0.0),)


def line(start: float, end: float, ticks: float) -> Profile:
    """Return a linear move to `end` in `ticks` (cyclic demands), then standstill.

    A move with ticks < 1 takes one tick. The velocity demand outlives the arrival by one tick, in
    which the next cyclic demand is expected.
    """
    if ticks < 1.0:
        ticks = 1.0
    slope = (end - start) / ticks
    return (
        (ticks, 0.0, start, slope, 0.0, slope, 0.0),
        (ticks + 1.0, ticks, end, 0.0, 0.0, slope, 0.0),
        (FOREVER, ticks + 1.0, end, 0.0, 0.0, 0.0, 0.0),
    )


def fed(pieces: Profile, share: float, added: float) -> Profile:
    """Return the same demands, feeding forward `share` of their velocity plus `added`."""
    return tuple(
        (end, start, p, slope, half, share * v + added, share * change)
        for end, start, p, slope, half, v, change in pieces
    )


def velocity_line(start: float, end: float, ticks: float) -> Profile:
    """Return a velocity that changes linearly to `end` in `ticks`, then stays; no position."""
    if ticks < 1.0:
        ticks = 1.0
    return (
        (ticks, 0.0, 0.0, 0.0, 0.0, start, (end - start) / ticks),
        (FOREVER, ticks, 0.0, 0.0, 0.0, end, 0.0),
    )


def current(start: float, target: float, slope: float, speed_max: float = UNLIMITED) -> Profile:
    """Return a current ramp to `target` with `slope` > 0 per tick, from the first tick on."""
    ticks = (target - start if target > start else start - target) / slope
    if ticks <= 1.0:
        return ((FOREVER, 0.0, target, 0.0, 0.0, speed_max, 0.0),)
    change = slope if target > start else -slope
    return (
        (ticks - 1.0, -1.0, start, change, 0.0, speed_max, 0.0),
        (FOREVER, ticks - 1.0, target, 0.0, 0.0, speed_max, 0.0),
    )


def current_line(start: float, end: float, ticks: float, speed_max: float = UNLIMITED) -> Profile:
    """Return a current that changes linearly to `end` in `ticks`, then stays."""
    if ticks < 1.0:
        ticks = 1.0
    return (
        (ticks, 0.0, start, (end - start) / ticks, 0.0, speed_max, 0.0),
        (FOREVER, ticks, end, 0.0, 0.0, speed_max, 0.0),
    )


def impedance(
    position: float, velocity: float, stiffness: float, damping: float, current_a: float
) -> Profile:
    """Return the constants of impedance control: one piece whose columns have other meanings.

    Stiffness is in amperes per increment, damping in amperes per increment and tick.
    """
    return ((FOREVER, 0.0, position, stiffness, damping, velocity, current_a),)


def ramp(
    position: float, velocity: float, wanted: float, acceleration: float, deceleration: float
) -> Profile:
    """Return a ramp to the velocity `wanted`, which is then kept; it can change the sign.

    A ramp to standstill ends at the increment nearest to the point of rest.
    """
    pieces: list[Piece] = []
    t = 0.0
    if velocity * wanted <= 0.0 and velocity != 0.0:
        t, position = _brake(pieces, position, velocity, deceleration)
        velocity = 0.0
    if wanted == 0.0:
        pieces.append((FOREVER, t, (position + 0.5) // 1.0, 0.0, 0.0, 0.0, 0.0))
        return tuple(pieces)
    faster = (wanted > velocity) if wanted > 0.0 else (wanted < velocity)
    size = acceleration if faster else deceleration
    change = size if wanted > velocity else -size
    duration = (wanted - velocity) / change
    if duration > 0.0:
        pieces.append((t + duration, t, position, velocity, 0.5 * change, velocity, change))
        position += duration * (velocity + duration * (0.5 * change))
        t += duration
    pieces.append((FOREVER, t, position, wanted, 0.0, wanted, 0.0))
    return tuple(pieces)


def move(
    position: float,
    velocity: float,
    target: float,
    velocity_max: float,
    acceleration: float,
    deceleration: float,
) -> Profile:
    """Return the shortest move to rest at `target` within the limits, from any start.

    A start that is too fast is first braked to `velocity_max`. A start that leads away, or is too
    close to stop in time, is braked to standstill and then returns. All three limits must be > 0.
    """
    pieces: list[Piece] = []
    t = 0.0
    stop = position + velocity * (velocity if velocity > 0.0 else -velocity) / (2.0 * deceleration)
    if target == stop:
        forward = 1.0 if velocity >= 0.0 else -1.0
    else:
        forward = 1.0 if target > stop else -1.0
    if velocity * forward < 0.0:
        t, position = _brake(pieces, position, velocity, deceleration)
        velocity = 0.0
    speed = velocity * forward
    distance = (target - position) * forward
    if speed > velocity_max:
        peak = velocity_max
        change = -deceleration
    else:
        peak_squared = deceleration * (2.0 * acceleration * distance + speed * speed)
        peak_squared /= acceleration + deceleration
        peak = sqrt(peak_squared) if peak_squared > 0.0 else 0.0
        peak = max(speed, min(peak, velocity_max))
        change = acceleration
    duration = (peak - speed) / change
    if duration > 0.0:
        half = 0.5 * change * forward
        pieces.append(
            (t + duration, t, position, velocity, half, velocity, change * forward),
        )
        position += duration * (velocity + duration * half)
        t += duration
    braking = peak * peak / (2.0 * deceleration)
    cruise = (target - position) * forward - braking
    if cruise > 0.0 and peak >= velocity_max:
        duration = cruise / peak
        pieces.append((t + duration, t, position, peak * forward, 0.0, peak * forward, 0.0))
        t += duration
    if peak > 0.0:
        duration = peak / deceleration
        slower = -deceleration * forward
        start = target - braking * forward
        pieces.append(
            (t + duration, t, start, peak * forward, 0.5 * slower, peak * forward, slower)
        )
        t += duration
    pieces.append((FOREVER, t, target, 0.0, 0.0, 0.0, 0.0))
    return tuple(pieces)


def move_through(
    position: float,
    velocity: float,
    target: float,
    velocity_max: float,
    acceleration: float,
    deceleration: float,
    end: float,
) -> Profile:
    """Return a move that passes `target` at the speed `end` > 0 and continues at it.

    The speed is limited to `velocity_max`. A start that is too fast or too slow for the distance
    left reaches `end` beyond the target.
    """
    pieces: list[Piece] = []
    t = 0.0
    forward = 1.0 if target >= position else -1.0
    if velocity * forward < 0.0:
        t, position = _brake(pieces, position, velocity, deceleration)
        velocity = 0.0
    speed = velocity * forward
    distance = (target - position) * forward
    end = min(end, velocity_max)
    change = speed * speed - end * end
    peak = end
    if -2.0 * acceleration * distance <= change <= 2.0 * deceleration * distance:
        squared = deceleration * (2.0 * acceleration * distance + speed * speed)
        peak = sqrt((squared + acceleration * end * end) / (acceleration + deceleration))
        peak = min(max(peak, end), velocity_max)
    t, position, speed = _change(
        pieces, t, position, speed, peak, acceleration, deceleration, forward
    )
    braking = (peak * peak - end * end) / (2.0 * deceleration)
    cruise = (target - position) * forward - braking
    if cruise > 0.0:
        duration = cruise / peak
        pieces.append((t + duration, t, position, peak * forward, 0.0, peak * forward, 0.0))
        t += duration
        position += cruise * forward
    t, position, speed = _change(
        pieces, t, position, speed, end, acceleration, deceleration, forward
    )
    pieces.append((FOREVER, t, position, end * forward, 0.0, end * forward, 0.0))
    return tuple(pieces)


def _change(
    pieces: list[Piece],
    t: float,
    position: float,
    speed: float,
    wanted: float,
    acceleration: float,
    deceleration: float,
    forward: float,
) -> tuple[float, float, float]:
    """Append the piece between two speeds, if any; return its end time, position and speed."""
    if wanted == speed:
        return t, position, speed
    size = acceleration if wanted > speed else -deceleration
    duration = (wanted - speed) / size
    half = 0.5 * size * forward
    velocity = speed * forward
    pieces.append((t + duration, t, position, velocity, half, velocity, size * forward))
    return t + duration, position + duration * (velocity + duration * half), wanted


def duration_ticks(profile: Profile) -> float:
    """Return the start of the last piece, from which on nothing changes [ticks]."""
    return profile[-1][1]


def demand_at(profile: Profile, t: float) -> tuple[float, float]:
    """Return position and velocity demand, unrounded, `t` ticks after the command."""
    index = 0
    while t >= profile[index][0]:
        index += 1
    _, start, position, slope, half, velocity, change = profile[index]
    s = t - start
    return position + s * (slope + s * half), velocity + s * change


def _brake(
    pieces: list[Piece], position: float, velocity: float, deceleration: float
) -> tuple[float, float]:
    """Append the piece from `velocity` != 0 to standstill; return its end time and position."""
    change = -deceleration if velocity > 0.0 else deceleration
    duration = -velocity / change
    pieces.append((duration, 0.0, position, velocity, 0.5 * change, velocity, change))
    return duration, position + duration * (0.5 * velocity)
