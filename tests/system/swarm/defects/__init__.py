"""Defects that no undisturbed run shows, each in an application that is correct otherwise.

An application is a class with one method for each decision. A defect overrides one of them, or
patches an adaptation around the run. A swarm calls each as a function with the open rig.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Defect:
    """One defect.

    name: of the function, in its module.
    target: "module:function", as `motorhil swarm` takes it.
    rig: the rig file.
    mistake: a sentence that describes it.
    causes: what a failure's cause may begin with: oracle and rule.
    base: name of the correct application; of a correct one, its own.
    """

    name: str
    target: str
    rig: Path
    mistake: str
    causes: tuple[str, ...]
    base: str = ""


DEFECTS: dict[str, Defect] = {}
CORRECT: dict[str, Defect] = {}


def correct(rig):
    """Register a class as a correct application; return the function that runs it."""

    def register(application):
        name = application.__name__.lower()
        CORRECT[name] = _described(application, name, rig, ())
        return _function(application, nullcontext)

    return register


def defect(rig, *causes, patches: Callable[[], AbstractContextManager] = nullcontext):
    """Register a class as a defect that fails for one of these causes; return its function."""

    def register(application):
        function = _function(application, patches)
        name = function.__name__
        assert name not in DEFECTS, name
        DEFECTS[name] = _described(application, name, rig, causes)
        return function

    return register


def _described(application, name, rig, causes):
    mistake = " ".join(application.__doc__.split())
    base = application.__mro__[-2].__name__.lower()
    return Defect(name, f"{application.__module__}:{name}", HERE / rig, mistake, causes, base)


def _function(application, patches):
    def run(rig):
        with patches():
            application(rig).run()

    run.application = application
    run.__name__ = application.__name__
    return run
