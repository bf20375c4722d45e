"""The drive behind MIT frames: an impedance law, its states, watchdog, zero and faults.

The drive has no profile, no limits of velocity and no "target reached". It executes the last
command in every tick of its servo. Classes that derive from this one add the frames.

Positions count turns of the motor. Without power the turns are lost: an encoder on the rotor then
knows the output's position only up to a turn of the motor.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Final

from motorhil.emulators.api import (
    CanMotorDrive,
    ControllerContext,
    ns,
    of_code,
    to_code,
    truncated,
)
from motorhil.emulators.mit.settings import Firmware, Ranges, RangesTable

OVER_VOLTAGE: Final = 1.25  # of the supply's own voltage
UNDER_VOLTAGE: Final = 0.7
OVER_TEMPERATURE_C: Final = 125.0
LIMP: Final = (0.0, 0.0, 0.0, 0.0, 0.0)


class MitDrive(CanMotorDrive):
    """A drive without its frames; derived classes implement `motorhil.emulators.api.Controller`.

    Attributes:
        is_on: whether the motor has current.
        fault: the code of the fault; 0: none.
    """

    def __init__(
        self, table: RangesTable, model: tuple[Firmware, Ranges], context: ControllerContext
    ) -> None:
        motor = table.motor(context.stream())
        super().__init__(motor, model[0].codes, model[0].faults)
        self.plant: Final = motor.plant
        plant = motor.plant
        self.firmware: Final = model[0]
        self.ranges: Ranges = table.ranges(model[1])
        self.node_id: int = table.node_id
        self.axis.set_thresholds(
            over_voltage_v=OVER_VOLTAGE * plant.supply_v,
            under_voltage_v=UNDER_VOLTAGE * plant.supply_v,
            over_temperature_c=OVER_TEMPERATURE_C,
        )
        self.is_on: bool = False
        self.fault: int = 0
        own_s = table.watchdog_s
        self.watchdog_ns: int = ns(self.firmware.watchdog_s if own_s is None else own_s)
        self._boot_up_ns: Final = ns(table.boot_up_s)
        self.inc_rad: Final = plant.gear_ratio * plant.increments_per_rad()
        self._n_m_a: Final = plant.gear_ratio * plant.torque_constant_n_m_a
        self._turn_inc: Final = plant.encoder_increments_rev
        self._command = self._applied = LIMP
        self._zero_count = 0
        self._was_left = False  # since the fault
        self._was_up = False
        self._deaf_ns = 0

    # --- of derived classes ------------------------------------------------------------------

    @abstractmethod
    def identifiers(self) -> Sequence[int] | None:
        """Return the identifiers to which the drive listens."""

    def timed_out(self) -> None:
        """React to missing commands: the motor is limp until the next one."""
        self.order(LIMP)

    # --- Controller --------------------------------------------------------------------------

    def boot(self, now_ns: int) -> None:
        """Begin anew with power."""
        self.due_ns[self._come_up] = now_ns + self._boot_up_ns

    def hears(self, now_ns: int) -> bool:
        """Return whether it has booted, and is not setting its zero."""
        return self._come_up not in self.due_ns and now_ns >= self._deaf_ns

    def watches(self) -> bool:
        """Return whether the plant can cause a fault now."""
        return self.is_on and self.axis.has_extras()

    def inject(self, fault: int) -> None:
        """Cause a fault."""
        self.fail(fault)

    def go_dark(self) -> None:
        """Lose the power, and so the fault."""
        self._off()
        self.fault = 0

    def truth(self) -> Mapping[str, float]:
        """Return the last command, whether it is on, and the fault."""
        p, v, kp, kd, t = self._command
        return {
            "command_position_rad": p,
            "command_velocity_rad_s": v,
            "command_kp_n_m_rad": kp,
            "command_kd_n_m_s_rad": kd,
            "command_torque_n_m": t,
            "is_on": float(self.is_on),
            "fault": float(self.fault),
        }

    # --- states ------------------------------------------------------------------------------

    def enable(self) -> None:
        """Give the motor current, unless a fault remains; the last command acts."""
        if self.is_on:
            return
        if self.fault and not self._was_left:
            self.warn(f"enabling refused: fault {self.fault}; leave motor mode first")
        elif self.clear():
            self.is_on = True
            self.axis.power(True)
            self._feed()
            self._apply()

    def leave(self) -> None:
        """Take the motor's current; it coasts."""
        self._was_left = True
        self._off()
        if not self.firmware.keeps_command:
            self._command = LIMP

    def clear(self) -> bool:
        """Clear the fault if its cause is gone; return True if there is none any more."""
        causes = self.causes()
        if causes:
            self.warn(f"fault {causes[0]} remains: its cause is still there")
        else:
            self.fault = 0
        return not causes

    def fail(self, code: int) -> None:
        """Take the motor's current because of a fault."""
        self.fault = code
        self._was_left = False
        self.note("error", f"fault {code}: the motor is off")
        self._off()

    def set_zero(self) -> None:
        """Make the present position the zero; a command acts on the new positions."""
        self._zero_count = self.axis.count()
        self.axis.set_position(0)
        self._deaf_ns = self.now_ns + ns(self.firmware.zero_s)
        if self.is_on:
            self._apply()

    def order(self, command: tuple[float, float, float, float, float]) -> None:
        """Obey p [rad], v [rad/s], kp, kd, t [N m] from the next tick on, and while enabled."""
        self._command = command
        self._feed()
        if self.is_on and command != self._applied:
            self._apply()

    def measured(self) -> tuple[float, float, float]:
        """Return position [rad], velocity [rad/s] and torque [N m] at the output."""
        axis = self.axis
        inc_rad = self.inc_rad
        return (
            axis.position_inc() / inc_rad,
            axis.velocity_inc_s() / inc_rad,
            axis.torque_n_m(),
        )

    def measured_codes(self, bits: int, *, saturates: bool = True) -> list[int]:
        """Return the codes of what is measured: position with 16 bits, the others with so many."""
        r, sizes = self.ranges, (16, bits, bits)
        of_each = zip(self.measured(), (r.p, r.v, r.t), sizes, strict=True)
        codes = [to_code(*one) for one in of_each]
        if not saturates:
            return codes
        return [truncated(*one, signed=False) for one in zip(codes, sizes, strict=True)]

    def order_codes(self, codes: Sequence[int], bits: int) -> None:
        """Obey the codes of p, v, kp, kd, t: position has 16 bits, the others so many."""
        p, v, kp, kd, t = codes
        r = self.ranges
        gains = of_code(kp, r.kp, bits, 0.0), of_code(kd, r.kd, bits, 0.0)
        self.order((of_code(p, r.p, 16), of_code(v, r.v, bits), *gains, of_code(t, r.t, bits)))

    def temperatures_c(self) -> tuple[float, float]:
        """Return the temperatures of power stage (as the housing) and winding [degC]."""
        return self.axis.housing_temperature_c(), self.axis.winding_temperature_c()

    # --- helpers -----------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Update the drive to this time; notice faults of the plant."""
        super().advance(now_ns)
        if self.is_on:
            for cause in self.causes()[:1]:
                self.fail(cause)

    def _miss(self) -> None:
        self.warn(f"no command for {self.watchdog_ns / 1e9:g} s")
        self.timed_out()
        self.wake(self._miss, 0)

    def _come_up(self) -> None:
        axis = self.axis
        self._command = LIMP
        if self._was_up:  # turns are lost
            zero = self._zero_count if self.firmware.keeps_zero else 0
            half = self._turn_inc // 2
            axis.set_position((axis.count() - zero + half) % self._turn_inc - half)
        self._was_up = True

    def _apply(self) -> None:
        p, v, kp, kd, t = self._applied = self._command
        inc_rad = self.inc_rad
        gain = 1.0 / (inc_rad * self._n_m_a)
        self.axis.follow_impedance(p * inc_rad, v * inc_rad, kp * gain, kd * gain, t / self._n_m_a)

    def _feed(self) -> None:
        self.wake(self._miss, self.watchdog_ns if self.is_on else 0)

    def _off(self) -> None:
        self.is_on = False
        self.wake(self._miss, 0)
        self.axis.power(False)
