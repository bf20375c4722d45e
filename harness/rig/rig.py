"""Open rig: buses, controllers, plants and motors in virtual time.

    with Rig.open("rig.toml") as rig:
        wheel = rig.motors["left"]
        wheel.enable()
        rig.runtime.run_for(1.0)

A program written for python-can joins the same buses while the rig is open:
`can.Bus(interface="emulated", channel="can0")`. Errors of plug-ins are reported with the line of
the rig file that uses them.
"""

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self, final

from motorhil.emulators.can.bus.bus import CanBus
from motorhil.emulators.can.bus.fault_plan import FaultPlan
from motorhil.emulators.can.controller_config import PLAIN
from motorhil.emulators.can.fault_rules import FaultRule
from motorhil.emulators.controller import Controller, ControllerContext, SettingError
from motorhil.emulators.media.byte_pipe import BytePipe
from motorhil.emulators.media.serial_faults import SerialFaultPlan, SerialFaultRule
from motorhil.emulators.settings.tables import OscillatorTable
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World
from motorhil.harness.plugins import (
    CONTROLLERS,
    named,
)
from motorhil.harness.rig.acts import Acts
from motorhil.harness.rig.bus_load import traffic_of
from motorhil.harness.rig.config.buses import (
    MODBUS_TCP,
    BusDescription,
)
from motorhil.harness.rig.config.derived import settings_with_model
from motorhil.harness.rig.config.plausibility import doubts_of
from motorhil.harness.rig.config.rig_file import (
    ControllerDescription,
    MotorDescription,
    RigDescription,
)
from motorhil.harness.rig.config.toml import (
    SEED_MAX,
    RigError,
    a_kind_of,
    refuse_source,
)
from motorhil.harness.rig.config.units import Comparison, compare_units, require_units
from motorhil.harness.rig.faults import RigFaults
from motorhil.harness.rig.lines import serial_line
from motorhil.harness.rig.names import Named
from motorhil.harness.rig.nonvolatile import MemoryFiles
from motorhil.harness.rig.plugins import RigPlugins
from motorhil.harness.rig.reading import describe, read_models
from motorhil.harness.virtual_time.interrupts import interrupts_between_events
from motorhil.harness.virtual_time.runtime import VirtualRuntime, WallPace
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.synchronization.bus_load import declare_traffic
from motorhil.settings import read
from motorhil.traces.mcap.writer import CHUNK_NS

if TYPE_CHECKING:
    from motorhil.harness.python_can.bus import EmulatedBus
    from motorhil.harness.python_can.line import EmulatedLine
    from motorhil.harness.recording.recorder import Recorder
    from motorhil.motorapi.group import MotorGroup
    from motorhil.motorapi.motor import Motor

_IN_A_TEST: Final = "PYTEST_CURRENT_TEST"  # a test may end where it likes


@final
class RigController:
    """An emulated controller of an open rig: its physical inputs and its true state.

    Attributes:
        name: name in the rig.
        core: the controller itself.
    """

    def __init__(self, name: str, core: Controller, world: World) -> None:
        self.name = name
        self.core = core
        self._world = world

    def stimulate(self, stimulus: str, value: float) -> None:
        """Set a physical input (load, switch) to this value from now on; it is recorded.

        Raises:
            ValueError: the input does not exist; names the known ones.
        """
        self._world.stimulate(self.name, stimulus, value)

    def snapshot(self) -> Mapping[str, float]:
        """Return the true state now, units in the keys. Has no side effects."""
        return self._world.snapshot(self.name)


def add_bus(
    world: World,
    bus: BusDescription,
    rules: Sequence[FaultRule | SerialFaultRule],
    random: Callable[[], float],
    clocks: Mapping[str, int],
) -> None:
    """Add the bus or line to the world, with its faults.

    Args:
        world: the rig's world.
        bus: description of the bus.
        rules: rules of its faults, in the order of the file.
        random: its random stream, derived from the run's seed.
        clocks: clock errors of controllers by name, as returned by `own_clocks`.
    """
    if not bus.is_line:
        frames = [rule for rule in rules if isinstance(rule, FaultRule)]
        plan = FaultPlan(frames, random)
        can = CanBus(bus.name, bus.bitrate_bit_s, plan, bus.data_bitrate_bit_s)
        chips = dict(bus.nodes)
        for name, error in clocks.items():
            chip = chips.get(name, PLAIN)
            if not chip.clock_error_1e12:
                chips[name] = replace(chip, clock_error_1e12=error)
        world.add_bus(can, chips)
        return
    line_plan = SerialFaultPlan([one for one in rules if isinstance(one, SerialFaultRule)], random)
    if bus.kind == MODBUS_TCP:
        world.add_tcp(BytePipe(bus.name, bus.latency_ns, line_plan), line_plan, bus.timeout_ns)
        return
    world.add_serial_line(serial_line(bus, line_plan), line_plan)


