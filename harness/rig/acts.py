"""Acts on an open rig at given times of it: stimuli, and faults by hand.

The rig file and the live page use the same acts, so that a recorded act repeats exactly.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import final

from motorhil.emulators.controller import Controller
from motorhil.emulators.simulation.event_queue import Action
from motorhil.emulators.simulation.world import World
from motorhil.harness.rig.config.faults import FaultDescription
from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
from motorhil.harness.rig.config.stimuli import StimulusDescription
from motorhil.harness.rig.faults import RigFaults


@final
class Acts:
    """The acts of one rig."""

    def __init__(
        self,
        description: RigDescription,
        world: World,
        faults: RigFaults,
        build: Callable[[ControllerDescription], Controller],
    ) -> None:
        """Act on a world; `build` makes twins of controllers, which check stimuli in advance."""
        self._description = description
        self._world = world
        self._faults = faults
        self._build = build
        self._twins: dict[str, Controller] = {}

    def schedule(self) -> None:
        """Schedule every stimulus and every fault by hand of the rig file.

        Raises:
            RigError: a stimulus does not exist, or cannot have this value.
        """
        for stimulus in self._description.stimuli:
            try:
                self.check(stimulus)
            except ValueError as error:
                at, what = stimulus.path, str(error)
                raise self._description.error(at, what, "write another one") from None
            self.at(stimulus.at_ns, self.stimulation(stimulus))
        for fault in self._description.faults:
            if fault.by_hand:
                begin, end = self.injection(fault)
                self.at(fault.rule.from_ns, begin)
                if fault.rule.until_ns is not None:
                    self.at(fault.rule.until_ns, end)

    def twin(self, name: str) -> Controller:
        """Return a new controller like the one of this name, switched on at time 0."""
        twin = self._build(self._description.controllers[name])
        twin.start(0)
        return twin

    def check(self, stimulus: StimulusDescription) -> None:
        """Apply the stimulus to the controller's twin.

        Raises:
            ValueError: the stimulus does not exist, or cannot have this value.
        """
        name = stimulus.controller
        if name not in self._twins:
            self._twins[name] = self.twin(name)
        self._twins[name].stimulate(stimulus.name, stimulus.value, 0)

    def stimulation(self, one: StimulusDescription) -> Action:
        """Return the action that applies a stimulus."""
        return lambda now_ns: self._world.stimulate(one.controller, one.name, one.value)

    def injection(self, fault: FaultDescription) -> tuple[Action, Action]:
        """Return the actions that begin and end a fault by hand.

        The bus learns of the rule only when it begins, and does not know when it ends.
        """
        rule = replace(fault.rule, until_ns=None)
        return (
            lambda now_ns: self._faults.inject(fault.bus, rule),
            lambda now_ns: self._faults.lift(fault.bus, rule.name),
        )

    def at(self, time_ns: int, action: Action) -> None:
        """Call an action at a time of the rig."""
        self._world.queue.alarm(action).set(time_ns)
