"""Files without an end are refused before they are read."""

import pytest

from motorhil.motorapi.errors import FileError
from motorhil.motorapi.model import MotorModel


@pytest.mark.parametrize("verb", ["check", "run", "serve"])
def test_device_is_no_rig(say, verb):
    assert say(verb, "/dev/zero") == (
        *(2, ""),
        "/dev/zero: has more than 16 MB, so it is no rig; name a rig file\n",
    )


def test_device_is_no_motor_model():
    with pytest.raises(FileError, match="more than 16 MB, so it is no model"):
        MotorModel.load("/dev/zero")
