"""Benches with one drive: an emulated rig in virtual time, or a bus in wall time."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, Self, final

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule, FrameError
from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.emulators.settings.tables import plant_of
from motorhil.harness.conformance.bench import Ability, Lost
from motorhil.harness.conformance.benches.rig_bench import TimeIsUp
from motorhil.harness.conformance.clause import NotApplicable
from motorhil.harness.conformance.drives.client import Client
from motorhil.harness.conformance.drives.device_file import DeviceFile, read_file
from motorhil.harness.conformance.drives.drive import Drive
from motorhil.harness.rig.config.conformance import NOTHING_DECLARED, Facts
from motorhil.harness.rig.config.rig_file import ControllerDescription, RigDescription
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig

if TYPE_CHECKING:
    from motorhil.motorapi import Motor
    from motorhil.motorapi.runtime.api import Runtime


_END_STOPS: Final = "stop_"


class DriveBench(Protocol):
    """A bench with one drive, switched on.

    Attributes:
        drive: the drive under test, which answers SDO requests.
        is_real: True if the drive exists: clauses then make no jumps.
        facts: the rig's table `conformance`.
        stated: the table of the drive in the rig.
    """

    drive: Drive
    is_real: bool
    facts: Facts
    stated: Mapping[str, Any]

    def stimulate(self, name: str, value: float) -> None:
        """Set a physical input of the drive; raise NotApplicable if the bench cannot."""

    def require_stated(self, table: str, *keys: str) -> None:
        """Raise NotApplicable unless the rig states these keys of a table of the drive."""

    def dictionary(self) -> DeviceFile:
        """Return the drive's EDS; raise NotApplicable without one."""

    def true_position_rad(self) -> float:
        """Return the position of the output; raise NotApplicable if the bench does not know it."""

    def truth(self, name: str) -> float:
        """Return a true value of the motor; raise NotApplicable without one."""

    def plant(self) -> Mapping[str, float]:
        """Return all numbers of the plant that the rig states; raise NotApplicable if none is."""

    def add_end_stops(self) -> None:
        """Switch everything off and on again, with the end stops of the plant; usually it has none.

        Raises:
            NotApplicable: the drive is real.
        """

    def fail(self) -> int | None:
        """Cause a short fault in the drive; return its error code, or None if it cannot.

        Raises:
            Violated: the drive refuses the fault that the rig states.
        """

    def strike(self, times: int) -> Lost:
        """Destroy so many attempts of the drive to send a frame; return how many were, so far.

        Raises:
            NotApplicable: the drive is real.
        """


class _Bench:
    """The part that both benches share."""

    is_real = False
    abilities: Sequence[Ability] = ()
    motors: "Sequence[Motor]" = ()

    def __init__(self, description: RigDescription, controller: str, seed: int) -> None:
        self.facts: Facts = description.conformance
        self.seed = seed
        described = description.controllers[controller]
        self.stated: Mapping[str, Any] = described.settings
        own = OWN_EDS if described.kind == "cia402" and not self.is_real else None
        self._node_id = node_of(described)
        eds = self.stated.get("eds")
        self._eds = description.folder / eds if isinstance(eds, str) else own

    def stimulate(self, name: str, value: float) -> None:
        """Raise NotApplicable: the inputs of a real drive are out of reach."""
        raise NotApplicable(f"the bench cannot set the input {name} of the drive")

    def require_stated(self, table: str, *keys: str) -> None:
        """Raise NotApplicable unless the rig states these keys of a table of the drive."""
        for key in keys:
            if key not in self.stated.get(table, {}):
                raise NotApplicable(f"the rig does not state {table}.{key} of the drive")

    def dictionary(self) -> DeviceFile:
        """Return the drive's EDS."""
        if self._eds is None:
            raise NotApplicable("the rig states no EDS of the drive")
        return read_file(self._eds, self._node_id)

    def true_position_rad(self) -> float:
        """Return the true position of the output [rad]."""
        return self.truth("position_rad")

    def truth(self, name: str) -> float:
        """Raise NotApplicable: only the drive knows its motor."""
        raise NotApplicable(f"the bench cannot see the true {name} of the motor")

    def plant(self) -> Mapping[str, float]:
        """Raise NotApplicable: the plant of a real drive is not stated."""
        raise NotApplicable("the bench does not know the plant")

    def add_end_stops(self) -> None:
        """Raise NotApplicable: a real drive has the end stops that it has."""
        raise NotApplicable("the bench cannot add end stops")

    def strike(self, times: int) -> Lost:
        """Raise NotApplicable: frames of a real drive are out of reach."""
        raise NotApplicable("the bench cannot destroy frames of the drive")

    def _meet(self, cleanup: ExitStack, client: Client, controller: ControllerDescription) -> Drive:
        cleanup.callback(client.close)
        units = controller.settings.get("units", {})
        stated = units if isinstance(units, Mapping) else {}
        drive = Drive(client, node_of(controller), stated)
        drive.boot()
        return drive


