"""Jobs for workers, and the promises that workers report."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self, final


@final
@dataclass(frozen=True, slots=True)
class Job:
    """The adaptation and the rig to test.

    Attributes:
        adaptation: its name, or "package.module:function"; "": the adaptation of the rig's motors.
        rig: the rig file; "": the rig that comes with the adaptation.
        seed: the seed of all random numbers; None: the rig's seed.
        on: the places of the rig's buses, "[BUS=]WHERE"; if empty, they are emulated in virtual
            time.
    """

    adaptation: str = ""
    rig: str = ""
    seed: int | None = None
    on: tuple[str, ...] = ()

    def packed(self) -> dict[str, Any]:
        """Return the job as JSON values."""
        return asdict(self)

    @classmethod
    def unpacked(cls, values: Mapping[str, Any]) -> Self:
        """Return the job from the values of `packed`."""
        return cls(**{**values, "on": tuple(values["on"])})


@final
@dataclass(frozen=True, slots=True)
class Promise:
    """A clause without its check; see `clause.Clause`."""

    id: str
    level: int
    promise: str
    source: str
