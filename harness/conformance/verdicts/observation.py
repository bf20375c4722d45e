"""Observation of an emulated bench: traffic, true and told motion, for the diagnosis of a failure.

It only listens and reads: no frame is sent, and a check ends as it does without an observer.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.harness.rig.config.faults import HOST
from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import DecodedEvent, Kind
from motorhil.traces.decoding.modbus import ModbusDecoder
from motorhil.traces.formats.modbus import Malformed, adu_of

if TYPE_CHECKING:
    from motorhil.harness.rig.config.rig_file import RigDescription
    from motorhil.harness.rig.rig import Rig
    from motorhil.motorapi import Motor
    from motorhil.motorapi.ownership.physical_motor import ActiveMotion

PERIOD_NS: Final = 5_000_000
_SAMPLES: Final = 4_000
_RECENT: Final = 400
_SERVICES: Final = 20_000
_SYNC: Final = 0x080
_SDO_ANSWER, _SDO_REQUEST, _EMERGENCY_MAX = 0x580, 0x67F, 0x0FF
_RUNS: Final = 8
_SHOWN: Final = 6
_NUMBER: Final = re.compile(r"= ?[-\d.]+")
_SILENT: Final = (Kind.SYNC, Kind.TIME, Kind.HEARTBEAT, Kind.BUS_ERROR)


@final
class Sample(NamedTuple):
    """One instant of a motor; None: not known. U is the unit of its position.

    Attributes: time_ns; truth, velocity: of the plant [U, U/s]; told, told_velocity: the latest
    values heard by the application [U, U/s]; position_inc, demand_inc: of the drive; torque: of the
    motor, at the output [N·m or N]; heard_ns: when the told values were heard.
    """

    time_ns: int
    truth: float | None = None
    velocity: float | None = None
    told: float | None = None
    told_velocity: float | None = None
    position_inc: float | None = None
    demand_inc: float | None = None
    torque: float | None = None
    heard_ns: int | None = None


@final
class Message(NamedTuple):
    """A decoded message of a motor's controller; `is_command`: the host sent it."""

    time_ns: int
    is_command: bool
    event: DecodedEvent

    def __str__(self) -> str:
        return f"{self.time_ns / 1e9:.6f} s {self.event.text}"


Raw = tuple[str, int, str, bytes]
"""(bus, time [ns], sender, frame or ADU)."""