@final
class EmulatedBench(_Bench):
    """An open rig with the drive under test; a context manager that closes it.

    The plant has no end stops: clauses move the motor as far as its drive permits.

    Args:
        description: the rig.
        controller: the name of the drive.
        seed: the seed of all random numbers.
        record: an MCAP file for all events.
        limit_s: the time limit in the rig's time, after which `TimeIsUp` ends all waits [s].
    """

    def __init__(
        self,
        description: RigDescription,
        controller: str,
        seed: int,
        *,
        record: Path | None = None,
        limit_s: float = 300.0,
    ) -> None:
        super().__init__(description, controller, seed)
        self._limit_s = limit_s
        self._name = controller
        self._stated_rig = description
        self._record = record
        self._strikes = 0
        self._open(_without_end_stops(description, controller))

    def _open(self, description: RigDescription) -> None:
        described = description.controllers[self._name]
        record = self._record
        with ExitStack() as cleanup:
            self._rig = cleanup.enter_context(
                Rig(description, seed=self.seed, record=record, doubts=record is not None)
            )
            self.runtime: Runtime = self._rig.runtime
            self._rig.world.queue.alarm(self._time_is_up).set(round(self._limit_s * 1e9))
            client = Client(self._rig.bus(described.bus), self.runtime, node_of(described))
            self.drive: Drive = self._meet(cleanup, client, described)
            self._cleanup = cleanup.pop_all()

    def add_end_stops(self) -> None:
        """Switch everything off and on again, with the end stops of the plant."""
        self._cleanup.close()
        self._open(self._stated_rig)

    def _time_is_up(self, now_ns: int) -> None:
        raise TimeIsUp(f"still waiting after {self._limit_s:g} s of the rig's time")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def stimulate(self, name: str, value: float) -> None:
        """Set a physical input of the drive."""
        try:
            self._rig.controllers[self._name].stimulate(name, value)
        except ValueError as error:
            raise NotApplicable(f"{error}") from None

    def plant(self) -> Mapping[str, float]:
        """Return all numbers of the plant that the rig states."""
        if "plant" not in self.stated:
            raise NotApplicable("the rig states no plant of the drive")
        values = asdict(plant_of(self.stated["plant"]))
        extras = values.pop("extras")
        return {**values, **extras}

    def truth(self, name: str) -> float:
        """Return a true value of the motor."""
        found = self._rig.controllers[self._name].snapshot().get(name)
        if found is None:
            raise NotApplicable(f"the plant has no {name}")
        return found

    def fail(self) -> int | None:
        """Cause the fault that the rig's `[conformance]` table states."""
        facts = self.facts
        value = facts.fault_code if facts.fault_value is None else facts.fault_value
        controller = self._rig.controllers[self._name]
        try:
            controller.stimulate(facts.fault_stimulus, value)
        except ValueError as error:
            if _fault_of(facts) == _fault_of(NOTHING_DECLARED):
                return None
            what = f"{facts.fault_stimulus} = {value}, which the rig states"
            raise self.drive.violated(what, "a fault", f"{error}", "") from None
        if facts.fault_over_value is not None:
            self.drive.quiet()
            controller.stimulate(facts.fault_stimulus, facts.fault_over_value)
        return facts.fault_code

    def strike(self, times: int) -> Lost:
        """Destroy so many attempts of the drive to send a frame; return how many were, so far."""
        self._strikes += 1
        rule = FaultRule(
            f"strike {self._strikes}",
            FaultKind.ERROR,
            sender=self._name,
            error=FrameError.BIT,
            limit=times,
        )
        faults = self._rig.faults
        faults.inject(self._stated_rig.controllers[self._name].bus, rule)
        return lambda: faults.fired().get(rule.name, 0)


@final
class RealBench(_Bench):
    """A drive on a bus in wall time; a context manager that leaves it switched off.

    Args:
        description: the rig, which names the drive, its bus and its node-ID.
        controller: the name of the drive.
        where: the place of its bus.
        seed: the seed of all random numbers.
        record: an MCAP file for all frames.

    Raises:
        RigError: the bus cannot be opened.
    """

    is_real = True

    def __init__(
        self,
        description: RigDescription,
        controller: str,
        where: str,
        seed: int,
        *,
        record: Path | None = None,
    ) -> None:
        from motorhil.harness.conformance.benches.wall_bench import bus_at, record_bus
        from motorhil.motorapi.runtime.wall import close_process_runtime, process_runtime
        from motorhil.traces.mcap.writer import TraceWriter

        super().__init__(description, controller, seed)
        described = description.controllers[controller]
        with ExitStack() as cleanup:
            bus = bus_at(described.bus, where)
            cleanup.callback(bus.shutdown)
            cleanup.callback(close_process_runtime)
            self.runtime: Runtime = process_runtime()
            if record is not None:
                writer = cleanup.enter_context(TraceWriter(record))
                record_bus(writer, process_runtime(), described.bus, bus)
            client = Client(bus, self.runtime, node_of(described))
            self.drive: Drive = self._meet(cleanup, client, described)
            cleanup.callback(self.drive.leave)
            self._cleanup = cleanup.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def fail(self) -> int | None:
        """Return None: a real drive has no stimuli."""
        return None


def _fault_of(facts: Facts) -> tuple[str, int, float | None]:
    return facts.fault_stimulus, facts.fault_code, facts.fault_value


def _without_end_stops(description: RigDescription, name: str) -> RigDescription:
    """Return the rig with a plant of this controller that has no end stops."""
    described = description.controllers[name]
    plant = described.settings.get("plant")
    if not isinstance(plant, Mapping):
        return description
    kept = {key: value for key, value in plant.items() if not key.startswith(_END_STOPS)}
    freed = replace(described, settings={**described.settings, "plant": kept})
    return replace(description, controllers={**description.controllers, name: freed})


def node_of(controller: ControllerDescription) -> int:
    """Return the node-ID of a controller.

    Raises:
        RigError: its kind has none.
    """
    if controller.node_id is None:
        problem = "has no node-ID: it is not a CANopen drive"
        raise RigError(f"controller {controller.name}", problem, "name another")
    return controller.node_id
