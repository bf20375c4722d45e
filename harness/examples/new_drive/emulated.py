"""The emulated drive. Write it from the drive's manual, never from `host`.

Replace it in the order of the numbers. The motor on the shaft, with servo, plant and encoder, is
motorhil's (`axis`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Final, final

from motorhil.emulators.api import (
    REQUIRED,
    CanMotorDrive,
    ControllerContext,
    MotorTable,
    amount,
    drive_builder,
    flags,
    ns,
    number,
    positive,
    whole,
)

# 1. The protocol, read a second time.
_TOLD: Final = Struct("<BBBBH")
_WHERE: Final = Struct("<2i")
_ORDER: Final = Struct("<BBHi")
_WORD: Final = Struct("<I")
_TWO_WORDS: Final = Struct("<2I")
_UNITS: Final = 1 << 16  # per turn of the motor


@final
@dataclass(frozen=True, kw_only=True)
class DriveTable(MotorTable):
    """The drive's table in a rig."""

    # 2. Settings of the drive: what its maker's tool can set. `node_id` is the rig's own name for
    # an address on CAN; whatever its maker calls it, keep this name here and in `host.MotorTable`.
    node_id: int = whole(REQUIRED, 0, 0x3F, "", "Its node-ID.", example="1")
    boot_up_s: float = amount(0.1, "s", "From power-on to the first status.", most=3600)
    period_s: float = number(0.01, 1e-4, 3600, "s", "Period of status and estimate.")
    following_error_rev: float = positive(
        1.0, "rev", "It switches off if its motor is further behind.", most=1e6
    )
    watchdog_s: float = amount(0.1, "s", "It stops without its host; 0: never.", most=3600)


@final
class MydriveController(CanMotorDrive):
    """Implements `motorhil.emulators.api.Controller`; times are int ns."""

    def __init__(self, settings: DriveTable, context: ControllerContext) -> None:
        motor = settings.motor(context.stream())
        self._settings = settings
        super().__init__(motor, range(1, 1 << 16))
        self._inc = motor.plant.encoder_increments_rev
        self._is_on = False
        self._count = self._fault = 0
        self._velocity = self._faster = self._slower = 1.0  # [turns/s, turns/s²]

    # 3. Time: what the drive does by itself, and when: `wake` calls a method after some time.

    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""
        self.axis.set_position(self.axis.count())
        self.due_ns[self._tell] = now_ns + ns(self._settings.boot_up_s)

    def _miss_host(self) -> None:
        self._fault = 3
        self.axis.ramp_to_rest(self._slower * self._inc)

    def _tell(self) -> None:
        """Send status and estimate."""
        self.wake(self._tell, ns(self._settings.period_s))
        axis = self.axis
        behind = abs(axis.following_error_inc()) / self._inc
        if self._is_on and not self._fault and behind > self._settings.following_error_rev:
            self._fault = 4
            self._switch(on=False)
        is_moving = self._is_on and (
            bool(axis.flags & flags.PROFILE_ACTIVE) or not axis.flags & flags.IN_TARGET_WINDOW
        )
        state = 2 if self._fault else int(self._is_on)
        scale = _UNITS / self._inc
        where = round(axis.position_inc() * scale), round(axis.velocity_inc_s() * scale)
        node_id = self._settings.node_id
        self.send(0x180 + node_id, _TOLD.pack(state, self._count, is_moving, 0, self._fault))
        self.send(0x280 + node_id, _WHERE.pack(*where))

    # 4. Frames to the drive.

    def hear(self, can_id: int, data: bytes) -> None:
        """Handle a frame from the bus."""
        if self._miss_host in self.due_ns:
            self._feed()
        kind = can_id - self._settings.node_id
        if kind == 0x200 and len(data) == _ORDER.size:
            code, self._count, _, target = _ORDER.unpack(data)
            self._obey(code, target)
        elif kind == 0x300 and len(data) == _WORD.size:
            self._velocity = max(1, _WORD.unpack(data)[0]) / _UNITS
        elif kind == 0x380 and len(data) == _TWO_WORDS.size:
            faster, slower = _TWO_WORDS.unpack(data)
            self._faster, self._slower = max(1, faster) / _UNITS, max(1, slower) / _UNITS
        elif kind != 0x400:
            self.warn(f"frame {can_id:03X}h with {data.hex()} is not understood")

    def _obey(self, code: int, target: int) -> None:
        if code == 0:
            self._switch(on=False)
        elif code == 4:
            self._fault = 0
            self._switch(on=False)
        elif self._fault:
            self.warn(f"command {code} refused: fault {self._fault}")
        elif code == 1:
            self._switch(on=True)
            self._feed()
        elif code == 2 and self._is_on:
            self.axis.move_to(
                round(target * self._inc / _UNITS),
                self._velocity * self._inc,
                self._faster * self._inc,
                self._slower * self._inc,
            )
        elif code == 3 and self._is_on:
            self.axis.ramp_to_rest(self._slower * self._inc)

    def _switch(self, *, on: bool) -> None:
        if on != self._is_on:
            self._is_on = on
            self.wake(self._miss_host, 0)
            self.axis.power(on)

    def _feed(self) -> None:
        """Begin the time anew after which the drive stops without its host."""
        self.wake(self._miss_host, ns(self._settings.watchdog_s))

    # 5. Physical inputs, for tests and faults of rigs, and true values of the drive's own.

    def inject(self, fault: int) -> None:
        """Cause a fault with this code."""
        self._fault = fault
        self._switch(on=False)

    def go_dark(self) -> None:
        """Lose the power."""
        self._switch(on=False)

    def truth(self) -> Mapping[str, float]:
        """Return the code of the fault."""
        return {"fault": float(self._fault)}

    def identifiers(self) -> Sequence[int] | None:
        """Return the identifiers to which the drive listens."""
        return [kind + self._settings.node_id for kind in (0x200, 0x300, 0x380, 0x400)]


build: Final = drive_builder(DriveTable, MydriveController, api=1)
