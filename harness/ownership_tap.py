"""Conversion of ownership announcements into lock events of the record.

Programs identify a motor by its bus and node (OwnershipNotice); the record uses the rig's name. If
no motor of the rig is on the node, the record uses the name of its controller, or of its bus and
number.

Announcements of the rig's own process must repeat exactly in every run of a seed. So no pid is
recorded for them.
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
