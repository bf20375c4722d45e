"""Meaning of a recording: the work that it takes."""

import sys
from collections import Counter

from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.semantics.model import meaning_of
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
