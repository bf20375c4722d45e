"""The statusword's state bits against canopen's masks (from CiA 402-2, state coding)."""

from canopen.profiles.p402 import State402
from hypothesis import given
from hypothesis import strategies as st

from motorhil.emulators.cia402.state_machine import MODE_BITS, PdsState, compose


@given(st.sampled_from(list(PdsState)), st.integers(0, 7), *[st.booleans()] * 4)
def test_each_state_is_decoded_whatever_the_other_bits(state, mode, voltage, remote, limit, warn):
    word = compose(
        state,
        mode_bits=(mode << 11 | mode << 10) & MODE_BITS,
        voltage=voltage,
        remote=remote,
        limit=limit,
        warning=warn,
    )
    read = [name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits]
    assert read == [state.name.replace("_", " ")]
    assert bool(word & 0x10) is voltage
    assert bool(word & 0x80) is warn
    assert bool(word & 0x200) is remote
    assert bool(word & 0x800) is limit


def test_words_match_those_of_a_real_drive():
    """Check statuswords in drives.md's table, with voltage (10h) and remote (200h) set."""

    def word(state: PdsState) -> int:
        return compose(state, mode_bits=0, voltage=True, remote=True, limit=False, warning=False)

    assert word(PdsState.SWITCH_ON_DISABLED) == 0x0250
    assert word(PdsState.READY_TO_SWITCH_ON) == 0x0231
    assert word(PdsState.SWITCHED_ON) == 0x0233
    assert word(PdsState.OPERATION_ENABLED) == 0x0237
    assert word(PdsState.QUICK_STOP_ACTIVE) == 0x0217
    assert word(PdsState.FAULT) == 0x0218
