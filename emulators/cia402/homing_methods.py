"""The homing methods of CiA 402-2 as one table.

Every method ends by passing an edge of one switch in one direction, where the switch changes from
`before` to the other state. Home is that edge, or the first index pulse after it in the same
direction. `search` is the direction of the search if the switch is not active at the start. Methods
7 to 14 and 23 to 30 can meet a limit switch first, and reverse there; their home switch is a cam in
the middle. In 3 to 6 and 19 to 22 the home switch extends to the end of travel. 15, 16, 31 and 32
are reserved; 36 and the negative ones are not emulated. 35 is obsolete and replaced by 37.
"""

from typing import Final, final

from emulators.firmware.digital_inputs import HOME_SWITCH, NEGATIVE_LIMIT, POSITIVE_LIMIT

_LEFT: Final = -1
_RIGHT: Final = 1
_ON: Final = True
_OFF: Final = False


@final
class HomingMethod:
    """One row of the table.

    Attributes:
        switch: bit of the switch in 60FDh; 0: none.
        direction: direction in which home is passed, +1 or -1; 0: home is the present position.
        before: state of the switch before that edge.
        search: the first direction, if the switch is not active at the start.
        turns: True if the drive reverses at the limit switch in that direction.
        index: True if home is the first index pulse after the edge, not the edge.
    """

    def __init__(
        self, switch: int, direction: int, before: bool, search: int, turns: bool, index: bool
    ) -> None:
        self.switch = switch
        self.direction = direction
        self.before = before
        self.search = search
        self.turns = turns
        self.index = index


# Methods 1 to 14; 17 to 30 are the same without the index pulse.
_BY_EDGE: Final = (
    (NEGATIVE_LIMIT, _RIGHT, _ON, _LEFT, False),  # 1, 17
    (POSITIVE_LIMIT, _LEFT, _ON, _RIGHT, False),  # 2, 18
    (HOME_SWITCH, _LEFT, _ON, _RIGHT, False),  # 3, 19: positive home switch
    (HOME_SWITCH, _RIGHT, _OFF, _RIGHT, False),  # 4, 20
    (HOME_SWITCH, _RIGHT, _ON, _LEFT, False),  # 5, 21: negative home switch
    (HOME_SWITCH, _LEFT, _OFF, _LEFT, False),  # 6, 22
    (HOME_SWITCH, _LEFT, _ON, _RIGHT, True),  # 7, 23: left edge, from inside
    (HOME_SWITCH, _RIGHT, _OFF, _RIGHT, True),  # 8, 24: left edge, from outside
    (HOME_SWITCH, _LEFT, _OFF, _RIGHT, True),  # 9, 25: right edge, from outside
    (HOME_SWITCH, _RIGHT, _ON, _RIGHT, True),  # 10, 26: right edge, from inside
    (HOME_SWITCH, _RIGHT, _ON, _LEFT, True),  # 11, 27: the same four, starting to the left
    (HOME_SWITCH, _LEFT, _OFF, _LEFT, True),  # 12, 28
    (HOME_SWITCH, _RIGHT, _OFF, _LEFT, True),  # 13, 29
    (HOME_SWITCH, _LEFT, _ON, _LEFT, True),  # 14, 30
)


def _table() -> dict[int, HomingMethod]:
    table: dict[int, HomingMethod] = {}
    for first, index in ((1, True), (17, False)):
        for number, (switch, direction, before, search, turns) in enumerate(_BY_EDGE, first):
            table[number] = HomingMethod(switch, direction, before, search, turns, index)
    table[33] = HomingMethod(0, _LEFT, _OFF, _LEFT, False, True)
    table[34] = HomingMethod(0, _RIGHT, _OFF, _RIGHT, False, True)
    for number in (35, 37):
        table[number] = HomingMethod(0, 0, _OFF, 0, False, False)
    return table


HOMING_METHODS: Final[dict[int, HomingMethod]] = _table()
