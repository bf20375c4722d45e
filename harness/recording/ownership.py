"""Ownership of motors as lock events of the record: announced, or polled from lock files.

Programs identify a motor by its bus and node (OwnershipNotice); the record uses the rig's name. If
no motor of the rig is on the node, the record uses the name of its controller, or of its bus and
number.

Announcements of the rig's own process must repeat exactly in every run of a seed. So no pid is
recorded for them.

On a hub, programs announce ownership in order with their frames. SocketCAN carries frames only. But
the owner of a motor is written in its lock file, which other users of this host may be able to
read. So the recorder of such a bus polls the lock files a few times per second. Polling takes no
lock and delays no program.

Events found in this way are marked *looked* and are less complete than announced ones. An ownership
that begins and ends between two polls is missing; token numbers reveal it. An end is noticed up to
one period late. Waiting and refused programs are not recorded. The start of an ownership is exact,
because the owner wrote it.

Programs that use other lock files (another user's, another MOTORHIL_LOCK_DIR, another host's) or
none are not seen. Frames of all programs are recorded under the one name of the interface. One
event at the start of polling records all this.
"""

import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final, final

from motorhil.harness.recording.recorder import Recorder
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.locking.directory import LockDirectory, socketcan_name
from motorhil.motorapi.locking.lock_status import LockView, look
from motorhil.traces.errors import TraceError
from motorhil.traces.protobuf import Value
from motorhil.traces.schema import MOTOR_LOCK, LockAction

if TYPE_CHECKING:
    from motorhil.emulators.simulation.ownership_notice import OwnershipNotice
    from motorhil.emulators.simulation.world import World
    from motorhil.motorapi.locking.lock_status import Occupant
    from motorhil.motorapi.ownership.claim import OwnershipEvent

PERIOD_NS: Final = 100_000_000


@final
class MotorNames:
    """The rig's names for the targets of commands on a bus."""

    def __init__(self, description: RigDescription) -> None:
        self._motors: dict[tuple[str, int, int], str] = {}
        self._controllers: dict[tuple[str, int], str] = {}
        for motor in description.motors.values():
            channel = motor.settings.get("channel", 1)
            if motor.bus is not None and motor.node_id is not None and isinstance(channel, int):
                place = motor.bus, motor.node_id
                self._motors.setdefault((*place, channel), motor.name)
                self._motors.setdefault((*place, 0), motor.name)
        for controller in description.controllers.values():
            if controller.node_id is not None:
                self._controllers[controller.bus, controller.node_id] = controller.name

    def of(self, bus: str, node_id: int, channel: int = 0) -> str:
        """Return the name of the motor on this node, or on this channel of it (from 1)."""
        motor = self._motors.get((bus, node_id, channel))
        if motor is not None:
            return motor
        node = self._controllers.get((bus, node_id), f"{bus}-node{node_id}")
        return f"{node}-channel{channel}" if channel else node


@final
class LockWriter:
    """A writer of lock events to `/motor/<name>/lock`.

    An error of the record is raised by the next event of the world, and not while a program takes
    its motor.
    """

    def __init__(self, recorder: Recorder, world: "World") -> None:
        self._recorder: Final = recorder
        self._queue: Final = world.queue

    def write(self, motor: str, values: dict[str, Value]) -> None:
        """Record a lock event of this motor; values that are "", 0 or False are omitted."""
        told = {key: value for key, value in values.items() if value}
        now_ns = self._queue.now_ns
        try:
            self._recorder.message(now_ns, f"/motor/{motor}/lock", MOTOR_LOCK, told)
        except TraceError as error:
            self._queue.alarm(_raiser(error)).set(now_ns)


def _raiser(error: TraceError) -> Callable[[int], None]:
    def raise_it(now_ns: int) -> None:
        raise error

    return raise_it


@final
class OwnershipTap:
    """A listener for ownership announcements on all buses; see `World.tap_ownership`."""

    def __init__(self, writer: LockWriter, names: MotorNames) -> None:
        self._writer: Final = writer
        self._names: Final = names
        self._own_pid: Final = os.getpid()

    def heard(self, bus: str, time_ns: int, sender: str, notice: "OwnershipNotice") -> None:
        """Record an announcement that a host on the bus has just made."""
        values: dict[str, Value] = {
            "action": notice.action,
            "owner": notice.owner,
            "holder": notice.holder,
            "waited_s": notice.waited_ns / 1e9,
            "held_s": notice.held_ns / 1e9,
            "token": notice.token,
            "purpose": notice.purpose,
            "sender": sender,
        }
        if notice.pid != self._own_pid:
            values["pid"] = notice.pid
            values["program"] = notice.program
        self._writer.write(
            self._names.of(bus, notice.resource & 0xFF, notice.resource >> 8), values
        )


