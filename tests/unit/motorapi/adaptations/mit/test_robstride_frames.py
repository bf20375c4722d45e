"""The identifiers of RobStride's frames (its manual, private protocol: types 2 and 3)."""

from motorhil.motorapi.adaptations.mit.frames import Maker
from motorhil.motorapi.adaptations.mit.robstride import ROBSTRIDES, RobstrideFrames


def test_answers_to_another_host_are_heard_once_it_has_asked():
    frames = RobstrideFrames(1, 0x10, Maker.ROBSTRIDE, ROBSTRIDES["rs05"])
    with_fault = 0x0284_015A  # feedback to host 5Ah: in run mode, over-temperature
    assert with_fault not in set(frames.answers())
    assert with_fault in set(frames.more_answers(0x0300_5A01))  # host 5Ah enables drive 1
    assert frames.more_answers(0x0300_5A01) == ()
