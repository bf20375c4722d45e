"""Common rules of every function: values, domains, errors, value semantics."""

import copy
import pickle
import subprocess
import sys
from fractions import Fraction
from inspect import isabstract
from math import cos, exp, inf, nan, sin

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from motorhil.motorapi.errors import DomainError, UsageError
from motorhil.motorapi.functions import (
    Composition,
    Constant,
    Cosine,
    Ends,
    Exponential,
    Function,
    Integral,
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
from tests.support.mathematics import jets
from tests.support.mathematics.strategies import (
    ARGUMENTS,
    HIGH,
    LOW,
    any_function,
    any_smooth,
    made_of_polynomials,
    polynomials,
)

RAMP = Piecewise.of_polynomials((0.0, 1.0, 3.0), [(0.0, 0.0, 0.5), (0.5, 1.0)])
ONE_OF_EACH = [
    Constant(2.5),
    Polynomial((1.0, -2.0, 3.0), about=0.5),
    Sine(2.0, 3.0, 0.5),
    Cosine(2.0, 3.0, 0.5, about=1.0),
    Exponential(2.0, -0.5),
    RAMP,
    Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0), Interpolation.NEAREST),
    Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0)),
    Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0), Interpolation.CUBIC, ends=Ends.NATURAL),
    Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0), Interpolation.HERMITE, (1.0, 0.0, -1.0)),
    Sampled((0.0, 1.0), (1.0, 2.0), Interpolation.QUINTIC, (0.0, 0.0), (1.0, -1.0)),
    Sum(Sine(), RAMP),
    Product(Sine(), RAMP),
    Composition(Sine(), RAMP),
    Shifted(RAMP, -1.0),
    Scaled(RAMP.shifted(-1.0), -2.0),
    Integral(Product(Sine(), RAMP)),
]
NAMES = [type(one).__name__ for one in ONE_OF_EACH]
each = pytest.mark.parametrize("function", ONE_OF_EACH, ids=NAMES)


def test_all_function_classes_are_listed():
    # An unlisted class would escape these tests.
    found, waiting = set(), [Function]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        if not (isabstract(kind) or kind.__name__.startswith("_")):
            found.add(kind)
    assert {type(one) for one in ONE_OF_EACH} == {
        kind for kind in found if kind.__module__.startswith("motorhil.motorapi.")
    }


@given(polynomials, ARGUMENTS)
def test_polynomial_value_is_the_sum_of_its_terms(function, x):
    (exact,), (size,) = jets.jet(function, x, 0)
    # Horner's scheme rounds twice a step (N. Higham, Accuracy and Stability, 5.1).
    assert abs(function.value(x) - exact) <= 4e-15 * size


def test_waves_and_exponentials_follow_their_formulas():
    for x in (-3.0, 0.0, 0.7, 25.0):
        assert Sine(2.0, 3.0, 0.5, 1.0).value(x) == 2.0 * sin(3.0 * (x - 1.0) + 0.5)
        assert Cosine(2.0, 3.0, 0.5, 1.0).value(x) == 2.0 * cos(3.0 * (x - 1.0) + 0.5)
        assert Exponential(2.0, -0.5, 1.0).value(x) == 2.0 * exp(-0.5 * (x - 1.0))


@given(any_function, ARGUMENTS)
def test_composite_function_has_the_value_of_its_parts(function, x):
    assume(covers(function, x))
    (expected, *_), (size, *_) = jets.jet(function, x, 0)
    assert abs(function.value(x) - expected) <= 1e-13 * size


def covers(function, *arguments):
    low, high = function.domain
    return all(low <= x <= high for x in arguments)


@each
def test_domain_includes_its_ends_and_errors_name_both(function):
    low, high = function.domain
    if low == -inf:
        assert high == inf
        function.value(1e6)
        return
    for end, beyond in ((low, np.nextafter(low, -inf)), (high, np.nextafter(high, inf))):
        assert function(np.array([end]))[0] == function.value(end)
        for ask in (function.value, function, lambda x: function([low, x])):
            with pytest.raises(DomainError) as raised:
                ask(float(beyond))
            error = raised.value
            assert (error.argument, error.low, error.high) == (beyond, low, high)
            for told in (beyond, low, high):
                assert repr(float(told)) in str(error)
            assert isinstance(error, UsageError)


@each
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_nan_and_infinity_are_outside_every_domain(function, bad):
    for ask in (
        function.value,
        function,
        lambda x: function([x]),
        lambda x: function(np.array([[1.0, x]])),
        lambda x: function.integrate(1.0, x),
        lambda x: function.extrema(x, 1.0),
        lambda x: function.bounds(1.0, x),
        lambda x: function.restricted(x, 1.0),
    ):
        with pytest.raises(DomainError, match="domain"):
            ask(bad)


