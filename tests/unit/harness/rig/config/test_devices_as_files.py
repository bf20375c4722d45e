"""Files without an end are refused before they are read."""

import pytest

from motorhil.motorapi.errors import FileError
from motorhil.motorapi.model import MotorModel


@pytest.mark.parametrize("verb", ["check", "run", "serve"])
def test_device_is_no_rig(say, verb):
    assert say(verb, "/dev/zero") == (
        *(2, ""),
        "/dev/zero: is a device, which may have no end; name a file\n",
    )


def test_device_is_no_motor_model():
    with pytest.raises(FileError, match="it is a device, which may have no end"):
        MotorModel.load("/dev/zero")
