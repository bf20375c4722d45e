"""Formats that can be written, as parameters of tests; one without its library is skipped."""

from importlib.util import find_spec

import pytest

from motorhil.traces.formats import mf4
from motorhil.traces.formats.registry import WRITABLE, Feature

IS_THERE = {form.name: form.name != "mf4" or find_spec("asammdf") is not None for form in WRITABLE}
WRITTEN = [
    pytest.param(
        form,
        id=form.name,
        marks=pytest.mark.skipif(
            not IS_THERE[form.name], reason="needs asammdf: pip install asammdf"
        ),
    )
    for form in WRITABLE
]


def in_order_of(holds, frames):
    """Return the frames, sorted if a format that holds these features stores no other order."""
    return list(frames) if Feature.ORDER in holds else sorted(frames, key=mf4.order_key)
