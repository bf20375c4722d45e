"""`[[stimulus]]` tables of a rig: timed physical inputs of controllers."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import Table
from motorhil.settings import REQUIRED, KeyPath, number, text

if TYPE_CHECKING:
    pass


@final
@frozen(kw_only=True, slots=False)
class StimulusTable:
    """A physical input of a controller, and when it changes."""

    controller: str = text(REQUIRED, "The controller.")
    name: str = text(
        REQUIRED, "The input; a wrong one is answered with the known ones.", example='"sto"'
    )
    value: float = number(REQUIRED, -1e12, 1e12, "", "Its value from then on.", example="1")
    at_s: float = number(
        REQUIRED,
        0.0,
        1e9,
        "s",
        "When, in the rig's time.",
        example="1.5",
        plausible=(1e-6, 86_400.0),
    )


@final
@frozen
class StimulusDescription:
    """A value of the controller's physical input `name` from `at_ns` on.

    `path` leads to its table in the rig file.
    """

    controller: str
    name: str
    value: float
    at_ns: int
    path: KeyPath


def read_stimuli(root: Table, controllers: Sequence[str]) -> tuple[StimulusDescription, ...]:
    """Return the stimuli of a rig, in the order of the file.

    Raises:
        RigError: the first error in them, except errors that only the controller can detect.
    """
    return tuple(_stimulus(table, controllers) for table in root.listed_tables("stimulus"))


def _stimulus(table: Table, controllers: Sequence[str]) -> StimulusDescription:
    own = table.read(StimulusTable)
    table.require("controller", own.controller, controllers)
    at_ns = round(own.at_s * 1e9)
    return StimulusDescription(own.controller, own.name, own.value, at_ns, table.path)
