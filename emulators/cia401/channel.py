"""A channel of an I/O node: torque amplifier, motor and encoder.

The amplifier is a plain one for a brushed motor in current mode, with an analogue input of +-10 V,
an enable input, and two outputs. *Ready*: it drives the current commanded by its input. *Fault*: it
has switched itself off. The amplifier stays off until the enable input is removed and the cause is
gone. The amplifier does not know positions and speeds, and does not monitor its host.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia401.settings import ChannelSettings
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.plant.dc_motor import RANGES
from motorhil.emulators.settings.motor import axis_of

VOLT_PER_RAW: Final = 10.0 / 32768.0  # 6411h: +-10 V, left-adjusted in 16 bits
READY: Final = 1
FAULT: Final = 2
STIMULI: Final = ("load_torque_n_m", "fault", "power")

_AT_ONCE: Final = 1e300  # a slope: only the amplifier's own current loop limits it


@final
class Channel:
    """One amplifier with its motor and encoder. All calls come after `axis.at(now_ns)`.

    Attributes:
        axis: the motor, of which only the current is controlled here.
        inputs: READY and FAULT, as the node's digital inputs see them.
        due_ns: when `settle` must be called at the latest.
    """

    def __init__(self, settings: ChannelSettings, clock_rate: float) -> None:
        self.axis: Axis = axis_of(settings, clock_rate)
        self.inputs: int = 0
        self.due_ns: int = NEVER
        self._ampere_per_raw: Final = settings.current_per_volt_a_v * VOLT_PER_RAW
        self._enable_ns: Final = settings.enable_ns
        self._output_raw: int = 0
        self._enabled: bool = False
        self._supplied: bool = True
        self._failing: bool = False
        self._is_applied: bool = True

    # --- outputs of the node

    def set_output(self, raw: int) -> None:
        """Set the analogue output (6411h)."""
        if raw != self._output_raw:
            self._output_raw = raw
            self._is_applied = False

    def set_enabled(self, enabled: bool) -> None:
        """Set the digital output for the enable input."""
        self._enabled = enabled

    def settle(self, now_ns: int) -> None:
        """Update the amplifier from its inputs, up to `now_ns`."""
        if not self._enabled and not self._failing:
            self.inputs &= ~FAULT
        if not self._enabled or not self._supplied or self.inputs & FAULT:
            self.due_ns = NEVER
            if self.inputs & READY:
                self.inputs &= ~READY
                self.axis.power(False)
            return
        if not self.inputs & READY:
            if self.due_ns == NEVER:
                self.due_ns = now_ns + self._enable_ns
            if now_ns < self.due_ns:
                return
            self.due_ns = NEVER
            self.inputs |= READY
            self.axis.power(True)
            self._is_applied = False
        if not self._is_applied:
            self._is_applied = True
            self.axis.apply_current(self._output_raw * self._ampere_per_raw, _AT_ONCE)

    # --- physical stimuli

    def stimulate(self, name: str, value: float) -> None:
        """Set the load at the output [N m], a cause for a fault (1, 0), or the supply (1, 0).

        Raises:
            ValueError: the stimulus is unknown, or the value is invalid.
        """
        if name == "load_torque_n_m":
            low, high = RANGES[name]
            if not low <= value <= high:
                raise ValueError(f"load_torque_n_m is {low:g}..{high:g} N m, not {value}")
            self.axis.set_load(value)
            return
        if name not in STIMULI:
            raise ValueError(f"there is no stimulus {name!r}")
        if value not in (0, 1):
            raise ValueError(f"{name} is 0 or 1, not {value}")
        if name == "power":
            self._supplied = value == 1
        else:
            self._failing = value == 1
            if self._failing:
                self.inputs |= FAULT

    def truth(self, prefix: str, found: dict[str, float]) -> None:
        """Add the true state to `found`; rad and N m are behind the gear."""
        axis = self.axis
        found[prefix + "position_rad"] = axis.output_position_rad()
        found[prefix + "velocity_rad_s"] = axis.output_velocity_rad_s()
        found[prefix + "position_inc"] = float(axis.position_inc())
        found[prefix + "output_v"] = self._output_raw * VOLT_PER_RAW
        found[prefix + "current_a"] = axis.current_a()
        found[prefix + "torque_n_m"] = axis.torque_n_m()
        found[prefix + "ready"] = float(self.inputs & READY)
