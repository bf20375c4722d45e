"""CiA 402-2's power drive system as its state table defines it, checkable over a bus.

Written from the standard (statusword coding, controlword coding, transition table, option codes),
as also printed in Kollmorgen's, Maxon's and Nanotec's manuals. Nothing is taken from the emulator,
so that the check is independent.
"""

from collections.abc import Iterable
from enum import Enum
from typing import Final


class State(Enum):
    """The eight states, by their statusword: mask and value."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)


class By(Enum):
    """The cause of a transition: a command of the controlword, or another event."""

    RESET = "power-on or reset"
    ITSELF = "by itself"
    FAULT = "a fault"
    SHUTDOWN = "shutdown"
    SWITCH_ON = "switch on, or disable operation"
    ENABLE = "enable operation"
    DISABLE_VOLTAGE = "disable voltage"
    QUICK_STOP = "quick stop"
    FAULT_RESET = "fault reset"


S = State
FAULTY: Final = (S.FAULT_REACTION_ACTIVE, S.FAULT)
HEALTHY: Final = tuple(state for state in S if state not in FAULTY)
POWERED: Final = (S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE, S.FAULT_REACTION_ACTIVE)
"""States in which the motor may have current: "drive function enabled" in the standard's table."""

# number: (from, to, by any of these). 3 by "enable operation" continues with 4.
TABLE: Final[dict[int, tuple[tuple[State, ...], State, tuple[By, ...]]]] = {
    0: (tuple(S), S.NOT_READY_TO_SWITCH_ON, (By.RESET,)),
    1: ((S.NOT_READY_TO_SWITCH_ON,), S.SWITCH_ON_DISABLED, (By.ITSELF,)),
    2: ((S.SWITCH_ON_DISABLED,), S.READY_TO_SWITCH_ON, (By.SHUTDOWN,)),
    3: ((S.READY_TO_SWITCH_ON,), S.SWITCHED_ON, (By.SWITCH_ON, By.ENABLE)),
    4: ((S.SWITCHED_ON,), S.OPERATION_ENABLED, (By.ENABLE,)),
    5: ((S.OPERATION_ENABLED,), S.SWITCHED_ON, (By.SWITCH_ON,)),
    6: ((S.SWITCHED_ON,), S.READY_TO_SWITCH_ON, (By.SHUTDOWN,)),
    7: ((S.READY_TO_SWITCH_ON,), S.SWITCH_ON_DISABLED, (By.QUICK_STOP, By.DISABLE_VOLTAGE)),
    8: ((S.OPERATION_ENABLED,), S.READY_TO_SWITCH_ON, (By.SHUTDOWN,)),
    9: ((S.OPERATION_ENABLED,), S.SWITCH_ON_DISABLED, (By.DISABLE_VOLTAGE,)),
    10: ((S.SWITCHED_ON,), S.SWITCH_ON_DISABLED, (By.QUICK_STOP, By.DISABLE_VOLTAGE)),
    11: ((S.OPERATION_ENABLED,), S.QUICK_STOP_ACTIVE, (By.QUICK_STOP,)),
    12: ((S.QUICK_STOP_ACTIVE,), S.SWITCH_ON_DISABLED, (By.DISABLE_VOLTAGE, By.ITSELF)),
    13: (HEALTHY, S.FAULT_REACTION_ACTIVE, (By.FAULT,)),
    14: ((S.FAULT_REACTION_ACTIVE,), S.FAULT, (By.ITSELF,)),
    15: ((S.FAULT,), S.SWITCH_ON_DISABLED, (By.FAULT_RESET,)),
    16: ((S.QUICK_STOP_ACTIVE,), S.OPERATION_ENABLED, (By.ENABLE,)),
}

# Commands that a drive obeys immediately. The others may take time (power stage, ramps) or
# wait for a condition (a fault's cause, the supply).
AT_ONCE: Final = {
    (S.SWITCH_ON_DISABLED, By.SHUTDOWN),
    (S.READY_TO_SWITCH_ON, By.DISABLE_VOLTAGE),
    (S.READY_TO_SWITCH_ON, By.QUICK_STOP),
    (S.SWITCHED_ON, By.SHUTDOWN),
    (S.SWITCHED_ON, By.DISABLE_VOLTAGE),
    (S.SWITCHED_ON, By.QUICK_STOP),
    (S.OPERATION_ENABLED, By.DISABLE_VOLTAGE),
    (S.OPERATION_ENABLED, By.QUICK_STOP),
    (S.QUICK_STOP_ACTIVE, By.DISABLE_VOLTAGE),
}


def state_of(statusword: int) -> State:
    """Return the one state that the word shows.

    Raises:
      AssertionError: it shows none of the eight.
    """
    found = [state for state in S if statusword & state.value[0] == state.value[1]]
    assert len(found) == 1, f"statusword {statusword:04X}h shows {found or 'no state'}"
    return found[0]


def command_in(word: int) -> By | None:
    """Return the command in a controlword, except fault reset, which is an edge of bit 7."""
    if word & 0x80:
        return None
    if not word & 0x02:
        return By.DISABLE_VOLTAGE
    if not word & 0x04:
        return By.QUICK_STOP
    if not word & 0x01:
        return By.SHUTDOWN
    return By.ENABLE if word & 0x08 else By.SWITCH_ON


def commands_of(before: int, words: Iterable[int]) -> list[By]:
    """Return the commands in consecutive controlwords that follow the word `before`."""
    found: list[By] = []
    for word in words:
        command = By.FAULT_RESET if word & ~before & 0x80 else command_in(word)
        if command is not None:
            found.append(command)
        before = word
    return found


def path(start: State, end: State, causes: Iterable[By], quick_stop_option: int) -> list[int]:
    """Return the shortest sequence of transitions between the states that these causes allow.

    Raises:
      AssertionError: the standard has no such sequence.
    """
    allowed = set(causes)
    ways: dict[State, list[int]] = {start: []}
    fringe = [start]
    while fringe and end not in ways:
        state = fringe.pop(0)
        for number, (sources, target, by) in TABLE.items():
            if state not in sources or target in ways or allowed.isdisjoint(by):
                continue
            if number == 16 and quick_stop_option not in (5, 6, 7, 8):
                continue
            if number == 12 and By.DISABLE_VOLTAGE not in allowed and quick_stop_option > 4:
                continue
            ways[target] = [*ways[state], number]
            fringe.append(target)
    told = sorted(cause.value for cause in allowed)
    assert end in ways, (
        f"{start.name} -> {end.name} by {told}, 605Ah {quick_stop_option}: forbidden"
    )
    return ways[end]
