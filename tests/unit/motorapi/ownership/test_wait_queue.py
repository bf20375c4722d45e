"""The wait queue for a motor, while threads come and go between any two checks."""

from types import SimpleNamespace

from motorhil.motorapi.ownership.claim import LockAction, OwnershipRequest
from motorhil.motorapi.ownership.ownership import OwnershipNotifier, WaitQueue

OWNER = SimpleNamespace(name="a", runtime=SimpleNamespace(now_ns=lambda: 0))
SOMEBODY = SimpleNamespace(left_s=None)


class Passing:
    """An owner at the first check that has released the motor before the second."""

    def __init__(self):
        self.looks = [SOMEBODY]

    @property
    def held(self):
        return self.looks.pop() if self.looks else None

    def replace(self, held, asked, token):
        return SimpleNamespace(token=token)

    def end_run(self, asked):
        return False


def test_request_without_timeout_takes_a_motor_just_released():
    row = WaitQueue(Passing(), OwnershipNotifier())
    claim, action, before = row.take(OwnershipRequest(OWNER, "a", "start", None))
    assert (claim.token, action, before) == (1, LockAction.TAKEN, "")
