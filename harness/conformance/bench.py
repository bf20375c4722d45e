"""What a clause may use: a small protocol, which a real bench can implement as well as a rig."""

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from harness.conformance.capability import Ability
from harness.conformance.facts import Facts
from motorapi import Motor
from motorapi.runtime import Runtime

Lost = Callable[[], int]
"""How often something was lost so far: a fault that hit nothing has tested nothing."""


class RigProtocol(Protocol):
    """One bench, switched on, its motors new and not yet used.

    What needs an `Ability` may be called by clauses that name it only. Time passes by waiting in
    `runtime`, and in no other way. U is the unit of the motors' position, rad or m.
    """

    @property
    def facts(self) -> Facts:
        """What was declared of the bench and its motors: distances, tolerances, bounds."""

    @property
    def abilities(self) -> Collection[Ability]:
        """What the bench can do."""

    @property
    def runtime(self) -> Runtime:
        """Where a clause waits."""

    @property
    def seed(self) -> int:
        """Of all chance."""

    @property
    def motor(self) -> Motor:
        """The motor under test."""

    @property
    def motors(self) -> Sequence[Motor]:
        """All motors under test, of which a group can be made; `motor` is the first."""

    def another_user_of(self, motor: Motor) -> Motor:
        """Another logical motor on the same physical motor (Ability.SEVERAL_USERS)."""

    def true_position(self, motor: Motor) -> float:
        """Where it really is now [U]: by Ability.TRUTH, not asked of the adaptation."""

    def load(self, motor: Motor, torque_n_m: float) -> None:
        """This torque [N·m] (a linear motor: force [N]) acts on it from now on (Ability.LOAD).

        At its output; positive turns it towards negative positions.
        """

    def fail(self, motor: Motor) -> int:
        """Its drive has a fault of this code, the cause is gone in a moment (Ability.FAULT)."""

    def cut(self, motor: Motor) -> AbstractContextManager[Lost]:
        """Within it its drive is off the bus, with power (Ability.CUT)."""

    def silence_host(
        self, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Within it nothing that the host sends reaches anybody (Ability.SILENCE_HOST).

        `skip` frames are spared first, and no more than `limit` are lost, as in `lose_answers_of`.
        """

    def lose_answers_of(
        self, motor: Motor, *, skip: int = 0, limit: int | None = None
    ) -> AbstractContextManager[Lost]:
        """Within it what its drive answers is lost, what it is told is not (Ability.LOSE)."""

    def strike(
        self, motor: Motor | None, times: int, *, skip: int = 0
    ) -> AbstractContextManager[Lost]:
        """Within it so many attempts to send, of its drive or (None) the host, are destroyed.

        By bit errors, one attempt after another (Ability.BUS_ERRORS): 16 make a CAN controller
        error passive, 32 put it off the bus, on which it is again by itself a moment later. `skip`
        frames are spared first; where none is, the host has one to send.
        """

    def noise(self, bit_error_rate: float) -> AbstractContextManager[Lost]:
        """Within it so many of the bits on the bus are wrong (Ability.BUS_ERRORS)."""

    def stop_sync(self) -> AbstractContextManager[Lost]:
        """Within it the signal that streamed motions go by reaches nobody (Ability.STOP_SYNC)."""

    def restart(self, motor: Motor) -> None:
        """Its drive begins anew, as after a power failure (Ability.RESTART)."""

    def commands_to(self, motor: Motor) -> AbstractContextManager[Sequence[str]]:
        """What hosts send to its drive, that may move or change it (Ability.TRAFFIC)."""

    def afresh(self) -> None:
        """Everything went off and is on again (Ability.AFRESH): `motors` are new ones, unused."""


class Opener(Protocol):
    """What switches a bench on, as often as it is called."""

    def __call__(self) -> AbstractContextManager[RigProtocol]:
        """A bench that is on inside the block."""
