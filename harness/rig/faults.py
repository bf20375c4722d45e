"""Faults of an open rig, to inject and to query."""

from typing import final

from motorhil.emulators.can.error_confinement import ErrorState
from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.emulators.media.serial_faults import SerialFaultPlan, SerialFaultRule
from motorhil.emulators.simulation.world import World
from motorhil.frozen import frozen


@final
@frozen
class NodeState:
    """The state of a node of a CAN bus.

    Attributes:
        state: error active, above the warning limit, error passive, or bus-off.
        tec, rec: its error counters.
        errors: number of errors that it has detected.
        aborted: number of its frames abandoned because of bus-off or one-shot mode.
    """

    state: ErrorState
    tec: int
    rec: int
    errors: int
    aborted: int


@final
class RigFaults:
    """The faults of an open rig, to inject and to query."""

    def __init__(self, world: World) -> None:
        self._world = world

    def inject(self, bus: str, rule: FaultRule | SerialFaultRule) -> None:
        """Apply the rule to the bus or line from now on.

        Raises:
            ValueError: the bus does not exist, it has had a rule of that name, or the rule is for
                another
                kind of bus.
        """
        plan = self._plan(bus)
        if plan is None and isinstance(rule, FaultRule):
            self._world.inject(bus, rule)
        elif plan is not None and isinstance(rule, SerialFaultRule):
            plan.add(rule)
        else:
            right = "FaultRule" if plan is None else "SerialFaultRule"
            raise ValueError(f"bus {bus}: rule {rule.name}: its faults are of class {right}")

    def _plan(self, bus: str) -> SerialFaultPlan | None:
        """Return the fault plan of a line, or None for a CAN bus."""
        if bus in self._world.line_names():
            return self._world.line(bus).plan
        self._require_bus(bus)
        return None

    def _require_bus(self, bus: str) -> None:
        names = self._world.bus_names()
        if bus not in names:
            known = ", ".join(names) or "none"
            raise ValueError(f"this rig has no CAN bus {bus!r} (known: {known})")

    def lift(self, bus: str, name: str) -> None:
        """End the rule of this name; its count stays.

        Raises:
            ValueError: the bus does not exist, or has no such rule.
        """
        plan = self._plan(bus)
        if plan is None:
            self._world.lift(bus, name)
        else:
            plan.remove(name)

    def bus_state(self, bus: str) -> dict[str, NodeState]:
        """Return the state of each node of the bus by name, in the order of its ports.

        Raises:
            ValueError: the CAN bus does not exist.
        """
        self._require_bus(bus)
        core = self._world.bus(bus)
        nodes = [core.node(port) for port in range(len(core.port_names()))]
        return {
            node.name: NodeState(
                node.state(),
                node.confinement.tec,
                node.confinement.rec,
                node.errors,
                node.aborted,
            )
            for node in nodes
        }

    def restart(self, bus: str, node: str) -> None:
        """Restart a bus-off node: it waits for 128 x 11 recessive bits from now on.

        Raises:
            ValueError: the bus or the node does not exist, or the node is not bus-off.
        """
        self._require_bus(bus)
        self._world.restart(bus, node)

    def fired(self) -> dict[str, int]:
        """Return how often each rule has fired, over all buses, in the order of addition."""
        counts: dict[str, int] = {}
        for bus in self._world.bus_names():
            for name, count in self._world.bus(bus).faults_fired().items():
                counts[name] = counts.get(name, 0) + count
        for line in self._world.line_names():
            plan = self._plan(line)
            for name, count in ({} if plan is None else plan.fired()).items():
                counts[name] = counts.get(name, 0) + count
        return counts
