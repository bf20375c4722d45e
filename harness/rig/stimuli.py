"""Stimuli of an open rig, scheduled in its time."""

from collections.abc import Callable
from typing import final

from motorhil.emulators.controller import Controller
from motorhil.emulators.simulation.world import World
from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
from motorhil.harness.rig.config.stimuli import StimulusDescription


@final
class _Occurrence:
    """One scheduled stimulus."""

    def __init__(self, world: World, stimulus: StimulusDescription) -> None:
        self._world = world
        self._stimulus = stimulus

    def happen(self, now_ns: int) -> None:
        """Apply the stimulus."""
        one = self._stimulus
        self._world.stimulate(one.controller, one.name, one.value)


def schedule(
    description: RigDescription,
    world: World,
    build: Callable[[ControllerDescription], Controller],
) -> None:
    """Schedule every stimulus.

    A twin of each controller, built for this purpose only, checks them in advance.

    Raises:
        RigError: the stimulus does not exist, or cannot have this value.
    """
    twins: dict[str, Controller] = {}
    for stimulus in description.stimuli:
        name = stimulus.controller
        if name not in twins:
            twins[name] = build(description.controllers[name])
            twins[name].start(0)
        try:
            twins[name].stimulate(stimulus.name, stimulus.value, 0)
        except ValueError as error:
            raise description.error(stimulus.path, str(error), "write another one") from None
        world.queue.alarm(_Occurrence(world, stimulus).happen).set(stimulus.at_ns)
