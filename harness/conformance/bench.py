"""What a clause may use: a small protocol, which a real bench can implement as well as a rig."""

from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from harness.conformance.capability import Ability
from harness.conformance.facts import Facts
from motorapi import Motor
from motorapi.runtime import Runtime


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

    def cut(self, motor: Motor) -> AbstractContextManager[None]:
        """Within it its drive is off the bus, with power (Ability.CUT)."""

    def silence_host(self) -> AbstractContextManager[None]:
        """Within it nothing that the host sends reaches anybody (Ability.SILENCE_HOST)."""

    def lose_answers_of(self, motor: Motor) -> AbstractContextManager[Callable[[], int]]:
        """Within it what its drive answers is lost, what it is told is not (Ability.LOSE).

        Yields:
            How often something was lost so far.
        """

    def afresh(self) -> None:
        """Everything went off and is on again (Ability.AFRESH): `motors` are new ones, unused."""


class Opener(Protocol):
    """What switches a bench on, as often as it is called."""

    def __call__(self) -> AbstractContextManager[RigProtocol]:
        """A bench that is on inside the block."""
