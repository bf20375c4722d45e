"""Open rig: buses, controllers, plants and motors in virtual time.

    with Rig.open("rig.toml") as rig:
        wheel = rig.motors["left"]
        wheel.enable()
        rig.runtime.run_for(1.0)

A program written for python-can joins the same buses while the rig is open:
`can.Bus(interface="emulated", channel="can0")`.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from random import Random
from types import TracebackType
from typing import TYPE_CHECKING, Self, final

from emulators.controller import Controller, ControllerContext, SettingError
from emulators.event_queue import EventQueue
from emulators.world import World
from harness.interrupts import interrupts_between_events
from harness.memory_files import MemoryFiles
from harness.pace import WallPace
from harness.plant_from_model import settings_with_model
from harness.plugins import ADAPTATIONS, CONTROLLERS, installed, named
from harness.rig_file import (
    ControllerDescription,
    Known,
    RigDescription,
    read_rig,
)
from harness.rig_media import add_bus, own_clocks
from harness.rig_models import read_models
from harness.rig_parts import Named, RigController, RigFaults
from harness.rig_plugins import RigPlugins
from harness.rig_stimuli import schedule
from harness.rig_traffic import traffic_of
from harness.settings import SEED_MAX, RigError, refuse_source
from harness.virtual_time import VirtualRuntime
from harness.wording import a_kind_of
from motorapi.errors import UsageError
from motorapi.traffic import declare_traffic

if TYPE_CHECKING:
    from harness.can_plugin import EmulatedBus
    from harness.line_plugin import EmulatedLine
    from harness.recorder import Recorder
    from motorapi.group import MotorGroup
    from motorapi.motor import Motor


@final
class Rig:
    """An open rig; leaving its `with` block always closes everything in it.

    Attributes (read only):
        description: the contents of the rig file.
        seed: the seed of this run.
        world: buses and controllers on one event queue.
        runtime: where an application waits, and so lets time pass.
        controllers, motors, groups: by name, in the order of the file; motors and groups are
            created on first use.
        faults: faults of the rig, to inject and to query.
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
    ) -> None:
        self.description = description
        self.seed = description.seed if seed is None else seed
        self.notes: list[str] = []
        self.recording: Recorder | None = None
        self._models = read_models(description)
        self._plugins = RigPlugins(description)
        self._memory_files = MemoryFiles(description.folder)
        with ExitStack() as cleanup:
            queue = EventQueue()
            self.world = World(queue)
            started: list[tuple[int, str, str, str]] = []
            self.world.tap_events(lambda *event: started.append(event))
            self._add_buses()
            self._add_controllers()
            schedule(description, self.world, self._build_controller)
            self.notes += [f"{name}: {level}: {text}" for _, level, name, text in started]
            self.notes += [note for bus in description.buses for note in self._destroyers(bus)]
            if record is not None:
                self._record(record, started, cleanup)
            self.runtime = VirtualRuntime(queue, WallPace() if realtime else None)
            cleanup.enter_context(interrupts_between_events(self.runtime))
            self._open_door(cleanup)
            self._cleanup = cleanup.pop_all()
        self._in_use = ExitStack()  # resources of applications; closed before the rest
        self.faults = RigFaults(self.world)
        self.controllers: Mapping[str, RigController] = Named(
            "controller", description.controllers, self._controller
        )
        buses = description.buses.values()
        self._buses = Named("bus", [bus.name for bus in buses if not bus.is_line], self._bus)
        self._lines = Named("line", [bus.name for bus in buses if bus.is_line], self._line)
        self.motors: Mapping[str, Motor] = Named("motor", description.motors, self._motor)
        self.groups: Mapping[str, MotorGroup] = Named("group", description.groups, self._group)

    @classmethod
    def open(
        cls,
        path: str | Path,
        seed: int | None = None,
        realtime: bool = False,
        record: str | Path | None = None,
    ) -> Self:
        """Open the rig of a file, switched on at time 0.

        Args:
            path: the rig file; or a recording, which then replaces the controllers.
            seed: overrides the rig's own seed.
            realtime: True to run no faster than the wall clock.
            record: an MCAP file for the recording.

        Raises:
            RigError: the rig cannot be used as it is written; nothing is left open.
        """
        description = describe(Path(path))
        if seed is not None and not 0 <= seed <= SEED_MAX:
            raise RigError(path, f"seed {seed} is not within 0 to {SEED_MAX}", "use another seed")
        return cls(
            description,
            seed=seed,
            realtime=realtime,
            record=None if record is None else Path(record),
        )

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

    def build_motors(self) -> None:
        """Create every motor and group now, to find errors in their settings.

        Raises:
            RigError: a motor cannot be built as the rig describes it.
        """
        for name in self.motors:
            self.motors[name]
        for name in self.groups:
            self.groups[name]

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
        self.close()

    # --- construction --------------------------------------------------------------------------

    def _add_buses(self) -> None:
        for bus in self.description.buses.values():
            rules = [fault.rule for fault in self.description.faults if fault.bus == bus.name]
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

    def _record(
        self, target: Path, started: list[tuple[int, str, str, str]], cleanup: ExitStack
    ) -> None:
        from harness.rig_recording import end_recording, start_recording
        from traces.errors import TraceError

        for controller in self.description.controllers.values():
            source = controller.settings.get("recording")
            if isinstance(source, str):
                refuse_source(self.description.folder / source, target)
        try:
            recorder = start_recording(target, self.description, self.seed, self.world, started)
        except TraceError as error:
            raise RigError(error.path, error.what, error.remedy) from None
        self.recording = recorder
        cleanup.callback(end_recording, recorder, self.world)

    def _open_door(self, cleanup: ExitStack) -> None:
        """Make the rig's buses available by name to `can.Bus()` in this process."""
        from can import CanInitializationError

        from harness.can_plugin import close_rig, open_rig

        try:
            open_rig(self.world, self.runtime)
        except CanInitializationError as error:
            raise RigError(self.description.source.path, str(error)) from None
        cleanup.callback(close_rig, self.world)

    # --- resources of applications -----------------------------------------------------------

    def _bus(self, name: str) -> "EmulatedBus":
        from harness.can_plugin import EmulatedBus

        bus = EmulatedBus(channel=name)
        self._in_use.callback(bus.shutdown)
        declare_traffic(bus, traffic_of(self.description, name))
        return bus

    def _line(self, name: str) -> "EmulatedLine":
        from harness.line_plugin import EmulatedLine

        line = EmulatedLine(self.world, name, self.runtime)
        self._in_use.callback(line.close)
        return line

    def _controller(self, name: str) -> RigController:
        return RigController(name, self.world.controller(name), self.world)

    def _motor(self, name: str) -> "Motor":
        motor = self.description.motors[name]
        controller = None if motor.controller is None else self.world.controller(motor.controller)
        built, close, note = self._plugins.motor(
            name, self._models[name], self.runtime, self._link, controller
        )
        self._in_use.callback(close)
        if note:
            self.notes.append(note)
        if self.recording is not None:
            from harness.rig_recording import watch_motor

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
        from motorapi.group import MotorGroup

        group = MotorGroup()
        for place, motor in enumerate(self.description.groups[name].motors):
            try:
                group.append(self.motors[motor])
            except UsageError as error:
                path = ("group", name, "motors", place)
                raise self.description.error(path, str(error), "remove one of them") from error
        if self.recording is not None:
            from harness.rig_recording import watch_group

            watch_group(self.recording, group, name, self.world)
        return group


def describe(path: Path) -> RigDescription:
    """Read a rig file, or the rig in a recording.

    Raises:
        RigError: the rig cannot be used.
    """
    from harness.replay.recorded_rig import is_recording, rig_in

    known = installed_plugins()
    if is_recording(path):
        return rig_in(path, known)
    if path.suffix == ".mcap" and path.exists():
        raise RigError(path, "is not a recording (MCAP)", "give a recording, or a rig file (TOML)")
    return read_rig(path, known)


def installed_plugins() -> Known:
    """Return the plugins of this Python environment that a rig may name."""

    def needs_bus(adaptation: str) -> bool | None:
        try:
            build = named(ADAPTATIONS, adaptation).load()
        except (Exception, SystemExit):
            return None
        return getattr(build, "needs_bus", True) is not False

    return Known(tuple(installed(CONTROLLERS)), tuple(installed(ADAPTATIONS)), needs_bus)
