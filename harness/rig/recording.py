"""Recording of an open rig: attached files, and taps on all events."""

import hashlib
import sys
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.recording.ownership import LockWriter, MotorNames, MotorTap, OwnershipTap
from motorhil.harness.recording.recorder import PERIOD_NS, Reading, Recorder, run_metadata
from motorhil.harness.rig.config.buses import SERIAL
from motorhil.harness.rig.config.rig_file import MotorDescription, RigDescription
from motorhil.harness.rig.fragment import WORLD, table_of
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.writer import CHUNK_NS, TraceWriter
from motorhil.traces.protobuf import Value
from motorhil.traces.schema import GROUP_SYNC

if TYPE_CHECKING:
    from motorhil.emulators.simulation.world import World
    from motorhil.motorapi.group import MotorGroup
    from motorhil.motorapi.motor import Motor
    from motorhil.motorapi.synchronization.quality import SyncQuality

_TOML: Final = "application/toml"
_NAMING: Final = (
    ("motor", "model", _TOML),
    ("controller", "eds", "text/plain"),
    ("controller", "nonvolatile_memory", "text/plain"),
)
_IN_TRANSIT = 8  # frames, and the silences after them
_START, _END = 1, 2  # motorhil.GroupSync.Phase


def named_files(rig: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return (file as the rig names it, media type) of every file in its tables, each once."""
    found: dict[str, str] = {}
    for kind, key, media_type in _NAMING:
        tables = rig.get(kind)
        for table in tables.values() if isinstance(tables, dict) else ():
            named = table.get(key) if isinstance(table, dict) else None
            if isinstance(named, str):
                found.setdefault(named, media_type)
    controllers = rig.get("controller")
    for table in controllers.values() if isinstance(controllers, dict) else ():
        for named in _plant_files(table):
            found.setdefault(named, _TOML)
    return list(found.items())


def _plant_files(controller: object) -> list[str]:
    """Return the files of a controller's plants: its own, and those of its channels."""
    if not isinstance(controller, dict):
        return []
    channels = controller.get("channel")
    owners = [controller, *(channels.values() if isinstance(channels, dict) else ())]
    plants = [owner.get("plant") for owner in owners if isinstance(owner, dict)]
    files = [plant.get("file") for plant in plants if isinstance(plant, dict)]
    return [file for file in files if isinstance(file, str)]


def files_of(description: "RigDescription") -> list[tuple[str, str, bytes]]:
    """Return (name, media type, contents) of the rig and of every file it names, each once.

    Files of a recorded rig are not on disk; their contents come from the recording.
    """
    source = description.source
    files = [(source.path.name, _TOML, source.text.encode())]
    paths = [(motor.model, _TOML) for motor in description.motors.values()]
    for controller in description.controllers.values():
        eds = controller.settings.get("eds")
        if isinstance(eds, str):
            paths.append((description.folder / eds, "text/plain"))
    paths += [
        (description.folder / named, media_type)
        for named, media_type in named_files(tomllib.loads(source.text))
    ]
    files += _contents(path for path in paths if isinstance(path[0], Path))
    names = {name for name, _, _ in files}
    return files + [one for one in description.attached if one[0] not in names]


def digest_of(files: Iterable[tuple[str, str, bytes]], more: bytes = b"") -> str:
    """Return the SHA-256 (hex) of files as `files_of` returns them, and of what else counts."""
    digest = hashlib.sha256()
    for name, _, data in files:
        digest.update(f"{name}\0{len(data)}\0".encode() + data)
    digest.update(more)
    return digest.hexdigest()


def _contents(paths: Iterable[tuple[object, str]]) -> list[tuple[str, str, bytes]]:
    seen: list[Path] = []
    files: list[tuple[str, str, bytes]] = []
    for path, media_type in paths:
        if isinstance(path, Path) and path not in seen and path.is_file():
            seen.append(path)
            files.append((path.name, media_type, path.read_bytes()))
    return files


def start_recording(
    target: Path,
    description: RigDescription,
    seed: int,
    world: "World",
    before: Iterable[tuple[int, str, str, str]],
    truths: bool = True,
    chunk_ns: int = CHUNK_NS,
) -> Recorder:
    """Start to record everything that happens in the world to `target`.

    Args:
        target: the MCAP file.
        description: the rig's description; its file and the files it names are attached.
        seed: seed of the run.
        world: all buses and controllers.
        before: (time [ns], level, source, text) of events that have already happened.
        truths: True to record the true states of controllers as well.
        chunk_ns: longest time after which messages are written, by the rig's time [ns].

    Raises:
        TraceError: the file cannot be written.
    """
    files = files_of(description)
    metadata = run_metadata(seed=seed, rig_digest=digest_of(files), command_line=sys.argv)
    if description.source.fragment:
        metadata[WORLD] = table_of(description.source.fragment)
    writer = TraceWriter(target, metadata, chunk_ns=chunk_ns)
    try:
        for name, media_type, data in files:
            writer.attach(name, data, media_type)
        kinds = {name: controller.kind for name, controller in description.controllers.items()}
        plain = [name for name, bus in description.buses.items() if bus.kind == SERIAL]
        recorder = Recorder(writer, kinds, lines=world.line_names(), plain=plain)
        for event in before:
            recorder.event(*event)
        recorder.connect(world.queue.alarm(recorder.poll).set)
        world.tap_frames(recorder.frame)
        world.tap_lines(recorder.adu)
        world.tap_events(recorder.event)
        owners = OwnershipTap(LockWriter(recorder, world), MotorNames(description))
        world.tap_ownership(owners.heard)
        if truths:
            world.tap_samples(PERIOD_NS, recorder.truth)
    except TraceError:
        writer.close()
        raise
    return recorder


def end_recording(recorder: Recorder, world: "World") -> None:
    """Complete the record, including frames that are still in transit on serial lines."""
    for name in world.line_names():
        line = world.serial_line(name)
        if line is not None:
            for _ in range(_IN_TRANSIT):
                due_ns = line.next_deadline_ns()
                if due_ns is None:
                    break
                world.queue.run_until(due_ns)
    recorder.close(world.queue.now_ns)


def watch_motor(
    recorder: Recorder, motor: "Motor", description: MotorDescription, world: "World"
) -> None:
    """Record the motor's state while it changes, and its lock, under its name in the rig.

    Most buses announce the owners of their motors; other motors announce them here.
    """
    bus, controller = description.bus, description.controller
    places = () if bus is None or controller is None else ((bus, controller),)
    recorder.watch_motor(description.name, _Reader(motor).read, places)
    if not motor.ownership.is_announced:
        motor.ownership.is_announced = True
        writer = LockWriter(recorder, world)
        motor.ownership.listeners.append(MotorTap(writer, description.name).heard)


def watch_group(recorder: Recorder, group: "MotorGroup", name: str, world: "World") -> None:
    """Record how well each start of the group was synchronised, once it has been waited for."""
    group.observe(_GroupObserver(recorder, name, world).record)


@final
class _GroupObserver:
    """A writer of a START and an END message for each synchronised motion."""

    def __init__(self, recorder: Recorder, name: str, world: "World") -> None:
        self._recorder = recorder
        self._topic = f"/group/{name}/sync"
        self._world = world

    def record(self, quality: "SyncQuality") -> None:
        known = [(name, times) for name, times in quality.times if times is not None]
        starts = [(name, times.started_ns, times.source) for name, times in known]
        ends = [(name, times.ended_ns, times.source) for name, times in known]
        self._write(_START, starts, quality.start_skew_s, quality.predicted_start_skew_s)
        self._write(_END, ends, quality.end_skew_s, quality.predicted_end_skew_s)

    def _write(
        self,
        phase: int,
        moments: list[tuple[str, int | None, str]],
        skew_s: float | None,
        predicted_s: float | None,
    ) -> None:
        starts = [
            (name, time_ns, source) for name, time_ns, source in moments if time_ns is not None
        ]
        if not starts:
            return
        first_ns = min(time_ns for _, time_ns, _ in starts)
        values: dict[str, Value] = {
            "phase": phase,
            "motor": [name for name, _, _ in starts],
            "offset_s": [(time_ns - first_ns) / 1e9 for _, time_ns, _ in starts],
            "method": starts[0][2],
        }
        if skew_s is not None:
            values["skew_s"] = skew_s
        if predicted_s is not None:
            values["predicted_skew_s"] = predicted_s
        self._recorder.message(self._world.queue.now_ns, self._topic, GROUP_SYNC, values)


@final
class _Reader:
    """A reader of what an application knows of a motor without querying it."""

    def __init__(self, motor: "Motor") -> None:
        self._motor = motor

    def read(self) -> Reading | None:
        latest = self._motor.latest()
        if latest is None:
            return None
        return latest.position, latest.velocity, latest.torque