def own_clocks(description: "RigDescription", bus: str, seed: int) -> dict[str, int]:
    """Return the clock errors of a bus's controllers by name [1e-12]; positive runs fast.

    A controller sends its frames with the oscillator of its firmware. Exact clocks are omitted.
    """
    clocks: dict[str, int] = {}
    for controller in description.controllers.values():
        if controller.bus == bus and "oscillator" in controller.settings:
            with suppress(SettingError):  # reported with its line when the controller is built
                table = read(OscillatorTable, controller.settings["oscillator"])
                own = table.oscillator(f"{seed}:{controller.name}")
                if own.error_1e12:
                    clocks[controller.name] = own.error_1e12
    return clocks


@final
class Rig:
    """An open rig; leaving its `with` block always closes everything in it.

    Args:
        description: the contents of the rig file.
        seed, record, pace, chunk_ns: as for `open`.
        doubts: whether implausible values are noted, which costs a sixth of the opening.
        truths: whether a recording has the true states of controllers.

    Attributes (read only):
        description: the contents of the rig file.
        seed: the seed of this run.
        world: buses and controllers on one event queue.
        runtime: where an application waits, and so lets time pass.
        controllers, motors, groups: by name, in the order of the file; motors and groups are
            created on first use.
        faults: faults of the rig, to inject and to query.
        acts: stimuli and faults at given times.
        recording: the recorder; None if nothing is recorded.
        notes: notes for readers of the rig's results, one line each.
    """

    def __init__(
        self,
        description: RigDescription,
        *,
        seed: int | None = None,
        realtime: bool = False,
        record: Path | None = None,
        doubts: bool = True,
        truths: bool = True,
        pace: float | None = None,
        chunk_ns: int = CHUNK_NS,
    ) -> None:
        self.description = description
        self.seed: int = description.seed if seed is None else seed
        self.notes: list[str] = []
        self.recording: Recorder | None = None
        self._models = read_models(description)
        self._plugins = RigPlugins(description)
        self._memory_files = MemoryFiles(description.folder)
        with ExitStack() as cleanup:
            queue = EventQueue()
            self.world: World = World(queue)
            started: list[tuple[int, str, str, str]] = []
            self.world.tap_events(lambda *event: started.append(event))
            self._add_buses()
            self._add_controllers()
            self.faults: RigFaults = RigFaults(self.world)
            self.acts: Acts = Acts(description, self.world, self.faults, self._build_controller)
            self.acts.schedule()
            self.notes += [f"{name}: {level}: {text}" for _, level, name, text in started]
            if doubts:
                self._doubt(started)
            self.notes += [note for bus in description.buses for note in self._destroyers(bus)]
            if record is not None:
                self._record(record, started, truths, chunk_ns, cleanup)
            pace = 1.0 if realtime else pace
            wall = None if pace is None else WallPace(pace)
            self.runtime: VirtualRuntime = VirtualRuntime(queue, wall)
            if description.world.interleaving is not None:
                self.runtime.interleave(Random(f"{description.world.interleaving}:turns").randrange)
            cleanup.enter_context(interrupts_between_events(self.runtime))
            self._open_door(cleanup)
            self._cleanup = cleanup.pop_all()
        self._in_use = ExitStack()  # resources of applications; closed before the rest
        self._warns_at_end = False
        self.controllers: Mapping[str, RigController] = Named(
            "controller", description.controllers, self._controller
        )
        buses = description.buses.values()
        self._buses = Named("bus", [bus.name for bus in buses if not bus.is_line], self._bus)
        self._lines = Named("line", [bus.name for bus in buses if bus.is_line], self._line)
        self._made: dict[str, Motor] = {}
        self.motors: Mapping[str, Motor] = Named("motor", description.motors, self._motor)
        self.groups: Mapping[str, MotorGroup] = Named("group", description.groups, self._group)

    @classmethod
    def open(
        cls,
        path: str | Path,
        seed: int | None = None,
        realtime: bool = False,
        record: str | Path | None = None,
        world: str | Path | None = None,
        pace: float | None = None,
        chunk_ns: int = CHUNK_NS,
    ) -> Self:
        """Open the rig of a file, switched on at time 0.

        Args:
            path: the rig file; or a recording, which then replaces the controllers.
            seed: overrides the rig's own seed.
            realtime: True to run no faster than the wall clock.
            record: an MCAP file for the recording.
            world: a fragment with the disturbances of one world, or a recording that has one.
            pace: most seconds of the rig in one second of wall time; None: no limit.
            chunk_ns: longest time after which the recording is written, by the rig's time [ns].

        Raises:
            RigError: the rig cannot be used as it is written; nothing is left open.
        """
        from motorhil.harness.virtual_time.stdlib.clocks import sleep_watched

        description = describe(Path(path), None if world is None else Path(world))
        if seed is not None and not 0 <= seed <= SEED_MAX:
            raise RigError(path, f"seed {seed} is not within 0 to {SEED_MAX}", "use another seed")
        target = None if record is None else Path(record)
        pace = 1.0 if realtime else pace
        rig = cls(description, seed=seed, record=target, pace=pace, chunk_ns=chunk_ns)
        rig._warns_at_end = True
        if pace is None:
            rig._in_use.enter_context(sleep_watched(rig.runtime))
        return rig

    def bus(self, name: str) -> "EmulatedBus":
        """Return the application's own connection to a bus, a python-can bus.

        Raises:
            KeyError: the rig has no such bus.
        """
        return self._buses[name]

    def line(self, name: str) -> "EmulatedLine":
        """Return the application's own port on a Modbus line.

        Raises:
            KeyError: the rig has no such line.
        """
        return self._lines[name]

    def open_line(self, name: str) -> "EmulatedLine":
        """Return a new port on a line, which the caller closes."""
        from motorhil.harness.python_can.line import EmulatedLine

        return EmulatedLine(self.world, name, self.runtime)

    def build_motors(self) -> None:
        """Create every motor and group now, to find errors in their settings.

        Raises:
            RigError: a motor cannot be built as the rig describes it.
        """
        for name, motor in self.description.motors.items():
            self.motors[name]
            controller = self._controller_of(motor)
            require_units(self.description, motor, self._models[name], controller)
        for name in self.groups:
            self.groups[name]

    def compared_units(self, motor: str) -> tuple[Comparison, ...]:
        """Return the units of a motor beside those of its emulated drive, as far as known.

        Raises:
            KeyError: the rig has no such motor.
            RigError: they contradict each other.
        """
        described = self.description.motors[motor]
        controller = self._controller_of(described)
        return compare_units(self.description, described, self._models[motor], controller)

    def take_forgotten(self) -> list[str]:
        """Return sentences about commands that were never started; the end then omits them."""
        self._warns_at_end = False
        logical = [getattr(motor, "logical", None) for motor in self._made.values()]
        return [text for one in logical if one is not None and (text := one.forgotten())]

    def send_queued(self) -> None:
        """Let time pass until frames that programs have queued are sent, for up to 1 s.

        The kernel sends them also after the end of a program.
        """
        self.runtime.wait_until(lambda: not self.world.hosts_pending(), timeout_s=1.0)

    def close(self) -> None:
        """End all parties, close motors and buses, and complete the record."""
        with self._cleanup, self._in_use:
            self.runtime.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        warns = error is None and self._warns_at_end and _IN_A_TEST not in os.environ
        forgotten = self.take_forgotten() if warns else []
        self.close()
        for text in forgotten:
            warnings.warn(text, stacklevel=2)

    # --- construction --------------------------------------------------------------------------

    def _add_buses(self) -> None:
        for bus in self.description.buses.values():
            known = [one for one in self.description.faults if not one.by_hand]
            rules = [fault.rule for fault in known if fault.bus == bus.name]
            stream = Random(f"{self.seed}:bus.{bus.name}.faults")
            clocks = own_clocks(self.description, bus.name, self.seed)
            add_bus(self.world, bus, rules, stream.random, clocks)

    def _add_controllers(self) -> None:
        built = [
            (controller, self._build_controller(controller))
            for controller in self.description.controllers.values()
        ]
        for controller, core in built:
            place = ("controller", controller.name, "kind")
            with self._plugins.blaming(named(CONTROLLERS, controller.kind), place):
                self.world.add_controller(controller.name, core, controller.bus)
        for name in self.world.bus_names():
            self.world.reserve_host(name)
            for node in self.description.buses[name].silent:
                self.world.add_silent(name, node)

    def _build_controller(self, controller: ControllerDescription) -> Controller:
        place = ("controller", controller.name)
        settings, notes = settings_with_model(self.description, controller, self._models)
        self.notes += [note for note in notes if note not in self.notes]
        context = ControllerContext(
            controller.name,
            self.description.folder,
            self.seed,
            partial(self._memory_files.open, controller.name),
            self.description.buses[controller.bus].bitrate_bit_s or None,
        )
        plugin = named(CONTROLLERS, controller.kind)
        build = self._plugins.load(plugin, (*place, "kind"))
        kind = f'controller kind "{controller.kind}"'
        self._plugins.require_kind(build, controller.bus, kind, (*place, "bus"))
        with self._plugins.blaming(plugin, (*place, "kind")):
            try:
                core: Controller = build(settings, context)
            except SettingError as error:
                raise self.description.error(
                    (*place, *error.path), error.message, error.remedy
                ) from error
            except (ValueError, ArithmeticError) as error:  # numbers that are only valid one by one
                message = f"cannot be built: {error}"
                raise self.description.error(place, message, "correct its numbers") from error
            if not callable(getattr(core, "next_deadline_ns", None)):
                raise TypeError(f"it built {a_kind_of(core)}, which is not a controller")
            return core

    def _doubt(self, started: list[tuple[int, str, str, str]]) -> None:
        """Note implausible values; recordings get those of controllers as events."""
        names = self.description.controllers
        cores = {name: self.world.controller(name) for name in names}
        for one in doubts_of(self.description, self._models, cores):
            self.notes.append(str(one))
            path = one.doubt.path
            if path[:1] == ("controller",):
                started.append((0, str(path[1]), "warning", one.text))

    def _record(
        self,
        target: Path,
        started: list[tuple[int, str, str, str]],
        truths: bool,
        chunk_ns: int,
        cleanup: ExitStack,
    ) -> None:
        from motorhil.harness.rig.recording import end_recording, start_recording
        from motorhil.traces.errors import TraceError

        for controller in self.description.controllers.values():
            source = controller.settings.get("recording")
            if isinstance(source, str):
                refuse_source(self.description.folder / source, target)
        try:
            about = self.description, self.seed, self.world
            recorder = start_recording(target, *about, started, truths, chunk_ns)
        except TraceError as error:
            raise RigError(error.path, error.what, error.remedy) from None
        self.recording = recorder
        cleanup.callback(end_recording, recorder, self.world)

    def _open_door(self, cleanup: ExitStack) -> None:
        """Make the rig's buses available by name to `can.Bus()` in this process."""
        from can import CanInitializationError

        from motorhil.harness.python_can.bus import close_rig, open_rig

        try:
            open_rig(self.world, self.runtime)
        except CanInitializationError as error:
            raise RigError(self.description.source.path, str(error)) from None
        cleanup.callback(close_rig, self.world)

    # --- resources of applications -----------------------------------------------------------

    def _bus(self, name: str) -> "EmulatedBus":
        from motorhil.harness.python_can.bus import EmulatedBus

        bus = EmulatedBus(name, fd=self.world.bus(name).data_bitrate_bit_s is not None)
        self._in_use.callback(bus.shutdown)
        declare_traffic(bus, traffic_of(self.description, name))
        return bus

    def _line(self, name: str) -> "EmulatedLine":
        line = self.open_line(name)
        self._in_use.callback(line.close)
        return line

    def _controller(self, name: str) -> RigController:
        return RigController(name, self.world.controller(name), self.world)

    def _controller_of(self, motor: MotorDescription) -> Controller | None:
        return None if motor.controller is None else self.world.controller(motor.controller)

    def _motor(self, name: str) -> "Motor":
        motor = self.description.motors[name]
        controller = self._controller_of(motor)
        built, close, note = self._plugins.motor(
            name, self._models[name], self.runtime, self._link, controller
        )
        self._in_use.callback(close)
        self._made[name] = built
        if note:
            self.notes.append(note)
        self.compared_units(name)
        if self.recording is not None:
            from motorhil.harness.rig.recording import watch_motor

            watch_motor(self.recording, built, motor, self.world)
        return built

    def _destroyers(self, bus: str) -> list[str]:
        controllers = self.description.controllers.values()
        names = self.description.buses[bus].destroyers(
            [c.name for c in controllers if c.bus == bus]
        )
        if not names:
            return []
        return [
            f"{bus}: warning: classical CAN controllers destroy its CAN FD frames:"
            f' {", ".join(names)}; give them frames = "fd_tolerant" or "fd" in'
            f" [bus.{bus}.node.{names[0]}]"
        ]

    def _link(self, bus: str) -> "EmulatedBus | EmulatedLine":
        return self.line(bus) if self.description.buses[bus].is_line else self.bus(bus)

    def _group(self, name: str) -> "MotorGroup":
        from motorhil.motorapi.group import MotorGroup

        group = MotorGroup()
        for place, motor in enumerate(self.description.groups[name].motors):
            try:
                group.append(self.motors[motor])
            except UsageError as error:
                path = ("group", name, "motors", place)
                raise self.description.error(path, str(error), "remove one of them") from error
        if self.recording is not None:
            from motorhil.harness.rig.recording import watch_group

            watch_group(self.recording, group, name, self.world)
        return group