@each
def test_calls_keep_numbers_and_array_shapes(function):
    for number in (1.0, 1, np.float64(1.0), np.float32(1.0), np.int64(1), True):
        assert type(function(number)) is float
    for shape in ((0,), (5,), (2, 3), (2, 0, 3), ()):
        values = function(np.full(shape, 0.5))
        assert isinstance(values, np.ndarray)
        assert (values.shape, values.dtype) == (shape, np.float64)
    assert function([1, 0]).shape == (2,)
    columns = np.asfortranarray(np.linspace(0.0, 1.0, 12).reshape(3, 4))[:, ::2]
    assert function(columns).tolist() == [[function(float(x)) for x in row] for row in columns]
    given_before = columns.copy()
    function(columns)
    assert (columns == given_before).all()


@pytest.mark.parametrize("bad", ["text", None, object(), [[1.0], [1.0, 2.0]]])
def test_calls_with_non_numbers_raise(bad):
    with pytest.raises(UsageError):
        RAMP(bad)


@given(made_of_polynomials, st.lists(ARGUMENTS, min_size=1, max_size=40), st.booleans())
def test_polynomial_arrays_and_numbers_have_the_same_bits(function, arguments, ordered):
    arguments = [*arguments, *function.breaks_between(LOW, HIGH)]
    arguments = sorted(arguments) if ordered else arguments
    one_by_one = np.array([function.value(x) for x in arguments])
    assert function(arguments).tobytes() == one_by_one.tobytes()


@given(any_function, st.lists(ARGUMENTS, min_size=1, max_size=10))
def test_arrays_and_numbers_agree_to_the_last_digits(function, arguments):
    arguments = [x for x in arguments if covers(function, x)]
    for x, value in zip(arguments, function(arguments), strict=True):
        size = jets.jet(function, x, 0)[1][0]
        # sin and exp of the C library and of numpy: an ulp or two each.
        assert abs(value - function.value(x)) <= 4e-15 * size


