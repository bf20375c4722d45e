"""Meaning of a recording: the work that it takes."""

import sys
from collections import Counter

from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.semantics.diff import Tolerance, fidelity
from motorhil.traces.semantics.model import Item, Meaning, meaning_of
from tests.support.golden import golden


def test_meaning_makes_no_sentences_of_traffic():
    calls = Counter()

    def count(frame, event, _):
        if event == "call":
            calls[frame.f_code.co_qualname] += 1

    with golden("cia402") as path, read_trace(path) as trace:
        sys.setprofile(count)
        try:
            meaning = meaning_of(trace)
        finally:
            sys.setprofile(None)
    assert calls["CanopenDecoder.decode"] > 500
    assert calls["DecodedEvent.text"] == 0
    items = sum(len(one) for one in meaning.items.values())
    assert calls["Fact.text"] <= items


def test_equal_states_are_compared_in_linear_time():
    """Matching blocks of two long orders of few values takes the square of their length."""
    key = ("can0", 1, "6041h statusword")
    pair = Meaning(), Meaning()
    for meaning in pair:
        meaning.labels[key] = "statusword"
        meaning.items[key] = [Item(number, (number % 2,), "") for number in range(1000)]
    calls = Counter()
    sys.setprofile(lambda _, event, __: calls.update([event]))
    try:
        (one,) = fidelity(*pair, Tolerance())
    finally:
        sys.setprofile(None)
    assert (one.agreeing, one.of) == (1000, 1000)
    assert calls["c_call"] < 10_000
