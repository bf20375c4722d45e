"""Shortest jerk-limited motions without a generator: two oracles.

`rest_to_rest_s` is the closed form of the double-S profile (Biagiotti & Melchiorri, 3.4.1).
`is_impossible` is a linear program: the states of any motion with these limits at 80 moments
satisfy its inequalities, which contain only consequences of the limits between two moments. Without
a solution there is no motion. The program uses no profiles or phases.
"""

import numpy as np

MOMENTS = 80


def rest_to_rest_s(way, velocity, acceleration, jerk):
    if velocity * jerk >= acceleration**2:
        ramp_s = velocity / acceleration + acceleration / jerk
    else:
        ramp_s = 2.0 * (velocity / jerk) ** 0.5
    if way >= velocity * ramp_s:
        return way / velocity + ramp_s
    if way >= 2.0 * acceleration**3 / jerk**2:
        least = acceleration**2 / jerk
        peak = 0.5 * (-least + (least**2 + 4.0 * acceleration * way) ** 0.5)
        return 2.0 * (peak / acceleration + acceleration / jerk)
    return 4.0 * (way / (2.0 * jerk)) ** (1.0 / 3.0)


def is_impossible(linprog, begin, end, velocity, acceleration, jerk, duration_s):
    """Return True if no motion between these (value, first, second derivative) is so short."""
    h = duration_s / MOMENTS
    rows, tops = [], []

    def holds(terms, top):
        """Require sum(factor * number) <= top; a number is (order 0..2, index of the moment)."""
        row = np.zeros(3 * (MOMENTS + 1))
        for factor, order, moment in terms:
            row[3 * moment + order] += factor
        rows.append(row)
        tops.append(top)

    for k in range(MOMENTS):
        rise = ((1.0, 2, k + 1), (-1.0, 2, k))  # derivative of the acceleration
        change = ((1.0, 1, k + 1), (-1.0, 1, k))
        way = ((1.0, 0, k + 1), (-1.0, 0, k))
        rest = ((-h, 1, k), (-0.5 * h * h, 2, k))
        for sign in (1.0, -1.0):
            low, high = (
                (acceleration, velocity)
                if sign > 0
                else ((-acceleration[1], -acceleration[0]), (-velocity[1], -velocity[0]))
            )
            holds([(sign * f, o, m) for f, o, m in rise], jerk * h)
            holds([(sign * f, o, m) for f, o, m in change], h * low[1])
            holds([(sign * f, o, m) for f, o, m in way], h * high[1])
            holds([(sign * f, o, m) for f, o, m in (*way, *rest)], jerk * h**3 / 6.0)
            # Velocity changes by the mean of both accelerations, within (J h² - d²/J) / 4, where d
            # is their difference: tangents of that parabola.
            for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
                tangent = share * jerk * h
                mean = ((-0.5 * h, 2, k), (-0.5 * h, 2, k + 1))
                terms = [(sign * f, o, m) for f, o, m in (*change, *mean)]
                terms += [(f * tangent / (2.0 * jerk), o, m) for f, o, m in rise]
                holds(terms, jerk * h * h / 4.0 + tangent**2 / (4.0 * jerk))
    bounds = [(None, None), velocity, acceleration] * (MOMENTS + 1)
    bounds[:3] = [(x, x) for x in begin]
    bounds[-3:] = [(x, x) for x in end]
    answer = linprog(np.zeros(len(bounds)), A_ub=np.array(rows), b_ub=np.array(tops), bounds=bounds)
    assert answer.status in (0, 2), answer.message
    return answer.status == 2