def test_value_of_a_number_does_not_use_numpy():
    script = """
import sys
from motorhil.motorapi.functions import *
ramp = Piecewise.of_polynomials((0., 1., 3.), [(0., 0., .5), (.5, 1.)])
some = [ramp, Sampled((0., 1., 2.), (1., 2., 0.)), (ramp * Sine() + Exponential()).shifted(-0.5),
        Sine().after(ramp)]
import numpy
calls = []
sys.setprofile(lambda frame, event, thing: calls.append(thing) if event == "c_call" else
               calls.append(frame.f_code.co_filename))
for f in some:
    f.value(0.25)
sys.setprofile(None)
print([c for c in calls if "numpy" in str(c) or "numpy" in str(getattr(c, "__module__", ""))])
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@each
def test_functions_have_value_semantics(function):
    twin = pickle.loads(pickle.dumps(function))
    assert twin is not function
    assert twin == function
    assert hash(twin) == hash(function)
    assert repr(twin) == repr(function)
    assert copy.deepcopy(function) == function
    assert {function: 1}[twin] == 1
    assert function != function.shifted(0.125) or function.domain == (-inf, inf)
    assert function != 2.5
    x = 0.75 if covers(function, 0.75) else function.domain[0]
    assert twin.value(x) == function.value(x)


@given(any_function)
def test_function_survives_pickling(function):
    function(np.array([], dtype=float))  # with its cached data
    twin = pickle.loads(pickle.dumps(function))
    assert twin == function
    assert hash(twin) == hash(function)
    assert twin.domain == function.domain


@each
def test_functions_are_immutable(function):
    before = repr(function)
    for name in ("coefficients", "breaks", "amplitude", "_low", "anything"):
        with pytest.raises(AttributeError):
            setattr(function, name, 1.0)
    with pytest.raises(AttributeError):
        del function.domain
    assert repr(function) == before


def test_functions_differ_by_parameters_and_class():
    assert Sine(1.0, 2.0) != Sine(1.0, 3.0)
    assert Sine(1.0, 2.0) != Cosine(1.0, 2.0)
    assert Polynomial((1.0, 2.0)) != Polynomial((1.0, 2.0), about=1.0)
    assert Polynomial((1.0, 2.0, 0.0)) == Polynomial([1, 2])
    assert len({Sine(1.0, 2.0), Sine(1, 2), Cosine(1.0, 2.0)}) == 2
    assert Sum(Sine(), RAMP) != Product(Sine(), RAMP)
    assert Sum(Sine(), RAMP) != Sum(RAMP, Sine())


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (Constant(2), "Constant(2.0)"),
        (Polynomial((1, 2)), "Polynomial((1.0, 2.0))"),
        (Polynomial((3,), 1), "Polynomial((3.0,), about=1.0)"),
        (Polynomial(range(20), about=3), "<Polynomial: degree 19, about 3.0>"),
        (Sine(2, 3), "Sine(2.0, frequency_rad_s=3.0, phase_rad=0.0)"),
        (Exponential(2, -1, 5), "Exponential(2.0, rate=-1.0, about=5.0)"),
        (
            RAMP,
            "Piecewise((0.0, 1.0, 3.0), (Polynomial((0.0, 0.0, 0.5)), Polynomial((0.5, 1.0),"
            " about=1.0)))",
        ),
        (
            Piecewise.of_polynomials(range(11), [[0, 1, 2]] * 10),
            "<Piecewise: 10 polynomials of degree <= 2, 0.0 to 10.0>",
        ),
        (
            Sampled((0, 1), (2, 3)),
            "Sampled((0.0, 1.0), (2.0, 3.0), Interpolation.LINEAR)",
        ),
        (
            Sampled(range(100), range(100), Interpolation.CUBIC),
            "<Sampled: 100 samples, cubic, 0.0 to 99.0>",
        ),
        (Sine() + 1, "Sum(Sine(1.0, frequency_rad_s=1.0, phase_rad=0.0), Constant(1.0))"),
        (Shifted(Constant(1), 2), "Shifted(Constant(1.0), 2.0)"),
    ],
)
def test_long_reprs_are_abbreviated(function, told):
    assert repr(function) == told


@each
def test_short_reprs_are_valid_expressions(function):
    assert eval(repr(function)) == function


@given(any_smooth, st.floats(-2.0, 2.0), st.sampled_from([0.5, 2.0, -0.5, -3.0]))
@example(Sine(), 1.0, 2.0)
def test_shifted_begins_later_and_scaled_takes_longer(function, offset, factor):
    for x in (-0.5, 0.25, 1.0):
        size = 1.0 + jets.jet(function, x, 1)[1][0] + jets.jet(function, x, 1)[1][1]
        shifted, scaled = function.shifted(offset), function.scaled(factor)
        assert abs(shifted.value(x + offset) - function.value(x)) <= 1e-12 * size
        assert abs(scaled.value(x * factor) - function.value(x)) <= 1e-12 * size


def test_domains_move_with_their_functions():
    for whole in (
        RAMP,
        Sampled((0.0, 1.0, 3.0), (1.0, 2.0, 0.0)),
        Sum(Sine(), RAMP),
        Integral(RAMP),
    ):
        assert whole.shifted(2.0).domain == (2.0, 5.0)
        assert whole.scaled(2.0).domain == (0.0, 6.0)
        assert whole.scaled(-1.0).domain == (-3.0, 0.0)
        assert whole.restricted(1.0, 2.5).domain == (1.0, 2.5)


@given(*[st.floats(-1e3, 1e3), st.floats(1e-3, 1e3)] * 2)
def test_moved_function_is_defined_at_its_own_ends(begin, length, offset, factor):
    """Evaluate where rounding may move the inner argument out of the inner domain."""
    inner = Integral(Constant(1.0).restricted(begin, begin + length))
    for one in (Shifted(inner, offset), Scaled(inner, factor), Scaled(inner, -factor)):
        for end in one.domain:
            one.value(end)
        one(np.array(one.domain))


@pytest.mark.parametrize("factor", [0.0, inf, nan, "2", None])
@each
def test_scaling_by_zero_or_a_non_number_raises(function, factor):
    with pytest.raises(UsageError):
        function.scaled(factor)
    with pytest.raises(UsageError):
        Scaled(function, factor)
    if factor != 0.0:
        with pytest.raises(UsageError):
            function.shifted(factor)


@pytest.mark.parametrize("order", [-1, 1.5, "1", None])
def test_derivative_order_must_be_a_count(order):
    with pytest.raises(UsageError, match="order"):
        RAMP.derivative(order)


@each
def test_derivative_of_order_zero_is_the_function(function):
    assert function.derivative(0) is function


def test_distant_piece_keeps_its_digits():
    # 1 µrad steps at an epoch of 1e9 s: local arguments do not cancel.
    far = Piecewise.of_polynomials((1e9, 1e9 + 1, 1e9 + 2), [(1e-6, 1e-6, 1e-6), (3e-6, -1e-6)])
    x = 1e9 + 0.25
    exact = Fraction(1e-6) + Fraction(1e-6) / 4 + Fraction(1e-6) / 16
    assert abs(Fraction(far.value(x)) - exact) <= exact * Fraction(2, 10**16)
    assert far.integrate(1e9, 1e9 + 1) == pytest.approx(1e-6 * (1 + 1 / 2 + 1 / 3), rel=1e-15)
    assert far.derivative().value(x) == pytest.approx(1.5e-6, rel=1e-15)
