"""Envelope of all possible motions, in exact arithmetic: an oracle.

In a time T, velocity is bounded by acceleration from the beginning, by deceleration to the final
velocity in time, and by its limit. This bound is attainable at all moments at once. So the distance
is at most the integral of the minimum of the three, and at least that of the maximum of their
counterparts. Every distance in between is possible by a mix of the two. No case distinctions and no
roots occur here: the result is independent of the generator.
"""

from fractions import Fraction
from itertools import pairwise
from math import inf


class Envelope:
    """Motions from velocity `v0` to `v1`, with velocity and accelerations in ranges; floats."""

    def __init__(self, v0, v1, velocity, forward, backward):
        self.v0, self.v1 = Fraction(v0), Fraction(v1)
        self.low, self.high = velocity
        self.forward, self.backward = forward, backward

    def ways(self, duration):
        """Return (minimum, maximum) distance in this time, or None if it is too short."""
        up = self._rising(self.v0, self.forward[1], self.backward[1])
        back_up = self._rising(self.v1, -Fraction(self.forward[0]), -Fraction(self.backward[0]))
        greatest = self._integral(up, back_up, duration, self.high)
        # The same in the mirror, where forward is backward.
        down = self._rising(-self.v0, -Fraction(self.backward[0]), -Fraction(self.forward[0]))
        back_down = self._rising(-self.v1, Fraction(self.backward[1]), Fraction(self.forward[1]))
        least = self._integral(down, back_down, duration, -self.low)
        return None if greatest is None or least is None else (-least, greatest)

    def is_possible(self, way, duration):
        ways = self.ways(Fraction(duration))
        return ways is not None and ways[0] <= Fraction(way) <= ways[1]

    @staticmethod
    def _rising(velocity, size, back_size):
        """Return the corners (time, velocity) of the steepest rise; the last one is unbounded."""
        size, back_size = Fraction(size), Fraction(back_size)
        if velocity >= 0:
            return [(Fraction(0), velocity)], size
        return [(Fraction(0), velocity), (-velocity / back_size, Fraction(0))], size

    @staticmethod
    def _at(rise, time):
        corners, slope = rise
        for (t0, v0), (t1, v1) in pairwise(corners):
            if time <= t1:
                return v0 + (v1 - v0) * (time - t0) / (t1 - t0)
        t0, v0 = corners[-1]
        return v0 + slope * (time - t0)

    def _integral(self, rise, fall, duration, top):
        """Return the integral of the minimum of rise, fall (from the end) and limit."""
        if self._at(rise, duration) < fall[0][0][1] or self._at(fall, duration) < rise[0][0][1]:
            return None

        def least(time):
            found = min(self._at(rise, time), self._at(fall, duration - time))
            return found if top == inf else min(found, Fraction(top))

        times = {Fraction(0), duration}
        times |= {t for t, _ in rise[0] if t < duration}
        times |= {duration - t for t, _ in fall[0] if t < duration}
        for line, mirrored in ((rise, False), (fall, True)):  # where a line reaches the limit
            t0, v0 = line[0][-1]
            if top != inf and v0 < top:
                reached = t0 + (Fraction(top) - v0) / line[1]
                if reached < duration:
                    times.add(duration - reached if mirrored else reached)
        ordered = sorted(times)
        for begin, end in pairwise(ordered):  # where the two lines cross
            before = self._at(rise, begin) - self._at(fall, duration - begin)
            after = self._at(rise, end) - self._at(fall, duration - end)
            if before < 0 < after:
                times.add(begin + (end - begin) * before / (before - after))
        ordered = sorted(times)
        return sum(
            (end - begin) * (least(begin) + least(end)) / 2 for begin, end in pairwise(ordered)
        )
