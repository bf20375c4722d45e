"""Dynamixel servos on a line in virtual time, with a host's raw bytes or the maker's SDK."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.dynamixel.servo import build
from motorhil.emulators.media.serial_line import SerialLine
from motorhil.emulators.simulation.event_queue import EventQueue
from motorhil.emulators.simulation.world import World

MS = 1_000_000
PLANT = {
    "resistance_ohm": 4.017,
    "inductance_h": 1e-3,
    "torque_constant_n_m_a": 0.3867,
    "rotor_inertia_kg_m2": 0.001814,
    "encoder_increments_rev": 4096,
    "supply_v": 5.0,
    "current_max_a": 1.75,
    "coulomb_friction_n_m": 0.01283,
    "viscous_friction_n_m_s_rad": 0.00366,
}


class Bench:
    """Servos named by their ids on a line, booted; the host's end is `send` and `heard`."""

    def __init__(
        self, *servos: Mapping[str, Any], baud: int = 1_000_000, boot: bool = True
    ) -> None:
        self.world = World(EventQueue())
        self.baud = baud
        line = SerialLine("line", baud, "N", 1, silences=False)
        self.world.add_serial_line(line, None)
        self.events: list[str] = []
        self.world.tap_events(lambda _, level, name, text: self.events.append(text))
        self.sent: list[tuple[int, int, str, bytes]] = []
        self.world.tap_lines(
            lambda _, now_ns, start_ns, end_ns, sender, data, spoiled: self.sent.append(
                (start_ns, end_ns, sender, data)
            )
        )
        for own in servos or ({},):
            settings = {"unit": 1, "plant": PLANT, **own}
            context = ControllerContext("servo", Path(), 1, bitrate_bit_s=baud)
            self.world.add_controller(str(settings["unit"]), build(settings, context), "line")
        self.heard = b""
        self._host = self.world.add_line_host("line", "host", self._hear)
        if boot:
            self.run_ms(500)

    def _hear(self, data: bytes, now_ns: int, transmitted: bool) -> None:
        if not transmitted:
            self.heard += data

    @property
    def now_ns(self) -> int:
        return self.world.queue.now_ns

    def run_ms(self, time_ms: float) -> None:
        self.world.queue.run_until(self.now_ns + round(time_ms * MS))

    def send(self, data: bytes) -> None:
        self._host.send(data)

    def ask(self, data: str, time_ms: float = 20.0) -> str:
        """Send bytes and return all that come back, both in hex."""
        self.heard = b""
        self.send(bytes.fromhex(data))
        self.run_ms(time_ms)
        return self.heard.hex().upper()

    def stimulate(self, name: str, value: float, unit: int = 1) -> None:
        self.world.stimulate(str(unit), name, value)

    def truth(self, unit: int = 1) -> Mapping[str, float]:
        return self.world.snapshot(str(unit))


class SdkPort:
    """A port of dynamixel-sdk on the line of a bench: reading lets its time pass."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.is_using = False
        self._end_ns = 0

    def clearPort(self) -> None:  # noqa: N802 -- the SDK's names
        self.bench.heard = b""

    def getBaudRate(self) -> int:  # noqa: N802
        return self.bench.baud

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.bench.send(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> list[int]:  # noqa: N802
        if not self.bench.heard:
            self.bench.run_ms(0.1)
        data, self.bench.heard = self.bench.heard[:length], self.bench.heard[length:]
        return list(data)

    def setPacketTimeout(self, length: int) -> None:  # noqa: N802
        self.setPacketTimeoutMillis(length * 10_000 / self.bench.baud + 34)

    def setPacketTimeoutMillis(self, time_ms: float) -> None:  # noqa: N802
        self._end_ns = self.bench.now_ns + round(time_ms * MS)

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return self.bench.now_ns > self._end_ns
