"""What programs say of who owns which motor becomes lock events of the record.

Programs name a motor by its bus and node (`emulators.hub_protocol.OwnershipNotice`); the record
names it as the rig does. What is said of a node that no motor of the rig is on is recorded under
the name of its controller, or of its bus and number.

What programs of the rig's own process say repeats with every run of one seed, so that of them no
process is recorded: a pid never would.
"""

import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from harness.recorder import Recorder
from harness.rig_file import RigDescription
from traces.errors import TraceError
from traces.protobuf import Value
from traces.schema import MOTOR_LOCK

if TYPE_CHECKING:
    from emulators.hub_protocol import OwnershipNotice
    from emulators.world import World
    from motorapi.ownership_events import OwnershipEvent


@final
class MotorNames:
    """What the rig calls who is commanded on a bus."""

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
        """The motor on this node, or on this channel of it (from 1)."""
        motor = self._motors.get((bus, node_id, channel))
        if motor is not None:
            return motor
        node = self._controllers.get((bus, node_id), f"{bus}-node{node_id}")
        return f"{node}-channel{channel}" if channel else node


@final
class LockWriter:
    """Writes lock events to `/motor/<name>/lock`.

    An error of the record is raised by the next event of the world's, not in the middle of a
    program's taking of its motor.
    """

    def __init__(self, recorder: Recorder, world: "World") -> None:
        self._recorder: Final = recorder
        self._queue: Final = world.queue

    def write(self, motor: str, values: dict[str, Value]) -> None:
        """A lock event of this motor is recorded; what is "", 0 or False was not told."""
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
    """Hears on all buses who owns what; see `World.tap_ownership`."""

    def __init__(self, writer: LockWriter, names: MotorNames) -> None:
        self._writer: Final = writer
        self._names: Final = names
        self._own_pid: Final = os.getpid()

    def heard(self, bus: str, time_ns: int, sender: str, notice: "OwnershipNotice") -> None:
        """A host on the bus said it, just now."""
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
    """Hears from a motor of this process itself who owns it: one that no bus tells of."""

    def __init__(self, writer: LockWriter, motor: str) -> None:
        self._writer: Final = writer
        self._motor: Final = motor

    def heard(self, event: "OwnershipEvent") -> None:
        """It happened, just now; see `motorapi.ownership_events`."""
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
