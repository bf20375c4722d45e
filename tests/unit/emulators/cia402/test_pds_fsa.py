"""The power state machine against CiA 402-2 and against canopen's reading of it."""

import pytest
from canopen.profiles.p402 import State402
from hypothesis import event, example, given
from hypothesis import strategies as st

from motorhil.emulators.cia402.state_machine import (
    ENDS,
    NO_TRANSITION,
    TRANSITIONS,
    Command,
    PdsFsa,
    PdsState,
    decode_controlword,
)

S = PdsState

# Start at any depth of the table; then commands, or any 16 bits for generality.
START = st.sampled_from([[], [0x06], [0x06, 0x07], [0x06, 0x07, 0x0F], [0x06, 0x07, 0x0F, 0x02]])
COMMANDS = st.sampled_from([0x0000, 0x0002, 0x0006, 0x0007, 0x000F, 0x0080])
REST = st.lists(COMMANDS | st.integers(0, 0xFFFF), max_size=40)
CONTROLWORDS = st.builds(lambda start, rest: start + rest, START, REST)


def written(fsa: PdsFsa, word: int) -> list[int]:
    """Take all transitions that a controlword causes without delay; return their numbers."""
    command, taken = fsa.command(word), []
    while (transition := fsa.asked(command)) != NO_TRANSITION:
        fsa.take(transition)
        taken.append(transition)
    return taken


def name_in_canopen(state: PdsState) -> str:
    return state.name.replace("_", " ")


def test_transitions_are_those_of_the_canopen_table():
    """Compare with canopen.profiles.p402, an independent reading: (from, to) -> word."""
    theirs = {
        (start, end): word
        for (start, end), word in State402.TRANSITIONTABLE.items()
        if start not in {"START", "NOT READY TO SWITCH ON", "FAULT REACTION ACTIVE"}
    }
    assert len(theirs) == 13
    for (start, end), word in theirs.items():
        fsa = PdsFsa(next(s for s in S if name_in_canopen(s) == start))
        command = decode_controlword(word, previous=0)
        transition = fsa.asked(command)
        assert transition != NO_TRANSITION, f"{start} -> {end}"
        fsa.take(transition)
        assert name_in_canopen(fsa.state) == end


def test_no_other_transition_exists():
    pairs = {(start, ENDS[number][1]) for (start, _), number in TRANSITIONS.items()}
    theirs = {
        pair for pair in State402.TRANSITIONTABLE if pair[0] not in {"START"} and pair[1] != "FAULT"
    }
    assert {(name_in_canopen(a), name_in_canopen(b)) for a, b in pairs} == {
        pair for pair in theirs if pair[0] != "NOT READY TO SWITCH ON"
    }


def test_every_table_entry_starts_where_its_number_does():
    for (start, _), number in TRANSITIONS.items():
        assert ENDS[number][0] is start
    assert sorted(ENDS) == list(range(17))


@pytest.mark.parametrize(
    ("word", "command"),
    [  # CiA 402-2, command coding: bits 7 3 2 1 0, X = any
        (0x0006, Command.SHUTDOWN),  # 0 X 1 1 0
        (0x000E, Command.SHUTDOWN),
        (0x0007, Command.SWITCH_ON),  # 0 0 1 1 1
        (0x000F, Command.ENABLE_OPERATION),  # 0 1 1 1 1
        (0x0000, Command.DISABLE_VOLTAGE),  # 0 X X 0 X
        (0x000D, Command.DISABLE_VOLTAGE),
        (0x0002, Command.QUICK_STOP),  # 0 X 0 1 X
        (0x000B, Command.QUICK_STOP),
        (0x0080, Command.FAULT_RESET),  # rising edge of 7
        (0x008F, Command.FAULT_RESET),
        (0xFF7F, Command.ENABLE_OPERATION),  # the other bits have no effect
    ],
)
def test_commands_are_coded_as_in_the_standard(word, command):
    assert decode_controlword(word, previous=0) is command


