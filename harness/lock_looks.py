"""Polled lock files as the record of who owns motors on SocketCAN.

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

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, final

from harness.ownership_tap import LockWriter
from harness.rig_file import RigDescription
from motorapi.errors import UsageError
from motorapi.lock_directory import LockDirectory
from motorapi.lock_names import socketcan_name
from motorapi.lock_view import LockView, look
from traces.protobuf import Value
from traces.schema import LockAction

if TYPE_CHECKING:
    from emulators.world import World
    from motorapi.lock_view import Occupant

PERIOD_NS: Final = 100_000_000


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
