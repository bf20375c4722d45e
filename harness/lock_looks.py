"""Who owns the motors on a SocketCAN interface is looked up, because nobody tells it there.

On a hub, programs say who owns what, in the order of their frames. On SocketCAN there are frames
alone. But who owns a motor is written in its lock's file, for anybody of this host to read who may;
so whoever records such a bus looks there, a few times a second. Looking takes nothing and delays
nobody.

What is found in this way is marked as *looked*, and is less than what is told: an ownership that
began and ended between two looks is missing (tokens show that there was one), an end is noticed up
to a period late, and who waits, or was refused, is not recorded. When an owner began is exact, for
it wrote so itself. Programs that use other lock files (another user's, another MOTORHIL_LOCK_DIR,
another host's) are not seen, nor are those that use none; frames of all of them are recorded under
the one name of the interface. The record says all this in one event, when looking begins.
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
    """Looks at the locks of motors on SocketCAN, and records what has changed.

    Args:
        writer: of lock events.
        world: what serves them; its time is the wall's.
        description: the rig's, for the motors and their names.
        interfaces: bus -> network interface.

    Raises:
        UsageError: there is no such interface.
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
                    name += f"-channel{motor.settings.get('channel', 1)}"  # where motors share it
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
        """What has changed since the last look is recorded now: before nobody looks any more."""
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
    """A motor's lock as it was seen last."""

    def __init__(self, name: str, motor: str, bus: str, writer: LockWriter) -> None:
        self.name: Final = name
        self.bus: Final = bus
        self._motor: Final = motor
        self._writer: Final = writer
        self._token = 0  # of whom it was seen with last
        self._holder: Occupant | None = None  # that one, while it has it
        self._abandoned = 0  # the token of one who has died with it

    def note(self, view: LockView) -> str:
        """What has changed is recorded; in words, if somebody died."""
        if view.holder is None:
            return self._note_free(view)
        record = view.holder.record
        if record is not None and record.number != self._token:  # it has said who it is
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
