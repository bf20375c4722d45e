"""Several hosts on a rig's bus, and a foreign SYNC producer."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import can
import canopen

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.group import MotorGroup
from motorhil.motorapi.model import MotorModel

SYNC = 0x080
MODEL = MotorModel(name="wheel", velocity_max=3.0, acceleration_max=10.0)


@contextmanager
def host_with(
    rig: Rig, *node_ids: int, period_ms: int = 5, servo_ms: float | None = 1.0
) -> Iterator[list[Cia402Motor]]:
    """Return motors on these nodes, on a bus object of their own."""
    options = HwOptions(set_point_period_ms=period_ms, servo_period_ms=servo_ms)
    with can.Bus(interface="emulated", channel="can0") as bus:
        hardware = [Cia402HwMotor(bus, node_id=one, options=options) for one in node_ids]
        try:
            yield [Cia402Motor(one, MODEL, name=f"node{one.node_id}") for one in hardware]
        finally:
            for one in hardware:
                one.close()


@contextmanager
def foreign_sync(period_s: float) -> Iterator[canopen.Network]:
    """Run canopen's own SYNC producer, a foreign one, during the block."""
    with can.Bus(interface="emulated", channel="can0") as bus:
        network = canopen.Network(bus)
        network.sync.start(period_s)
        try:
            yield network
        finally:
            network.sync.stop()


class BusEvidence:
    """The SYNCs on the bus and the set-points that they latch, of all senders."""

    def __init__(self, rig: Rig) -> None:
        self.frames: list[tuple[int, str, int, bytes]] = []
        rig.world.tap_frames(self._on_frame)

    def _on_frame(self, bus: str, time_ns: int, sender: str, frame: bytes) -> None:
        can_id = int.from_bytes(frame[:4], "little")
        if can_id == SYNC or 0x301 <= can_id <= 0x47F:
            self.frames.append((time_ns, sender, can_id, frame[8 : 8 + frame[4]]))

    def syncs(self, sender: str | None = None) -> list[int]:
        """Return the times of SYNCs of this sender (None: of all) on the bus [ns]."""
        return [
            time_ns
            for time_ns, who, can_id, _ in self.frames
            if can_id == SYNC and sender in (None, who)
        ]

    def producers(self) -> set[str]:
        return {who for _, who, can_id, _ in self.frames if can_id == SYNC}

    def gaps_ns(self) -> list[int]:
        return [later - earlier for earlier, later in pairwise(self.syncs())]

    def fired(self) -> list[set[int]]:
        """Return the set-points (bits 4 and 5 set, by RPDO) that each SYNC started, if any."""
        result: list[set[int]] = []
        waiting: dict[int, bool] = {}
        for _, _, can_id, data in self.frames:
            if can_id != SYNC:
                waiting[can_id] = bool(data[0] & 0x30)  # the last one before SYNC counts
                continue
            started = {one for one, counts in waiting.items() if counts}
            if started:
                result.append(started)
            waiting.clear()
        return result


def group_of(*motors: Cia402Motor) -> MotorGroup:
    return MotorGroup(*motors)
