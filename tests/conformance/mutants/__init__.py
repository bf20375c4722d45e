"""Adaptations and drives broken on purpose: each is one plausible mistake, planted in ours.

The kit is as good as what it finds out. Each mutant names the clauses that must kill it; `make
mutants` runs every mutant against every clause and writes the kill table (`tests/conformance/
mutants/KILLS.md`), from which it can be seen which clause kills something that no other kills.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from unittest.mock import patch


@dataclass(frozen=True)
class Mutant:
    """One mistake.

    name: in snake_case, what is wrong.
    mistake: one sentence, as its author would tell it afterwards.
    kind: of hardware it is planted in.
    plant: within its block the mistake is there.
    killers: the clauses that must kill it, at least.
    """

    name: str
    mistake: str
    kind: str
    plant: Callable[[], AbstractContextManager]
    killers: tuple[str, ...]


MUTANTS: dict[str, Mutant] = {}


def mutant(kind, *killers):
    """The generator function below plants a mistake; its docstring says which."""

    def register(function):
        assert function.__name__ not in MUTANTS, function.__name__
        MUTANTS[function.__name__] = Mutant(
            function.__name__,
            " ".join(function.__doc__.split()),
            kind,
            contextmanager(function),
            killers,
        )
        return function

    return register


def replaced(owner, name, make):
    """`owner.name` is `make(the original)` inside the block."""
    return patch.object(owner, name, make(getattr(owner, name)))


def motions_changed(motor_class, change):
    """Inside the block `_arm` of this class gets `change(motor, motion)`."""

    def wrong(arm):
        def armed(motor, motion, *, together):
            return arm(motor, change(motor, motion), together=together)

        return armed

    return replaced(motor_class, "_arm", wrong)
