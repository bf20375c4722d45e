"""Conversion of profiles to functions. Imports numpy."""

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions.piecewise import Piecewise
from motorhil.motorapi.functions.polynomial import Polynomial
from motorhil.motorapi.generation.trapezoid import Profile


def function_of(profile: Profile) -> Piecewise:
    """Return the profile as a piecewise polynomial of its argument.

    As in the profile, the last piece is expanded about its end and all others about their
    beginning. Pieces shorter than the resolution of the argument (far from 0) are omitted.

    Raises:
        UsageError: the profile takes no time, so that it has no value at any argument.
    """
    begin = profile.initial_argument
    edges = [begin]
    polynomials: list[Polynomial] = []
    last = profile.pieces[-1]
    for piece in profile.pieces:
        begins_s, ends_s, first, final, entry, leave, acceleration = piece
        edge = begin + ends_s
        if edge <= edges[-1]:
            continue
        edges.append(edge)
        about, value, slope = (
            (edge, final, leave) if piece is last else (begin + begins_s, first, entry)
        )
        polynomials.append(Polynomial((value, slope, 0.5 * acceleration), about))
    if not polynomials:
        raise UsageError(f"{profile!r} takes no time: it is not a function of the argument")
    return Piecewise(edges, polynomials)