@final
class Observation:
    """The traffic and the motion of one bench since it was switched on.

    Args:
        rig: the open rig.
        description: its description.
        motors: the motors to observe, by name.
        truth_of: the true position, velocity and torque of a motor [U, U/s, N·m or N], and the
            drive's own values.

    Attributes:
        motors: as given.
        samples: by motor.
    """

    def __init__(
        self,
        rig: "Rig",
        description: "RigDescription",
        motors: Mapping[str, "Motor"],
        truth_of: Callable[["Motor"], Mapping[str, float]],
    ) -> None:
        self.motors: Final = motors
        self.samples: Final[dict[str, deque[Sample]]] = {
            name: deque(maxlen=_SAMPLES) for name in motors
        }
        self._runs: dict[str, deque[ActiveMotion]] = {name: deque(maxlen=_RUNS) for name in motors}
        self._description = description
        self._truth_of = truth_of
        self._queue = rig.world.queue
        self._recent: deque[Raw] = deque(maxlen=_RECENT)
        self._services: deque[Raw] = deque(maxlen=_SERVICES)
        self._commands: dict[tuple[str, int], bytes] = {}
        rig.world.tap_frames(self._on_frame)
        rig.world.tap_lines(self._on_adu)
        self._alarm = rig.world.queue.alarm(self._sample)
        self._alarm.set(PERIOD_NS)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        one = (bus, time_ns, sender, frame)
        self._recent.append(one)
        identifier = int.from_bytes(frame[:4], "little") & 0x1FFF_FFFF
        if identifier == _SYNC:
            return
        if identifier <= _EMERGENCY_MAX or _SDO_ANSWER <= identifier <= _SDO_REQUEST:
            self._services.append(one)
            return
        is_command = sender.startswith(HOST) and identifier < _SDO_ANSWER
        if is_command and self._commands.get((bus, identifier)) != frame:
            self._commands[bus, identifier] = frame
            self._services.append(one)

    def _on_adu(
        self, bus: str, now_ns: int, _first: int, _last: int, sender: str, adu: bytes, bad: bool
    ) -> None:
        if not bad:
            self._recent.append((bus, now_ns, sender, adu))

    def _sample(self, now_ns: int) -> None:
        self._alarm.set(now_ns + PERIOD_NS)
        self.look(now_ns)

    def look(self, now_ns: int) -> None:
        """Take a sample of each motor now."""
        for name, motor in self.motors.items():
            truth = self._truth_of(motor)
            run = motor.logical.physical.run
            if run is not None and (not self._runs[name] or self._runs[name][-1] is not run):
                self._runs[name].append(run)
            try:
                latest = motor.latest()
            except Exception:
                latest = None
            self.samples[name].append(
                Sample(
                    now_ns,
                    truth.get("position"),
                    truth.get("velocity"),
                    None if latest is None else latest.position,
                    None if latest is None else latest.velocity,
                    truth.get("position_inc"),
                    truth.get("demand_inc"),
                    truth.get("torque"),
                    None if latest is None else latest.time_ns,
                )
            )

    def targets(self, name: str) -> list[float]:
        """Return the targets of the motor's motions, the last one at the end."""
        return [run.motion.target for run in self._runs[name] if run.motion is not None]

    # --- traffic --------------------------------------------------------------------------

    def messages(self, name: str) -> list[Message]:
        """Return the decoded messages of a motor's controller, without SYNC and heartbeats.

        All services and changed commands are there, and the latest reports.
        """
        described = self._description.motors[name]
        if described.controller is None:
            return []
        controller = self._description.controllers[described.controller]
        bus = controller.bus
        decode = self._line(bus) if self._description.buses[bus].is_line else self._can(bus)
        return [
            one
            for one in decode
            if one.event.node == controller.node_id and one.event.kind not in _SILENT
        ]

    def has_bus(self, name: str) -> bool:
        """Return whether the motor's controller is on an observed bus."""
        return self._description.motors[name].controller is not None

    def _names(self, bus: str) -> dict[int, str]:
        return {
            one.node_id: name
            for name, one in self._description.controllers.items()
            if one.bus == bus and one.node_id is not None
        }

    def _can(self, bus: str) -> Iterator[Message]:
        decoder = CanopenDecoder(self._names(bus))
        recent = [one for one in self._recent if one[0] == bus]
        begin_ns = recent[0][1] if recent else 0
        before = [one for one in self._services if one[0] == bus and one[1] < begin_ns]
        for _, time_ns, sender, frame in (*before, *recent):
            yield Message(time_ns, sender.startswith(HOST), decoder.decode(frame, sender))

    def _line(self, bus: str) -> Iterator[Message]:
        decoder = ModbusDecoder(self._names(bus))
        tcp = self._description.buses[bus].kind == "modbus_tcp"
        for where, time_ns, sender, data in self._recent:
            is_command = sender.startswith(HOST)
            adu = adu_of(time_ns, data, tcp=tcp, to_server=is_command)
            if where == bus and not isinstance(adu, Malformed):
                yield Message(time_ns, is_command, decoder.decode(adu))

    @staticmethod
    def last_of(messages: list[Message]) -> list[str]:
        """Return the last messages as texts; those that differ in values are told once."""
        texts: dict[str, str] = {}
        for one in reversed(messages):
            texts.setdefault(_NUMBER.sub("#", one.event.text), str(one))
            if len(texts) == _SHOWN:
                break
        return list(reversed(texts.values()))
