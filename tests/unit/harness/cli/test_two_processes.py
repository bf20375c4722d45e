"""Attribution of a shared motor's commands to owners, from a record."""

import pytest

from motorhil.harness.cli.demo_two_processes import commands_by_tenure
from motorhil.traces.schema import LockAction
from motorhil.traces.semantics.ownership import LockEvent, ownership_of

TAKEN = LockEvent("pan", 10, LockAction.TAKEN, "mast", token=1, pid=4, sender="mast[4]")
BROKEN = LockEvent("pan", 20, LockAction.BROKEN, "driving", token=2, pid=5, sender="driving[5]")
RELEASED = LockEvent("pan", 19, LockAction.RELEASED, "mast", token=1, pid=4, sender="mast[4]")


def table(events, sent):
    commands = commands_by_tenure(ownership_of(events), sent)
    return {
        (owner and owner.owner, is_owners): count
        for (owner, is_owners), count in commands.items()
        if count
    }


@pytest.mark.parametrize(
    ("events", "sent", "counted"),
    [
        (
            [TAKEN, BROKEN],
            [(12, "mast[4]", False), (21, "mast[4]", False), (22, "driving[5]", False)],
            {("mast", True): 2, ("driving", True): 1},
        ),
        (
            [TAKEN, BROKEN],
            [(21, "driving[5]", False), (22, "mast[4]", False)],
            {("driving", True): 1, ("driving", False): 1},
        ),
        (
            [TAKEN, BROKEN],
            [(21, "host", False), (22, "driving[5]", False)],
            {("driving", True): 1, ("driving", False): 1},
        ),
        ([TAKEN, RELEASED, BROKEN], [(21, "mast[4]", False)], {("driving", False): 1}),
        ([TAKEN, BROKEN], [(9, "mast[4]", False)], {(None, False): 1}),
        ([TAKEN, BROKEN], [(12, "mast[4]", False), (19, "driving[5]", True)], {("mast", True): 1}),
        ([TAKEN, BROKEN], [(19, "driving[5]", False)], {("mast", False): 1}),
        ([TAKEN, BROKEN], [(21, "host", True)], {("driving", False): 1}),
    ],
    ids=[
        "in its controller yet",
        "after its heir's",
        "a stranger's",
        "given back",
        "nobody's",
        "a guard's halt",
        "a motion before its owner's end",
        "a stranger's halt",
    ],
)
def test_dead_owners_frames_are_its_own_until_the_next_commands(events, sent, counted):
    assert table(events, sent) == counted
