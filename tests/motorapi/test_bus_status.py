"""What is known of a bus by error messages, spelled out as candump shows them on SocketCAN.

Layout: linux/can/error.h: classes in the identifier; data[1] state of the controller, data[6] TEC,
data[7] REC.
"""

import struct

import pytest

from motorapi.bus_status import BusCondition, BusStatus
from motorapi.errors import LinkError

C = BusCondition
MS = 1_000_000

WARNING = "20000204#0008000000006000"
PASSIVE = "20000204#0020000000008000"
PASSIVE_BY_HEARING = "20000204#0010000000000087"
ACTIVE = "20000004#0040000000000000"
OFF = "20000040#0000000000000000"
RESTARTED = "20000100#0000000000000000"
NO_ACKNOWLEDGE = "200000A8#0000001900000000"  # with bus error and protocol: in the ACK slot
BIT_ERROR = "20000088#0000900A00000000"
OVERFLOW = "20000004#0001000000000000"


def message(text: str) -> bytes:
    can_id, _, data = text.partition("#")
    return struct.pack("<IB3x8s", int(can_id, 16), 8, bytes.fromhex(data))


def told(*texts: str) -> BusStatus:
    status = BusStatus("can0", "restart it")
    for place, text in enumerate(texts):
        status.hear(message(text), (place + 1) * MS)
    return status


@pytest.mark.parametrize(
    ("texts", "condition", "counters"),
    [
        ((), C.ACTIVE, None),
        ((WARNING,), C.WARNING, (96, 0)),
        ((WARNING, PASSIVE), C.PASSIVE, (128, 0)),
        ((PASSIVE_BY_HEARING,), C.PASSIVE, (0, 135)),
        ((PASSIVE, WARNING), C.WARNING, (96, 0)),
        ((PASSIVE, ACTIVE), C.ACTIVE, None),
        ((PASSIVE, OFF), C.OFF, None),
        ((OFF, RESTARTED), C.ACTIVE, None),
        ((OFF, BIT_ERROR, OVERFLOW), C.OFF, None),
        ((BIT_ERROR, OVERFLOW, NO_ACKNOWLEDGE), C.ACTIVE, None),
    ],
)
def test_the_condition_is_the_one_told_last(texts, condition, counters):
    status = told(*texts)
    assert (status.condition, status.counters) == (condition, counters)
    assert status.is_off is (condition is C.OFF)


def test_it_tells_since_when_and_the_counters_as_they_change():
    status = told(WARNING, PASSIVE, PASSIVE, "20000204#0020000000008800")
    assert str(status) == "can0 is error passive since 0.002000 s (TEC 136, REC 0)"


def test_off_the_bus_everything_fails_by_name_with_the_remedy():
    status = told(OFF)
    with pytest.raises(LinkError) as failed:
        status.check()
    assert str(failed.value) == (
        "can0: bus-off: nothing is sent or heard since 0.001000 s; restart it"
    )
    assert (failed.value.since_ns, failed.value.remedy) == (1 * MS, "restart it")
    status.hear(message(OFF), 2 * MS)
    assert status.offs == 1


def test_once_it_is_on_again_who_waited_is_told_that_too():
    status = told(OFF, RESTARTED)
    status.check()
    assert status.offs == 1
    assert str(status.failure()) == (
        "can0: it went off the bus at 0.001000 s, and is on again; what waited then is lost"
    )


@pytest.mark.parametrize(
    ("texts", "trouble"),
    [
        ((), ""),
        ((BIT_ERROR,), ""),
        ((WARNING,), "can0 is at the error warning limit since 0.001000 s (TEC 96, REC 0)"),
        ((PASSIVE_BY_HEARING,), "can0 is error passive since 0.001000 s (TEC 0, REC 135)"),
        ((NO_ACKNOWLEDGE,), "nobody acknowledges on can0 since 0.001000 s, it is error active"),
        (
            (NO_ACKNOWLEDGE, WARNING, PASSIVE),
            "nobody acknowledges on can0 since 0.001000 s, it is error passive",
        ),
        ((PASSIVE,), "nobody acknowledges on can0 since 0.001000 s, it is error passive"),
        ((PASSIVE, ACTIVE), ""),
    ],
)
def test_who_waits_in_vain_is_told_what_is_wrong_with_the_bus(texts, trouble):
    assert told(*texts).trouble() == trouble


def test_a_frame_that_was_on_the_wire_was_acknowledged():
    status = told(NO_ACKNOWLEDGE)
    status.sent()
    assert status.trouble() == ""
