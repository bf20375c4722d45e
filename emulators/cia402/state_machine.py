"""State machine (PDS FSA) and statusword of CiA 402-2.

Everything that changes the state is in this file, and only `PdsFsa.take` writes it. The file knows
nothing of time, motion or option codes. It returns the transition that a
controlword requests. The drive decides when its preconditions are met (the power stage is ready,
the motor is at rest), and then calls `take`.

Transitions have the standard's numbers. 2 to 12, 15 and 16 are requested by a controlword. 0, 1, 13
and 14 are automatic (power on, initialised, fault, fault reaction finished).

::

    power on -0-> NOT READY TO SWITCH ON -1-> SWITCH ON DISABLED <--15-- FAULT <-14- FAULT REACTION
                                                  | 2    ^ 7                          ACTIVE
                                                  v      |                              ^ 13
                                           READY TO SWITCH ON                     (any other state)
                                                  | 3    ^ 6   10 from SWITCHED ON,
                                                  v      |     9 from OPERATION ENABLED,
                                              SWITCHED ON      12 from QUICK STOP ACTIVE
                                                  | 4    ^ 5        to SWITCH ON DISABLED
                                                  v      |
                                          OPERATION ENABLED --11--> QUICK STOP ACTIVE
                                                  |8                       |
                                                  v to READY ...           +--16--> OPERATION
                                                                                    ENABLED
"""

from enum import IntEnum
from typing import Final, final

NO_TRANSITION: Final = -1

# Controlword bits (CiA 402-2, object 6040h); 4 to 6 and 9 depend on the mode.
CW_SWITCH_ON: Final = 0x0001
CW_ENABLE_VOLTAGE: Final = 0x0002
CW_QUICK_STOP: Final = 0x0004  # 0 requests a quick stop
CW_ENABLE_OPERATION: Final = 0x0008
CW_FAULT_RESET: Final = 0x0080
CW_HALT: Final = 0x0100
_COMMAND_BITS: Final = 0x008F
_ENABLED: Final = 0x000F  # the level of these bits that enables operation, and keeps it enabled

VOLTAGE_ENABLED: Final = 0x0010
WARNING: Final = 0x0080
REMOTE: Final = 0x0200  # the controlword is obeyed
TARGET_REACHED: Final = 0x0400
INTERNAL_LIMIT_ACTIVE: Final = 0x0800
MODE_BIT_12: Final = 0x1000
MODE_BIT_13: Final = 0x2000
MODE_BITS: Final = TARGET_REACHED | MODE_BIT_12 | MODE_BIT_13

# pp
SET_POINT_ACKNOWLEDGE: Final = MODE_BIT_12
FOLLOWING_ERROR: Final = MODE_BIT_13
# pv
SPEED_IS_ZERO: Final = MODE_BIT_12
MAX_SLIPPAGE_ERROR: Final = MODE_BIT_13
# hm
HOMING_ATTAINED: Final = MODE_BIT_12
HOMING_ERROR: Final = MODE_BIT_13
# ip
IP_ACTIVE: Final = MODE_BIT_12
# csp, csv, cst
FOLLOWS_COMMAND: Final = MODE_BIT_12

# Bits 0 to 3, 5 and 6, in the order of PdsState's numbers. CiA 402-2, table of state coding; bit 5
# is 0 where the standard leaves it open.
STATE_BITS: Final[tuple[int, ...]] = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)


