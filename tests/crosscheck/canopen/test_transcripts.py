"""Our drive in place of recorded ones: explained differences."""

import dataclasses

import pytest

from tests.support.canopen.transcripts import TRANSCRIPTS, played, table
from tests.support.checkout import CHECKOUT

TITLES = [one.title for one in TRANSCRIPTS]


@pytest.mark.data
@pytest.mark.parametrize("transcript", TRANSCRIPTS, ids=TITLES)
def test_drive_differs_from_recording_only_as_explained(transcript, shared, tmp_path):
    found, agreeing = played(transcript, shared, tmp_path)
    assert found == {about: what for about, (what, _) in transcript.differences.items()}
    assert agreeing > 0


@pytest.mark.data
def test_unexplained_difference_is_detected(shared, tmp_path):
    """The planted fault: another serial number without an explanation."""
    (servo,) = (one for one in TRANSCRIPTS if "three downloads" in one.title)
    other = dataclasses.replace(servo, objects={**servo.objects, "1018h:4": 2})
    found, _ = played(other, shared, tmp_path)
    assert set(found) - set(servo.differences) == {"1018h:4 serial number"}


def test_documented_table_is_up_to_date():
    assert table() in (CHECKOUT / "docs/reference/emulated-drive.md").read_text()
