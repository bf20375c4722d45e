"""Piecewise functions: choice of pieces, and evaluation of arrays."""

from math import inf, nan, nextafter

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.functions import Constant, Exponential, Piecewise, Polynomial, Sampled, Sine
from motorhil.motorapi.functions.piece_table import PieceFinder

RAMP = Piecewise.of_polynomials((0.0, 1.0, 3.0), [(0.0, 0.0, 0.5), (0.5, 1.0)])


def test_value_at_a_break_is_of_the_next_piece_or_the_last():
    steps = Piecewise((0.0, 1.0, 2.0), (Constant(5.0), Constant(7.0)))
    at = [0.0, nextafter(1.0, 0.0), 1.0, 2.0]
    assert [steps.value(x) for x in at] == [5.0, 5.0, 7.0, 7.0]
    assert steps(at).tolist() == [5.0, 5.0, 7.0, 7.0]
    assert steps(at[::-1]).tolist() == [7.0, 7.0, 5.0, 5.0]


def test_of_polynomials_takes_local_arguments():
    assert RAMP.pieces == (Polynomial((0.0, 0.0, 0.5)), Polynomial((0.5, 1.0), about=1.0))
    assert RAMP.value(2.0) == 1.5
    with pytest.raises(UsageError, match="2 pieces need 3 breaks, not 2"):
        Piecewise.of_polynomials((0.0, 1.0), [(1.0,), (2.0,)])


def test_pieces_may_be_of_any_kind():
    mixed = Piecewise((-1.0, 0.0, 1.0, 2.0), (Sine(), Polynomial((0.0, 1.0)), Exponential()))
    x = np.array([1.5, -0.5, 0.5, 2.0, -1.0, 0.0, 1.0, 0.5])
    assert mixed(x).tolist() == pytest.approx([mixed.value(float(at)) for at in x], rel=4e-16)
    assert mixed.derivative().value(-0.5) == np.cos(-0.5)
    assert mixed.integrate(-1.0, 2.0) == pytest.approx(
        (np.cos(1.0) - 1.0) + 0.5 + (np.exp(2.0) - np.exp(1.0)), rel=1e-14
    )
    whole = mixed.integral()
    for x in (0.0, 1.0):
        assert whole.value(x) == pytest.approx(whole.value(nextafter(x, -1.0)), abs=1e-14)
    assert mixed.extrema().maximum == np.exp(2.0)
    assert mixed.is_polynomial is False


def test_nested_piecewise_pieces_are_flattened():
    inner = Piecewise((-1.0, 0.5, 2.0), (Sine(), Constant(3.0)))
    outer = Piecewise((0.0, 1.0, 2.0), (inner, RAMP.shifted(1.0)))
    assert outer.breaks == (0.0, 0.5, 1.0, 2.0)
    assert outer.pieces == (Sine(), Constant(3.0), RAMP.pieces[0].shifted(1.0))
    again = Piecewise(outer.breaks, outer.pieces)
    assert again == outer


def test_breaks_include_those_within_pieces():
    step = Piecewise((0.0, 1.0, 3.0), (Constant(0.0), Constant(5.0)))
    made = Piecewise((0.0, 2.0, 4.0), (Sine() + step, Constant(1.0)))
    assert made.breaks_between(0.0, 4.0) == (1.0, 2.0)
    assert made.breaks_between(1.0, 2.0) == ()
    assert (made * Sine()).breaks_between(0.5, 4.0) == (1.0, 2.0)
    assert made.shifted(1.0).breaks_between(0.0, 5.0) == (2.0, 3.0)
    assert (Sine() + step).scaled(-2.0).breaks_between(-6.0, 0.0) == (-2.0,)
    for low, high, smooth in (
        (0.0, 0.5, True),
        (0.5, 1.0, False),
        (1.0, 1.5, True),
        (1.5, 2.5, False),
    ):
        assert made.is_smooth(low, high) is smooth


def test_joined_functions_follow_each_other():
    track = Piecewise.joined(RAMP, Constant(2.5).restricted(-1.0, 0.0), RAMP.scaled(-1.0))
    assert track.breaks == (0.0, 1.0, 3.0, 4.0, 6.0, 7.0)
    assert track([0.5, 2.0, 3.5, 4.0, 5.0, 6.5]).tolist() == [0.125, 1.5, 2.5, 2.5, 1.5, 0.125]
    assert Piecewise.joined(RAMP) == RAMP
    with pytest.raises(UsageError, match="restrict"):
        Piecewise.joined(RAMP, Sine())


def test_outer_pieces_may_be_unbounded():
    held = Piecewise((-inf, 0.0, 1.0, inf), (Constant(0.0), Polynomial((0.0, 1.0)), Constant(1.0)))
    assert held.domain == (-inf, inf)
    assert held([-1e300, 0.5, 1e300]).tolist() == [0.0, 0.5, 1.0]
    assert held.value(-1e300) == 0.0
    assert held.extrema(-5.0, 5.0).maximum == 1.0
    assert (held + RAMP).domain == (0.0, 3.0)
    assert held.scaled(-1.0).value(-0.25) == 0.25


def test_restricted_function_has_the_restricted_domain():
    part = RAMP.restricted(0.5, 2.0)
    assert part.domain == (0.5, 2.0)
    assert part.pieces == RAMP.pieces
    assert Sine().restricted(0.0, 1.0) == Piecewise((0.0, 1.0), (Sine(),))
    for low, high in ((0.5, 0.5), (1.0, 0.5)):
        with pytest.raises(UsageError, match="not above"):
            RAMP.restricted(low, high)
    with pytest.raises(UsageError, match="domain"):
        RAMP.restricted(-1.0, 1.0)