@final
class MotorTap:
    """A listener for ownership of one motor of this process that no bus announces."""

    def __init__(self, writer: LockWriter, motor: str) -> None:
        self._writer: Final = writer
        self._motor: Final = motor

    def heard(self, event: "OwnershipEvent") -> None:
        """Record an ownership event that has just happened."""
        values: dict[str, Value] = {
            "action": event.action.value,
            "owner": event.owner,
            "holder": event.holder,
            "waited_s": event.waited_s,
            "held_s": event.held_s,
            "token": event.token,
            "purpose": event.purpose,
        }
        self._writer.write(self._motor, values)


@final
class LockLooks:
    """A recorder of changes in the lock files of motors on SocketCAN.

    Args:
        writer: writes lock events.
        world: provides alarms; its time is wall time.
        description: the rig's description, with motors and their names.
        interfaces: bus -> network interface.

    Raises:
        UsageError: an interface does not exist.
    """

    def __init__(
        self,
        writer: LockWriter,
        world: "World",
        description: RigDescription,
        interfaces: Mapping[str, str],
    ) -> None:
        self._world: Final = world
        self._directory: Final = LockDirectory()
        self._locks: list[_Lock] = []
        for bus, interface in interfaces.items():
            where = socketcan_name(interface)
            for motor in description.motors.values():
                if motor.bus == bus:
                    name = f"{where}-node{motor.node_id}"
                    self._locks.append(_Lock(name, motor.name, bus, writer))
                    name += f"-channel{motor.settings.get('channel', 1)}"  # for shared nodes
                    self._locks.append(_Lock(name, motor.name, bus, writer))
            self._tell(
                *("info", bus),
                f"who owns its motors nobody tells on {interface}: it is looked up every"
                f" {PERIOD_NS // 1_000_000} ms in {self._directory.path}; what lies between two"
                " looks, and who uses other lock files, is not seen",
            )
        self._alarm: Final = world.queue.alarm(self._look)
        self._alarm.set(world.queue.now_ns)

    def _tell(self, level: str, bus: str, text: str) -> None:
        self._world.report(self._world.queue.now_ns, level, bus, text)

    def look(self) -> None:
        """Record the changes since the last poll now; for the end of polling."""
        self._look(self._world.queue.now_ns)

    def _look(self, now_ns: int) -> None:
        for lock in self._locks:
            try:
                died = lock.note(look(self._directory, lock.name))
            except UsageError as error:
                self._tell("warning", lock.bus, f"no more lock events: {error}")
                return
            if died:
                self._tell("warning", lock.bus, died)
        self._alarm.set(now_ns + PERIOD_NS)


@final
class _Lock:
    """A motor's lock as last seen."""

    def __init__(self, name: str, motor: str, bus: str, writer: LockWriter) -> None:
        self.name: Final = name
        self.bus: Final = bus
        self._motor: Final = motor
        self._writer: Final = writer
        self._token = 0  # of the last owner seen
        self._holder: Occupant | None = None  # the present owner
        self._abandoned = 0  # the token of an owner that died with the lock

    def note(self, view: LockView) -> str:
        """Record any change; return a message if the owner died, else ""."""
        if view.holder is None:
            return self._note_free(view)
        record = view.holder.record
        if record is not None and record.number != self._token:  # the owner has written its record
            from_dead = self._abandoned > 0 and record.number == self._abandoned + 1
            action = LockAction.BROKEN if from_dead else LockAction.TAKEN
            self._holder, self._token = view.holder, record.number
            self._write(action, view.holder, held_s=view.holder.age_s)
        return ""

    def _note_free(self, view: LockView) -> str:
        self._abandoned = view.abandoned
        holder, self._holder = self._holder, None
        if holder is None:
            return ""
        if view.abandoned == self._token:
            return f"{holder.who} has died with {self._motor}"
        self._write(LockAction.RELEASED, holder)
        return ""

    def _write(self, action: LockAction, holder: "Occupant", held_s: float = 0.0) -> None:
        record = holder.record
        assert record is not None
        values: dict[str, Value] = {
            "action": action.value,
            "owner": record.purpose,
            "token": record.number,
            "pid": record.pid,
            "program": record.program,
            "held_s": held_s,
            "looked": True,
        }
        self._writer.write(self._motor, values)
