"""Generated profiles: pieces of constant acceleration."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, final

from motorapi.commands import Range

if TYPE_CHECKING:
    from motorapi.functions.piecewise import Piecewise


Piece: TypeAlias = tuple[float, float, float, float, float, float, float]
"""One piece: (begin [s], end [s], initial value, final value [U], initial and final first
derivative [U/s], second derivative [U/s²]); times are relative to the beginning of the profile.
"""


@final
@dataclass(frozen=True, slots=True, repr=False)
class Profile:
    """A function value over its argument, in pieces of constant second derivative; immutable.

    Velocity changes its sign only at the end of a piece, so the value is monotone in each piece.
    The last piece is computed from its end and all others from their beginning. So both boundary
    states are exact, and rounding errors appear between two pieces only. U is the unit of the
    value. Outside its arguments a profile has the state of the nearer end.

    Attributes:
        initial_argument: argument at the beginning, in most cases a time [s].
        initial_velocity: first derivative at the beginning [U/s].
        final_velocity: first derivative at the end [U/s].
        pieces: at least one; a piece has no duration only if the profile has none.
    """

    initial_argument: float
    initial_velocity: float
    final_velocity: float
    pieces: tuple[Piece, ...]

    @property
    def duration_s(self) -> float:
        """The duration [s], >= 0."""
        return self.pieces[-1][1]

    @property
    def final_argument(self) -> float:
        """The argument at the end."""
        return self.initial_argument + self.pieces[-1][1]

    @property
    def switching_times_s(self) -> tuple[float, ...]:
        """Times of acceleration changes and reversals, relative to the beginning [s]."""
        return tuple([piece[1] for piece in self.pieces[:-1]])

    @property
    def initial(self) -> float:
        """The value at the beginning [U]."""
        return self.pieces[0][2]

    @property
    def final(self) -> float:
        """The value at the end [U]."""
        return self.pieces[-1][3]

    @property
    def value_range(self) -> Range:
        """(lowest, highest) value of the profile [U]."""
        values = [self.initial, *(piece[3] for piece in self.pieces)]
        return min(values), max(values)

    @property
    def velocity_range(self) -> Range:
        """(lowest, highest) first derivative, both ends included [U/s]."""
        velocities = [self.initial_velocity, self.final_velocity]
        for piece in self.pieces:
            velocities += piece[4:6]
        return min(velocities), max(velocities)

    def value(self, argument: float) -> float:
        """Return the function value [U]."""
        since = argument - self.initial_argument
        pieces = self.pieces
        last = pieces[-1]
        if since >= last[1]:
            return last[3]
        if since <= 0.0:
            return pieces[0][2]
        for piece in pieces:
            if since < piece[1]:
                break
        begins_s, ends_s, begin, end, entry, leave, acceleration = piece
        if piece is last:
            since -= ends_s
            found = end + (leave + 0.5 * acceleration * since) * since
        else:
            since -= begins_s
            found = begin + (entry + 0.5 * acceleration * since) * since
        return _between(begin, found, end)

    def first(self, argument: float) -> float:
        """Return the first derivative [U/s]; outside the arguments, that of the nearer end."""
        since = argument - self.initial_argument
        pieces = self.pieces
        last = pieces[-1]
        if since >= last[1]:
            return self.final_velocity
        if since <= 0.0:
            return self.initial_velocity
        for piece in pieces:
            if since < piece[1]:
                break
        begins_s, ends_s, _, _, entry, leave, acceleration = piece
        if piece is last:
            found = leave + acceleration * (since - ends_s)
        else:
            found = entry + acceleration * (since - begins_s)
        return _between(entry, found, leave)

    def second(self, argument: float) -> float:
        """Return the second derivative [U/s²]: between pieces that of the later; outside 0."""
        since = argument - self.initial_argument
        if since < 0.0 or since > self.pieces[-1][1]:
            return 0.0
        for piece in self.pieces:
            if since < piece[1]:
                break
        return piece[6]

    def as_function(self) -> "Piecewise":
        """Return the profile as a piecewise polynomial of the argument; imports numpy.

        Raises:
            UsageError: the profile takes no time, so that it has no value at any argument.
        """
        from motorapi.generation.conversion import function_of

        return function_of(self)

    def __repr__(self) -> str:
        return (
            f"<Profile from {self.initial!r} to {self.final!r} in {self.duration_s!r} s,"
            f" velocity {self.initial_velocity!r} to {self.final_velocity!r},"
            f" {len(self.pieces)} pieces>"
        )


def _between(one: float, found: float, other: float) -> float:
    """Return `found`, clipped to the range of two values against rounding errors."""
    if one <= other:
        return one if found < one else other if found > other else found
    return other if found < other else one if found > one else found
