"""Bus listener of a replayed host around a reset."""

from motorhil.harness.replay.host import ReceiveQueue
from motorhil.traces.can_frame import classic

RESET = classic(0, b"\x81\x00")
BOOT_UP = classic(0x701, b"\x00")


def test_ears_ignore_boot_up_before_own_reset():
    heard = []
    ears = ReceiveQueue(lambda *what: heard.append(what), RESET)
    told = [(BOOT_UP, 1, False), (RESET, 2, False), (RESET, 3, True), (BOOT_UP, 4, False)]
    for one in told:  # a foreign reset does not count
        ears.heard(*one)
    assert heard == told[2:]


def test_ears_without_reset_hear_everything():
    heard = []
    ReceiveQueue(lambda *what: heard.append(what), None).heard(BOOT_UP, 1, False)
    assert heard == [(BOOT_UP, 1, False)]
