"""Error counters of a node, and their reports."""

import pytest

from motorhil.emulators.can import error_confinement as told
from motorhil.emulators.can.bitlevel.controller import NOTE_STATE, ErrorJournal
from motorhil.emulators.can.error_confinement import Confinement, ErrorState, state_of


@pytest.mark.parametrize(
    ("counter", "state"),
    [
        (0, ErrorState.ACTIVE),
        (95, ErrorState.ACTIVE),
        (96, ErrorState.WARNING),
        (127, ErrorState.WARNING),
        (128, ErrorState.PASSIVE),
        (255, ErrorState.PASSIVE),
        (256, ErrorState.BUS_OFF),
    ],
)
def test_error_state_follows_rule_i(counter, state):
    assert state_of(counter) is state


@pytest.mark.parametrize(("tec", "rec"), [(-1, 0), (256, 0), (0, -1), (0, 256)])
def test_invalid_counters_are_refused(tec, rec):
    with pytest.raises(ValueError, match="0 to 255"):
        Confinement(tec, rec)


@pytest.mark.parametrize(
    ("before", "after", "classes", "controller", "counters"),
    [
        ((88, 0), (96, 0), told.CONTROLLER, told.TX_WARNING, (96, 0)),
        ((0, 95), (0, 96), told.CONTROLLER, told.RX_WARNING, (0, 96)),
        ((96, 95), (96, 96), 0, 0, (0, 0)),  # it was at the warning level before
        ((96, 120), (96, 128), told.CONTROLLER, told.RX_PASSIVE, (96, 128)),
        ((120, 127), (128, 128), told.CONTROLLER, told.TX_PASSIVE | told.RX_PASSIVE, (128, 128)),
        ((128, 0), (127, 0), told.CONTROLLER, told.TX_WARNING, (127, 0)),
        ((0, 200), (0, 127), told.CONTROLLER, told.RX_WARNING, (0, 127)),
        ((96, 0), (95, 0), told.CONTROLLER, told.ERROR_ACTIVE, (95, 0)),
        ((250, 3), (258, 3), told.MESSAGE_BUS_OFF, 0, (0, 0)),
    ],
)
def test_state_change_is_reported_as_by_linux(before, after, classes, controller, counters):
    """drivers/net/can/dev/dev.c, can_change_state; data[6] and data[7] are the counters.

    On bus-off, drivers report none (sja1000, m_can, rkcanfd: new_state != CAN_STATE_BUS_OFF).
    """
    confinement = Confinement(*before)
    journal = ErrorJournal(confinement)
    confinement.tec, confinement.rec = after
    assert journal.note_state() is (classes == told.MESSAGE_BUS_OFF)
    assert not journal.note_state()  # once
    if not classes:
        assert journal.notes == []
        return
    ((_, kind, message),) = journal.notes
    assert kind == NOTE_STATE
    can_id = int.from_bytes(message[:4], "little")
    counted = 0 if classes == told.MESSAGE_BUS_OFF else told.COUNTERS
    assert can_id == 0x20000000 | classes | counted
    assert message[9] == controller
    assert (message[14], message[15]) == counters


def test_bus_error_leading_to_bus_off_has_no_counters():
    confinement = Confinement(255, 7)
    journal = ErrorJournal(confinement)
    journal.note_error(told.BIT0_ERROR, told.DATA, transmitter=True)
    confinement.tec = 263
    journal.note_error(told.BIT0_ERROR, told.DATA, transmitter=True)
    with_them, without = [message for _, _, message in journal.notes]
    assert int.from_bytes(with_them[:4], "little") & told.COUNTERS
    assert (with_them[14], with_them[15]) == (255, 7)
    assert not int.from_bytes(without[:4], "little") & told.COUNTERS
    assert (without[14], without[15]) == (0, 0)
