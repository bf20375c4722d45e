"""Mutants: adaptations and drives with one plausible mistake each.

The kit is as good as the mistakes that it finds. Each mutant names the clauses that must kill it.
`make mutants` runs every mutant against every clause and writes the kill table (`KILLS.md`).
The table shows which clause kills a mutant that no other clause kills.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from unittest.mock import patch


@dataclass(frozen=True)
class Mutant:
    """One mistake.

    name: in snake_case, what is wrong.
    mistake: a sentence that describes the mistake.
    kind: the kind of hardware with the mistake.
    plant: a context manager that plants the mistake.
    killers: clauses that must kill it.
    """

    name: str
    mistake: str
    kind: str
    plant: Callable[[], AbstractContextManager]
    killers: tuple[str, ...]


MUTANTS: dict[str, Mutant] = {}


def mutant(kind, *killers):
    """Register a generator function that plants a mistake; its docstring describes it."""

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
    """Replace `owner.name` by `make(the original)` within the block."""
    return patch.object(owner, name, make(getattr(owner, name)))


def motions_changed(motor_class, change):
    """Make `_arm` of this class use `change(motor, motion)` within the block."""

    def wrong(arm):
        def armed(motor, motion, *, together):
            return arm(motor, change(motor, motion), together=together)

        return armed

    return replaced(motor_class, "_arm", wrong)
