"""What a supervisor asks its worker to test, and what the worker says there is to test."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self, final


@final
@dataclass(frozen=True, slots=True)
class Job:
    """What to test.

    Attributes:
        adaptation: its name, or "package.module:function"; "": whatever the rig's motors are of.
        rig: the rig file; "": the one that comes with the adaptation.
        seed: of all chance; None: the rig's.
        on: where the rig's buses are, "[BUS=]WHERE"; none: they are emulated, in virtual time.
    """

    adaptation: str = ""
    rig: str = ""
    seed: int | None = None
    on: tuple[str, ...] = ()

    def packed(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return asdict(self)

    @classmethod
    def unpacked(cls, values: Mapping[str, Any]) -> Self:
        """What `packed` gave."""
        return cls(**{**values, "on": tuple(values["on"])})


@final
@dataclass(frozen=True, slots=True)
class Promise:
    """What is to be known of a clause without its check: see `clause.Clause`."""

    id: str
    level: int
    promise: str
    source: str