@final
class PdsState(IntEnum):
    """The eight states; their numbers are ours (they appear in records)."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7


@final
class Command(IntEnum):
    """Commands of a controlword. "Switch on" and "disable operation" are one bit pattern."""

    DISABLE_VOLTAGE = 0
    QUICK_STOP = 1
    SHUTDOWN = 2
    SWITCH_ON = 3
    ENABLE_OPERATION = 4
    FAULT_RESET = 5


_S = PdsState
_C = Command

# CiA 402-2, PDS FSA: the transitions that a controlword can cause in each state, with their
# numbers. Transition 16 also requires quick stop option codes 5 to 8; the drive checks that.
TRANSITIONS: Final[dict[tuple[PdsState, Command], int]] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): 2,
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): 3,
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): 3,  # then 4 automatically
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): 4,
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): 5,  # "disable operation"
    (_S.SWITCHED_ON, _C.SHUTDOWN): 6,
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): 7,
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): 7,
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): 8,
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): 9,
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): 10,
    (_S.SWITCHED_ON, _C.QUICK_STOP): 10,
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): 11,
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): 12,
    (_S.FAULT, _C.FAULT_RESET): 15,
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): 16,
}

# Transition number -> (from, to); 13 can start anywhere but in the two fault states.
ENDS: Final[dict[int, tuple[PdsState | None, PdsState]]] = {
    0: (None, _S.NOT_READY_TO_SWITCH_ON),
    1: (_S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED),
    2: (_S.SWITCH_ON_DISABLED, _S.READY_TO_SWITCH_ON),
    3: (_S.READY_TO_SWITCH_ON, _S.SWITCHED_ON),
    4: (_S.SWITCHED_ON, _S.OPERATION_ENABLED),
    5: (_S.OPERATION_ENABLED, _S.SWITCHED_ON),
    6: (_S.SWITCHED_ON, _S.READY_TO_SWITCH_ON),
    7: (_S.READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED),
    8: (_S.OPERATION_ENABLED, _S.READY_TO_SWITCH_ON),
    9: (_S.OPERATION_ENABLED, _S.SWITCH_ON_DISABLED),
    10: (_S.SWITCHED_ON, _S.SWITCH_ON_DISABLED),
    11: (_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE),
    12: (_S.QUICK_STOP_ACTIVE, _S.SWITCH_ON_DISABLED),
    13: (None, _S.FAULT_REACTION_ACTIVE),
    14: (_S.FAULT_REACTION_ACTIVE, _S.FAULT),
    15: (_S.FAULT, _S.SWITCH_ON_DISABLED),
    16: (_S.QUICK_STOP_ACTIVE, _S.OPERATION_ENABLED),
}


def decode_controlword(word: int, previous: int) -> Command | None:
    """Decode the command in a controlword (6040h) after the previous word; None if none."""
    if word & CW_FAULT_RESET:
        # An edge, not a level: while the bit stays set, the word contains no command.
        return None if previous & CW_FAULT_RESET else Command.FAULT_RESET
    if not word & CW_ENABLE_VOLTAGE:
        return Command.DISABLE_VOLTAGE
    if not word & CW_QUICK_STOP:
        return Command.QUICK_STOP
    if not word & CW_SWITCH_ON:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if word & CW_ENABLE_OPERATION else Command.SWITCH_ON


@final
class PdsFsa:
    """The state of one power drive system, and a count of each transition."""

    def __init__(self, state: PdsState = PdsState.SWITCH_ON_DISABLED) -> None:
        self.state: PdsState = state
        self.controlword: int = 0
        self.taken: list[int] = [0] * len(ENDS)

    def command(self, word: int) -> Command | None:
        """Return the command of this controlword after the previous one, and store the word."""
        command = decode_controlword(word, self.controlword)
        self.controlword = word
        return command

    def holds(self, word: int) -> bool:
        """Return True if the drive is enabled and this word just keeps it enabled."""
        if word != self.controlword or word & _COMMAND_BITS != _ENABLED:
            return False
        return self.state is PdsState.OPERATION_ENABLED

    def asked(self, command: Command | None) -> int:
        """Return the transition that `command` requests in this state, or NO_TRANSITION."""
        if command is None:
            return NO_TRANSITION
        return TRANSITIONS.get((self.state, command), NO_TRANSITION)

    def take(self, transition: int) -> None:
        """Take a transition. Only this method writes the state.

        Raises:
            ValueError: the transition does not start in this state.
        """
        start, end = ENDS[transition]
        if start is None:
            allowed = transition == 0 or self.state < PdsState.FAULT_REACTION_ACTIVE
        else:
            allowed = self.state is start
        if not allowed:
            raise ValueError(f"transition {transition} does not start in {self.state.name}")
        self.state = end
        self.taken[transition] += 1


def compose(
    state: PdsState, mode_bits: int, voltage: bool, remote: bool, limit: bool, warning: bool
) -> int:
    """Return the statusword (unsigned 16 bit) of `state`; `mode_bits` within MODE_BITS."""
    word = STATE_BITS[state] | mode_bits
    if voltage:
        word |= VOLTAGE_ENABLED
    if remote:
        word |= REMOTE
    if limit:
        word |= INTERNAL_LIMIT_ACTIVE
    if warning:
        word |= WARNING
    return word
