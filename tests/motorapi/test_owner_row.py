"""The row of those who wait for a motor, while threads come and go in between any two looks."""

from types import SimpleNamespace

from motorapi.claim import Asked
from motorapi.owner_row import OwnerRow, Teller
from motorapi.ownership_events import LockAction

OWNER = SimpleNamespace(name="a", runtime=SimpleNamespace(now_ns=lambda: 0))
SOMEBODY = SimpleNamespace(left_s=None)


class Passing:
    """Somebody had the motor at the first look and has given it back before the second."""

    def __init__(self):
        self.looks = [SOMEBODY]

    @property
    def held(self):
        return self.looks.pop() if self.looks else None

    def replace(self, held, asked, token):
        return SimpleNamespace(token=token)

    def end_run(self, asked):
        return False


def test_who_asks_at_once_has_it_when_it_came_free_while_he_was_told_no():
    row = OwnerRow(Passing(), Teller())
    claim, action, before = row.take(Asked(OWNER, "a", "start", None))
    assert (claim.token, action, before) == (1, LockAction.TAKEN, "")
