"""The job of a worker, and the description of it that the worker returns."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Self, final

from motorhil.frozen import frozen


@final
@frozen
class Job:
    """The adaptation and the rig to test.

    Attributes:
        adaptation: its name, or "package.module:function"; "": the adaptation of the rig's motors.
        rig: the rig file; "": the rig that comes with the adaptation.
        seed: the seed of all random numbers; None: the rig's seed.
        on: the places of the rig's buses, "[BUS=]WHERE"; if empty, they are emulated in virtual
            time.
        controller: the drive of the rig to test, in place of an adaptation; "": none.
    """

    adaptation: str = ""
    rig: str = ""
    seed: int | None = None
    on: tuple[str, ...] = ()
    controller: str = ""

    def packed(self) -> dict[str, Any]:
        """Return the job as JSON values."""
        return asdict(self)

    @classmethod
    def unpacked(cls, values: Mapping[str, Any]) -> Self:
        """Return the job from the values of `packed`."""
        return cls(**{**values, "on": tuple(values["on"])})


@final
@frozen
class Promise:
    """A clause without its check; see `clause.Clause`."""

    id: str
    level: int
    promise: str
    source: str


@final
@frozen
class Loaded:
    """The worker's description of its job after loading.

    Attributes: adaptation (or the drive under test), rig (its file), bench (the rig's name), motors
    (under test), seed, deadline_s (for one clause), home (the folder of the adaptation's code),
    clauses (of the kit), variations (that the rig can have).
    """

    adaptation: str
    rig: str
    bench: str
    motors: tuple[str, ...]
    seed: int
    deadline_s: float
    home: str
    clauses: tuple[Promise, ...]
    variations: tuple[str, ...] = ()
