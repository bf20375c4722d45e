"""The host's SDO client with late, repeated, lost and damaged responses.

The server's objects are the oracle: a value read equals the object, a value written is in the
object, or there is a correct error. The client accepts an abort only for its own transfer.
"""

from random import Random

import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation, SdoAborted
from motorhil.motorapi.errors import DeadlineExceeded, MotorError
from tests.support.canopen.two_drives import stranger, two_drives

MS = 1_000_000
ANSWERS, REQUESTS = 0x581, 0x601
NAME = b"motorhil CiA 402 drive"
WRITABLE = (0x607F, 0x6083)


def rules(kind: FaultKind, can_id: int, probability: float = 0.15, **facts: object) -> FaultRule:
    return FaultRule(kind.value, kind, identifier=can_id, probability=probability, **facts)  # type: ignore[arg-type]


HOSTILE = {
    "answers a little late": (rules(FaultKind.DELAY, ANSWERS, delay_ns=5 * MS), ()),
    "answers after the timeout": (
        rules(FaultKind.DELAY, ANSWERS, delay_ns=400 * MS),
        (DeadlineExceeded,),
    ),
    "answers twice": (rules(FaultKind.DUPLICATE, ANSWERS), ()),
    "answers lost": (rules(FaultKind.DROP, ANSWERS), (DeadlineExceeded,)),
    "requests lost": (rules(FaultKind.DROP, REQUESTS), (DeadlineExceeded,)),
    # a server that receives a segment request twice finds a wrong toggle bit, and aborts
    "requests twice": (rules(FaultKind.DUPLICATE, REQUESTS), (SdoAborted,)),
    "toggle bits wrong": (
        rules(FaultKind.CORRUPT, ANSWERS, flip=b"\x10"),
        (DeadlineExceeded, ProtocolViolation),
    ),
    "command specifiers wrong": (
        rules(FaultKind.CORRUPT, ANSWERS, flip=b"\x80"),
        (DeadlineExceeded, ProtocolViolation, SdoAborted),
    ),
}


@pytest.mark.parametrize("how", HOSTILE)
@pytest.mark.parametrize("seed", range(3))
def test_sdo_values_equal_objects_or_right_error_is_raised(how, seed):
    rule, allowed = HOSTILE[how]
    random = Random(seed)
    with two_drives(rule, seed=seed) as rig:
        hardware = rig.motors["left"].hardware
        od = rig.world.controller("left").od
        errors = []
        for number in range(25):
            index = random.choice(WRITABLE)
            try:
                what = number % 4
                if what == 0:
                    value = random.randrange(1000, 2**31)
                    hardware.download(index, 0, value.to_bytes(4, "little"))
                    assert od.integer(index, 0, 0) == value
                elif what == 1:
                    read = int.from_bytes(hardware.upload(index), "little")
                    assert read == od.integer(index, 0, 0)
                elif what == 2:
                    assert hardware.upload(0x1008) == NAME
                else:
                    with pytest.raises(SdoAborted) as caught:
                        hardware.upload(0x2000)
                    assert (caught.value.index, caught.value.abort_code) == (0x2000, 0x0602_0000)
            except MotorError as error:
                errors.append(error)
        assert {type(error) for error in errors} <= set(allowed)
        if SdoAborted in allowed and how == "requests twice":
            # and then, on the request for the next segment, that there is no transfer (0504 0001h)
            assert {one.index for one in errors} == {0x1008}
            assert {one.abort_code for one in errors} <= {0x0503_0000, 0x0504_0001}
        assert rig.runtime.now_ns() < 60_000 * MS


def test_abort_without_object_is_not_for_new_transfer():
    """A server without a transfer names no object: the abort cannot concern the new one."""
    with two_drives() as rig:
        hardware = rig.motors["left"].hardware
        say = rig.world.add_host("can0", "late", lambda *_: None)
        from tests.support.canopen.drive_wire import frame

        # complete while the response is pending: 1 ms after the request
        rig.world.queue.alarm(lambda now_ns: say.send(frame("581#8000000001000405"))).set(
            rig.runtime.now_ns() + 400_000
        )
        assert hardware.upload(0x1018, 2) == (0x402).to_bytes(4, "little")


def test_other_client_on_channel_is_reported_or_harmless():
    with two_drives() as rig:
        hardware = rig.motors["left"].hardware
        say = stranger(rig)
        say("601#4008100000000000")  # begins a segmented upload, and leaves it there
        assert hardware.upload(0x1018, 2) == (0x402).to_bytes(4, "little")
        say("601#6000000000000000")  # continues it, but there is no transfer any more
        assert hardware.upload(0x1008) == NAME
