"""What a replayed host hears of a bus it resets: nothing that was told before."""

from harness.replay.ears import Ears
from traces.traffic import classic

RESET = classic(0, b"\x81\x00")
BOOT_UP = classic(0x701, b"\x00")


def test_a_boot_up_from_before_the_reset_is_no_answer_to_it():
    heard = []
    ears = Ears(lambda *what: heard.append(what), RESET)
    told = [(BOOT_UP, 1, False), (RESET, 2, False), (RESET, 3, True), (BOOT_UP, 4, False)]
    for one in told:  # somebody else's reset is not ours
        ears.heard(*one)
    assert heard == told[2:]


def test_without_a_reset_all_is_heard():
    heard = []
    Ears(lambda *what: heard.append(what), None).heard(BOOT_UP, 1, False)
    assert heard == [(BOOT_UP, 1, False)]