@pytest.mark.parametrize(
    ("breaks", "pieces", "told"),
    [
        ((0.0,), (), "at least one piece"),
        ((0.0, 1.0), (), "at least one piece"),
        ((0.0, 1.0, 2.0), (Constant(1),), "1 pieces with 3 breaks"),
        ((0.0, 0.0), (Constant(1),), "break 1 is 0.0, not above break 0, 0.0"),
        ((0.0, 2.0, 1.0), (Constant(1), Constant(2)), "break 2 is 1.0, not above break 1"),
        ((0.0, nan), (Constant(1),), "break 1 is nan"),
        (("a", 1.0), (Constant(1),), "break 0, nan"),
        ((0.0, inf, inf), (Constant(1), Constant(1)), "not above"),
        ((0.0, 1.0), (3.0,), "piece 0 is 3.0, not a function"),
        ((0.0, 4.0), (RAMP,), "is 0.0 to 3.0 only"),
        (1.0, (RAMP,), "sequences"),
    ],
)
def test_invalid_piecewise_function_raises(breaks, pieces, told):
    with pytest.raises(UsageError, match=told):
        Piecewise(breaks, pieces)


def test_shift_that_merges_breaks_raises():
    with pytest.raises(UsageError, match="not above"):
        RAMP.shifted(1e300)


# --- choice of the piece of an argument

GAPS = st.floats(1e-9, 1.0) | st.sampled_from([1.0, 1e-3, 1e3])


@st.composite
def breaks_and_arguments(draw):
    begin = draw(st.floats(-1e3, 1e3))
    gaps = draw(st.lists(GAPS, min_size=1, max_size=30))
    breaks = np.unique(np.cumsum([begin, *gaps]))
    inside = st.floats(float(breaks[0]), float(breaks[-1]))
    near = st.sampled_from(breaks.tolist()).flatmap(
        lambda b: st.sampled_from([b, nextafter(b, -inf), nextafter(b, inf)])
    )
    arguments = draw(st.lists(inside | near, min_size=1, max_size=60))
    return breaks, np.clip(arguments, breaks[0], breaks[-1])


@given(breaks_and_arguments())
def test_guide_and_runs_find_the_piece_of_a_search(data):
    breaks, arguments = data
    finder = PieceFinder(breaks.tolist())
    expected = np.searchsorted(breaks[1:-1], arguments, side="right").tolist()
    event(f"crowd {min(finder._crowd, 5)}")
    assert finder.pieces_of(arguments).tolist() == expected
    if finder._crowd <= 30:
        finder._crowd = max(finder._crowd, 1) if finder._cells else finder._crowd
        assert finder.pieces_of(arguments).tolist() == expected
    order = np.argsort(arguments, kind="stable")
    first, end, counts = finder.runs_of(arguments[order])
    assert np.repeat(np.arange(first, end), counts).tolist() == sorted(expected)
    if (np.diff(arguments) < 0).any():
        assert finder.runs_of(arguments) is None


def test_all_three_ways_to_find_pieces_are_used():
    even = PieceFinder(np.linspace(0.0, 1.0, 1001).tolist())
    assert even._crowd <= 2  # by the guide
    crowded = PieceFinder([0.0, *(1e-9 * k for k in range(1, 20)), 1.0])
    assert crowded._crowd > 4  # by search
    endless = PieceFinder([-inf, 0.0, 1.0, inf])
    assert endless._crowd > 4
    for finder, x in ((even, [0.9, 0.1]), (crowded, [1.0, 5.5e-9]), (endless, [1e300, -1e300])):
        x += finder._inner[::-1].tolist()  # at a break, the later piece
        found = finder.pieces_of(np.array(x)).tolist()
        assert found == np.searchsorted(finder._inner, x, side="right").tolist()
        assert finder.runs_of(np.array(x)) is None


@pytest.mark.parametrize("pieces", [1, 2, 1000])
@pytest.mark.parametrize("degree", [0, 1, 3, 5])
def test_many_points_at_once_equal_scipy(pieces, degree):
    from scipy import interpolate

    draw = np.random.default_rng(pieces + degree)
    breaks = np.cumsum(draw.uniform(0.1, 1.0, pieces + 1))
    rows = draw.normal(size=(degree + 1, pieces))
    ours = Piecewise.of_polynomials(breaks, rows[::-1].T)
    theirs = interpolate.PPoly(rows, breaks)
    x = draw.uniform(breaks[0], breaks[-1], 100_000)  # several blocks, the last one incomplete
    x[:2] = breaks[[0, -1]]
    for arguments in (x, np.sort(x), np.sort(x)[::-1]):
        expected = theirs(arguments)
        assert np.abs(ours(arguments) - expected).max() <= 1e-12 * np.abs(expected).max()
    at = x[:1000].tolist()
    assert ours(at).tolist() == [ours.value(one) for one in at]
    for order in range(1, degree + 2):
        expected = theirs(x, order)
        slack = 1e-12 * max(np.abs(expected).max(), 1e-300)
        assert np.abs(ours.derivative(order)(x) - expected).max() <= slack
    whole = theirs.antiderivative()(x)
    assert np.abs(ours.integral()(x) - whole).max() <= 1e-12 * np.abs(whole).max()


def test_array_argument_may_be_shared_and_read_only():
    x = np.linspace(0.0, 3.0, 7)
    x.flags.writeable = False
    assert RAMP(x)[-1] == 2.5
    values = RAMP(x)
    values[:] = 0.0
    assert RAMP(x)[-1] == 2.5
    assert Sampled((0.0, 3.0), (1.0, 4.0))(x).tolist() == [1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0]
