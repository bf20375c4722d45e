"""Coverage of a campaign: what its worlds have reached, and what none has."""

from pathlib import Path
from typing import Final, final

from motorhil.emulators.cia402.state_machine import PdsState
from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.config.worlds import UNDECLARED, WEIGHTS, SwarmTable
from motorhil.harness.rig.reading import describe
from motorhil.harness.swarm.plan import Plan
from motorhil.harness.swarm.summary import Summary
from motorhil.harness.swarm.worlds.drawing import possible

_STATES: Final = {str(one.value): one.name.lower().replace("_", " ") for one in PdsState}
"""States of CiA 402, as pairs name them."""


@final
@frozen
class Coverage:
    """Parts of a rig and a program that a campaign has reached, and those that it has not.

    Attributes:
        met: conditions of `sometimes` that some world has met, and in how many.
        unmet: conditions of `sometimes` that no world has met.
        undrawn: kinds of disturbances that are possible on the rig, and no world has.
        unstruck: kinds that worlds have, but that have never struck.
        impossible: kinds that the rig has no place for, or that its `[swarm]` switches off.
        states: states of CiA 402 in which something happened.
        unmet_states: the other ones; empty if no controller has such states.
    """

    met: dict[str, int]
    unmet: tuple[str, ...]
    undrawn: tuple[str, ...]
    unstruck: tuple[str, ...]
    impossible: tuple[str, ...]
    states: tuple[str, ...]
    unmet_states: tuple[str, ...]


def coverage_of(plan: Plan, summary: Summary) -> Coverage:
    """Return the coverage of a campaign; without the rig's file its `[swarm]` is the usual one."""
    can = () if plan.profile is None else possible(plan.profile, _table_of(plan))
    drawn = summary.strikes
    states = {one.removesuffix("m") for one in summary.states}
    return Coverage(
        {name: count for name, count in summary.reached.items() if count},
        tuple(name for name, count in summary.reached.items() if not count),
        tuple(kind for kind in can if kind not in drawn),
        tuple(kind for kind, one in drawn.items() if not one.times),
        tuple(kind for kind in WEIGHTS if kind not in can and kind not in drawn),
        tuple(name for key, name in _STATES.items() if key in states),
        tuple(name for key, name in _STATES.items() if key not in states)
        if states.intersection(_STATES)
        else (),
    )


def _table_of(plan: Plan) -> SwarmTable:
    try:
        return describe(Path(plan.rig)).world.swarm
    except RigError:
        return UNDECLARED
