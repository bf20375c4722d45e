"""Our drive in the place of recorded ones: every difference has its reason in `transcripts`."""

import dataclasses

import pytest

from tests.architecture.checkout import CHECKOUT
from tests.crosscheck.transcripts import TRANSCRIPTS, played, table

TITLES = [one.title for one in TRANSCRIPTS]


@pytest.mark.data
@pytest.mark.parametrize("transcript", TRANSCRIPTS, ids=TITLES)
def test_what_our_drive_tells_a_recorded_host_differs_as_explained_and_no_more(
    transcript, shared, tmp_path
):
    found, agreeing = played(transcript, shared, tmp_path)
    assert found == {about: what for about, (what, _) in transcript.differences.items()}
    assert agreeing > 0


@pytest.mark.data
def test_a_drive_that_says_something_else_is_not_explained(shared, tmp_path):
    """The planted fault: another serial number, which nobody has explained."""
    (servo,) = (one for one in TRANSCRIPTS if "three downloads" in one.title)
    other = dataclasses.replace(servo, objects={**servo.objects, "1018h:4": 2})
    found, _ = played(other, shared, tmp_path)
    assert set(found) - set(servo.differences) == {"1018h:4 serial number"}


def test_the_table_in_the_documents_is_this_one():
    assert table() in (CHECKOUT / "docs/reference/emulated-drive.md").read_text()
