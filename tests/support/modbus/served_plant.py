"""Two lines with two drives each, served by another process."""

import subprocess
from pathlib import Path

from tests.system.wall.test_serve import MOTORHIL

LONG_S = 20.0
RIG = """\
bus.plant = {kind = "modbus_tcp", latency_s = 0}
bus.rs485 = {kind = "modbus_rtu", baud_bit_s = 115_200, parity = "N"}
[controller.mast]
kind = "leadshine_pr"
bus = "plant"
unit = 1
timing.boot_up_s = 0
[controller.head]
kind = "oriental_az"
bus = "plant"
unit = 2
timing.boot_up_s = 0
[controller.arm]
kind = "leadshine_pr"
bus = "rs485"
unit = 1
timing.boot_up_s = 0
[controller.hand]
kind = "oriental_az"
bus = "rs485"
unit = 2
timing.boot_up_s = 0
"""


class Server:
    """A process with `motorhil serve`."""

    def __init__(self, folder: Path) -> None:
        self.rig = folder / "rig.toml"
        self.rig.write_text(RIG)
        self.link = folder / "line"
        self.record = folder / "run.mcap"
        doors = ("--modbus-tcp", "127.0.0.1:0", "--modbus-rtu", str(self.link))
        self.process = subprocess.Popen(
            [*MOTORHIL, "serve", str(self.rig), *doors, "-o", str(self.record)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        self.said = [self.process.stdout.readline() for _ in range(2)]
        self.port = int(self.said[0].split(":")[2].split(",")[0])

    def stop(self) -> str:
        """Stop the process and return its last output."""
        if self.process.poll() is None:
            self.process.terminate()
        return self.process.communicate(timeout=LONG_S)[1]
