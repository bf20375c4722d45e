"""Bus status from error messages, in the notation of candump on SocketCAN.

Layout: linux/can/error.h: classes in the identifier; data[1] controller state, data[6] TEC, data[7]
REC.
"""

import struct

import pytest

from motorhil.motorapi.errors import LinkError
from motorhil.motorapi.runtime.can_sources import BusCondition, BusStatus

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
def test_condition_is_the_last_reported_one(texts, condition, counters):
    status = told(*texts)
    assert (status.condition, status.counters) == (condition, counters)
    assert status.is_off is (condition is C.OFF)


def test_status_shows_time_and_present_counters():
    status = told(WARNING, PASSIVE, PASSIVE, "20000204#0020000000008800")
    assert str(status) == "can0 is error passive since 0.002000 s (TEC 136, REC 0)"


def test_bus_off_fails_operations_with_the_remedy():
    status = told(OFF)
    with pytest.raises(LinkError) as failed:
        status.check()
    assert str(failed.value) == (
        "can0: bus-off: nothing is sent or received since 0.001000 s; restart it"
    )
    assert (failed.value.since_ns, failed.value.remedy) == (1 * MS, "restart it")
    status.hear(message(OFF), 2 * MS)
    assert status.offs == 1


def test_recovered_bus_reports_the_outage_to_waiters():
    status = told(OFF, RESTARTED)
    status.check()
    assert status.offs == 1
    assert str(status.failure()) == (
        "can0: the bus was off at 0.001000 s and has recovered; operations waiting at that time"
        " failed"
    )


@pytest.mark.parametrize(
    ("texts", "trouble"),
    [
        ((), ""),
        ((BIT_ERROR,), ""),
        ((WARNING,), "can0 is at the error warning limit since 0.001000 s (TEC 96, REC 0)"),
        ((PASSIVE_BY_HEARING,), "can0 is error passive since 0.001000 s (TEC 0, REC 135)"),
        ((NO_ACKNOWLEDGE,), "can0: no ACK since t = 0.001000 s, controller error active"),
        (
            (NO_ACKNOWLEDGE, WARNING, PASSIVE),
            "can0: no ACK since t = 0.001000 s, controller error passive",
        ),
        ((PASSIVE,), "can0: no ACK since t = 0.001000 s, controller error passive"),
        ((PASSIVE, ACTIVE), ""),
    ],
)
def test_timeout_reports_the_trouble_of_the_bus(texts, trouble):
    assert told(*texts).trouble() == trouble


def test_transmitted_frame_clears_missing_ack():
    status = told(NO_ACKNOWLEDGE)
    status.sent()
    assert status.trouble() == ""
