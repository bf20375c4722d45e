"""Fixtures: messages of the demo, and a session about a recording."""

import pytest

from motorhil.harness.view.session import Session, Subject
from motorhil.traces.mcap.reader import read_trace


@pytest.fixture(scope="session")
def demo_messages(demo):
    """Return a function that gives the attachments and the messages of the demo."""
    with read_trace(demo) as trace:
        told = list(trace.attachments), list(trace.messages())
    return lambda: told  # Hypothesis prints arguments


@pytest.fixture
def session_of():
    """Return a function that makes a session about a recording, and its messages."""

    def make(path):
        with read_trace(path) as trace:
            messages = list(trace.messages())
            subject = Subject("a title", trace.attachments, trace.span_ns()[0])
        return Session(subject), messages

    return make
