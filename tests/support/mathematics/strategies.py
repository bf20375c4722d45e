"""Strategies for functions of all kinds, defined at least from LOW to HIGH."""

from hypothesis import strategies as st

from motorhil.motorapi.functions import (
    Composition,
    Constant,
    Cosine,
    Exponential,
    Interpolation,
    Piecewise,
    Polynomial,
    Product,
    Sampled,
    Scaled,
    Shifted,
    Sine,
    Sum,
)

LOW, HIGH = -2.0, 2.0
ARGUMENTS = st.floats(LOW, HIGH)
NUMBERS = st.floats(-8.0, 8.0, allow_subnormal=False).map(lambda x: 0.0 if abs(x) < 1e-6 else x)
NOT_ZERO = st.floats(0.25, 4.0).flatmap(lambda x: st.sampled_from([x, -x]))

constants = st.builds(Constant, NUMBERS)
polynomials = st.builds(Polynomial, st.lists(NUMBERS, min_size=1, max_size=6), st.floats(-3.0, 3.0))
waves = st.one_of(
    st.builds(kind, NOT_ZERO, NOT_ZERO, NUMBERS, st.floats(-3.0, 3.0)) for kind in (Sine, Cosine)
)
exponentials = st.builds(
    Exponential, NOT_ZERO, st.floats(-1.5, 1.5).filter(lambda r: abs(r) > 0.1), st.floats(-2.0, 2.0)
)


@st.composite
def edges(draw, low=LOW, high=HIGH, most=6):
    """Return ascending breaks, from `low` or below to `high` or above, with minimum distances."""
    begin = low - draw(st.floats(0.0, 1.0))
    ways = draw(st.lists(st.floats(0.05, 1.0), min_size=1, max_size=most))
    length = high + draw(st.floats(0.0, 1.0)) - begin
    found = [begin]
    for way in ways[:-1]:
        found.append(found[-1] + way / sum(ways) * length)
    return [*found, max(begin + length, high)]


@st.composite
def piecewise(draw):
    breaks = draw(edges())
    rows = st.lists(st.lists(NUMBERS, min_size=1, max_size=6), min_size=len(breaks) - 1)
    return Piecewise.of_polynomials(breaks, draw(rows)[: len(breaks) - 1])


@st.composite
def sampled(draw, kind=None):
    arguments = draw(edges(most=8))
    kind = kind or draw(st.sampled_from(Interpolation))
    numbers = st.lists(NUMBERS, min_size=len(arguments), max_size=len(arguments))
    first = second = None
    if kind is Interpolation.HERMITE:
        first = draw(numbers)
    elif kind is Interpolation.QUINTIC and draw(st.booleans()):
        first, second = draw(numbers), draw(numbers)
    return Sampled(arguments, draw(numbers), kind, first, second)


made_of_polynomials = st.one_of(constants, polynomials, piecewise(), sampled())
smooth = st.one_of(constants, polynomials, waves, exponentials)
simple = st.one_of(smooth, piecewise(), sampled())


@st.composite
def moved(draw, inner):
    """Return shifted or scaled functions whose domain contains LOW to HIGH."""
    if draw(st.booleans()):
        return Shifted(draw(inner), draw(st.floats(-2.0, 2.0)))
    return Scaled(draw(inner), draw(NOT_ZERO))


tame = st.one_of(
    waves, st.builds(Polynomial, st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=3))
)
any_smooth = st.recursive(
    smooth,
    lambda inner: st.one_of(
        st.lists(inner, min_size=2, max_size=3).map(lambda some: Sum(*some)),
        st.lists(inner, min_size=2, max_size=3).map(lambda some: Product(*some)),
        st.builds(Composition, st.one_of(waves, polynomials), tame),
        moved(inner),
    ),
    max_leaves=4,
)
any_function = st.one_of(
    simple,
    any_smooth,
    st.lists(st.one_of(simple, any_smooth), min_size=2, max_size=3).map(lambda some: Sum(*some)),
    st.lists(simple, min_size=2, max_size=3).map(lambda some: Product(*some)),
)