def test_fault_reset_is_an_edge_and_not_a_level():
    fsa = PdsFsa(S.FAULT)
    assert written(fsa, 0x80) == [15]
    fsa.take(13)
    fsa.take(14)
    assert written(fsa, 0x80) == []  # still set: no edge
    assert written(fsa, 0x8F) == []
    assert fsa.state is S.FAULT
    assert written(fsa, 0x00) == []
    assert written(fsa, 0x80) == [15]


def test_word_with_bit_7_set_gives_no_other_command():
    fsa = PdsFsa(S.OPERATION_ENABLED)
    written(fsa, 0x8F)
    assert written(fsa, 0x80) == []  # a running drive is not stopped by it either
    assert fsa.state is S.OPERATION_ENABLED


def test_every_transition_occurs_by_its_command():
    fsa = PdsFsa()
    fsa.take(0)
    fsa.take(1)
    words = [
        (0x06, [2]), (0x00, [7]), (0x06, [2]), (0x02, [7]), (0x06, [2]), (0x07, [3]), (0x06, [6]),
        (0x07, [3]), (0x00, [10]), (0x06, [2]), (0x07, [3]), (0x02, [10]), (0x06, [2]),
        (0x0F, [3, 4]), (0x07, [5]), (0x0F, [4]), (0x06, [8]), (0x0F, [3, 4]), (0x00, [9]),
        (0x06, [2]), (0x0F, [3, 4]), (0x02, [11]), (0x0F, [16]), (0x02, [11]), (0x00, [12]),
    ]  # fmt: skip
    for word, transitions in words:
        assert written(fsa, word) == transitions
    fsa.take(13)
    fsa.take(14)
    assert written(fsa, 0x80) == [15]
    assert all(count > 0 for count in fsa.taken)


def test_fault_is_entered_from_all_except_the_fault_states():
    for state in S:
        fsa = PdsFsa(state)
        if state in {S.FAULT, S.FAULT_REACTION_ACTIVE}:
            with pytest.raises(ValueError, match="transition 13 does not start in FAULT"):
                fsa.take(13)
        else:
            fsa.take(13)
            assert fsa.state is S.FAULT_REACTION_ACTIVE


@pytest.mark.parametrize("state", [S.NOT_READY_TO_SWITCH_ON, S.FAULT_REACTION_ACTIVE])
def test_no_command_leaves_the_transient_states(state):
    for word in range(0x100):
        assert written(PdsFsa(state), word) == []


@given(CONTROLWORDS)
@example([0x06, 0x07, 0x0F, 0x02, 0x0F])  # 2, 3, 4, 11, 16
@example([0x06, 0x0F])  # 2, then 3 and 4 by one word
def test_power_comes_on_only_step_by_step(words):
    """Check for any client: only 4 or 16 enables operation (CiA 402-2)."""
    fsa = PdsFsa()
    for word in words:
        before = fsa.state
        taken = written(fsa, word)
        if fsa.state is S.OPERATION_ENABLED and before is not fsa.state:
            event("enabled")
            assert taken[-1] in {4, 16}
            assert before in {S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.QUICK_STOP_ACTIVE}
            assert word & 0x8F == 0x0F
        if before is S.SWITCH_ON_DISABLED:
            assert taken in ([], [2])
        assert len(taken) <= 2


def test_power_can_come_on():  # a drive that never moves would satisfy the property above
    fsa = PdsFsa()
    for word in (0x06, 0x07, 0x0F):
        written(fsa, word)
    assert fsa.state is S.OPERATION_ENABLED


@given(st.sampled_from(list(S)), st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_every_step_is_one_in_the_standard(state, previous, word):
    fsa = PdsFsa(state)
    fsa.controlword = previous
    at = state
    for number in written(fsa, word):
        start, end = ENDS[number]
        assert start is at
        at = end
    assert at is fsa.state
