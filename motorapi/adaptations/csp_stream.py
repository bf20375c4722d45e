"""Cyclic synchronous position: one target per SYNC, for as long as there is one."""

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, final

from motorapi.adaptations.canopen_errors import SdoAborted
from motorapi.adaptations.cia402_objects import ENABLE_OPERATION, Mode
from motorapi.errors import UnsupportedError, UsageError

if TYPE_CHECKING:
    from motorapi.adaptations.cia402_hardware import Cia402HwMotor

_SETPOINT: Final = struct.Struct("<IB3xHi2x")


@final
class CspStream:
    """Set-points in csp (CiA 402-2, cyclic synchronous position mode), one before each SYNC.

    The target of cycle k is sent right after SYNC k-1 and latched by SYNC k, so the frames of a
    cycle have a whole period to pass the bus. Cycle 0 is the position the drive holds now.

    Attributes:
        sent: set-points sent.
        late: set-points that were still waiting for the bus when their SYNC was sent.
        ended: whether the last target has been latched.
        error: what `next_target` raised, if it did; the stream ends with that.
    """

    def __init__(
        self, hardware: "Cia402HwMotor", period_s: float, next_target: Callable[[int], int | None]
    ) -> None:
        facts = hardware.connect()
        can_id = facts.latched_ids.get(0x607A)
        if can_id is None:
            raise UnsupportedError(
                motor=hardware.label,
                feature="csp streaming",
                supported="; ".join(facts.limitations),
            )
        period_ms = round(period_s * 1e3)
        if not 1 <= period_ms <= 255 or abs(period_ms / 1e3 - period_s) > 1e-9:
            raise UsageError(f"period_s = {period_s}: whole milliseconds, 1 to 255 (60C2h)")
        self._hardware = hardware
        self._next_target = next_target
        self._can_id = can_id
        self._cycle = 0
        self._target = 0
        self.sent = 0
        self.late = 0
        self.ended = False
        self.error: Exception | None = None
        self._set_up(period_ms)
        self._last_sent = hardware.link.send_tracked(self._frame(self._target))
        self._registration = hardware.link.on_sync(period_s, self._after_sync)

    def _set_up(self, period_ms: int) -> None:
        hardware = self._hardware
        try:
            for subindex, value in ((1, period_ms), (2, -3)):
                if hardware.objects.read_optional(0x60C2, subindex) not in (None, value):
                    hardware.objects.push(0x60C2, value, subindex)
        except SdoAborted as error:
            raise UnsupportedError(
                motor=hardware.label,
                feature=f"a set-point every {period_ms} ms ({error})",
                supported=self._own_period(),
            ) from error
        # The target must be where the drive is before csp looks at it.
        held = hardware.objects.read_optional(0x6062)
        self._target = hardware.objects.read_int(0x6064) if held is None else held
        hardware.write(0x607A, self._target)
        hardware.set_mode(Mode.CYCLIC_SYNC_POSITION)

    def _own_period(self) -> str:
        value = self._hardware.objects.read_optional(0x60C2, 1)
        exponent = self._hardware.objects.read_optional(0x60C2, 2)
        return f"one every {value} x 10^{exponent} s (60C2h)"

    def _frame(self, target: int) -> bytes:
        return _SETPOINT.pack(self._can_id, 6, ENABLE_OPERATION, target)

    def _after_sync(self) -> None:
        """SYNC k was queued: what follows it on the wire is the target of cycle k + 1."""
        if self._cycle and self._last_sent.time_ns is None:
            self.late += 1
        self._cycle += 1
        try:
            target = self._next_target(self._cycle)
        except Exception as error:  # the application's own: it is told by whoever waits
            self.error = error
            target = None
        if target is None:
            self.cancel()
            return
        self._target = target
        self.sent += 1
        self._last_sent = self._hardware.link.send_tracked(self._frame(target))

    @property
    def target(self) -> int:
        """The last target sent, in increments."""
        return self._target

    def cancel(self) -> None:
        """No more set-points; the drive holds the last one."""
        if not self.ended:
            self.ended = True
            self._registration.cancel()
