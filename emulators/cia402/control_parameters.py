"""Servo gains as objects: current (60F6h), velocity (60F9h), position loop (60FBh).

CiA 402-2 leaves the contents of these three sets to the manufacturer. The meaning below therefore
applies only to a drive with our identity (1018h). In any other EDS they are plain numbers that can
be stored and read.

======== ==== ============================ ===================
object   sub  gain                         unit
======== ==== ============================ ===================
60F6h    1    current loop, P              uV/A
60F6h    2    current loop, I              mV/(A s)
60F9h    1    velocity loop, P             nA s/increment
60F9h    2    velocity loop, I             nA/increment
60FBh    1    position loop, P             1/1000 per s
60FBh    2    velocity feed-forward        1/1000
60FBh    3    acceleration feed-forward    pA s^2/increment
======== ==== ============================ ===================

At power-on they show the tuned gains of the servo, rounded. The servo uses the exact value until a
different value is written.
"""

from typing import Final, final

from emulators.canopen.abort_code import OK, AbortCode
from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.units import limited
from emulators.firmware.gains import ServoGains
from emulators.firmware.servo_tables import tables_of
from emulators.plant.dc_motor import MotorPlant

OUR_VENDOR: Final = 0x0000_0000
OUR_PRODUCT: Final = 0x0000_0402

# Index, sub-index and unit of each ServoGains attribute, in the order of the attributes.
_PLACES: Final = (
    (0x60FB, 1, 1e-3),
    (0x60F9, 1, 1e-9),
    (0x60F9, 2, 1e-9),
    (0x60F6, 1, 1e-6),
    (0x60F6, 2, 1e-3),
    (0x60FB, 2, 1e-3),
    (0x60FB, 3, 1e-12),
)
_UNSIGNED32_MAX: Final = 0xFFFF_FFFF


@final
class Gain:
    """One of the seven gains: its variable, unit and exact tuned value."""

    def __init__(self, variable: Variable, unit: float, exact: float) -> None:
        self.variable = variable
        self.unit = unit
        self.exact = exact
        self.exact_raw: int = min(limited(exact / unit, _UNSIGNED32_MAX), _UNSIGNED32_MAX)

    def value_of(self, raw: int) -> float:
        """Return the gain that `raw` represents."""
        return self.exact if raw == self.exact_raw else raw * self.unit


@final
class ControlParameters:
    """The gains that a host can change.

    Attributes:
        places: the gains' variables; the drive sets their writers.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        plant: MotorPlant,
        gains: ServoGains,
        tick_ns: int,
        current_steps: int,
        clock_rate: float,
    ) -> None:
        self.places: list[Variable] = []
        self._plant = plant
        self._tick_ns = tick_ns
        self._current_steps = current_steps
        self._clock_rate = clock_rate
        self._gains: list[Gain] = []
        exact = (
            gains.position_kp_1_s,
            gains.velocity_kp_a_s_inc,
            gains.velocity_ki_a_inc,
            gains.current_kp_v_a,
            gains.current_ki_v_a_s,
            gains.velocity_feedforward,
            gains.acceleration_feedforward_a_s2_inc,
        )
        ours = od.integer(0x1018, 1, -1) == OUR_VENDOR and od.integer(0x1018, 2, -1) == OUR_PRODUCT
        for place, (index, subindex, unit) in enumerate(_PLACES):
            variable = od.get(index, subindex) if ours else None
            if variable is None:
                variable = Variable(index, subindex, DataType.UNSIGNED32)
            gain = Gain(variable, unit, exact[place])
            if not variable.has_default:
                variable.set_default(gain.exact_raw)
            self._gains.append(gain)
            self.places.append(variable)

    def gains(self) -> ServoGains:
        """Return the gains as they are in the objects now."""
        return self._with(-1, 0)

    def check(self, place: int, raw: int) -> int:
        """Return 0 if `raw` may be written to `place`, else an abort code (unstable servo)."""
        gains = self._with(place, raw)
        try:
            tables_of(self._plant, gains, self._tick_ns, self._current_steps, self._clock_rate)
        except ValueError:
            return AbortCode.INVALID_VALUE
        return OK

    def _with(self, place: int, raw: int) -> ServoGains:
        values = [
            gain.value_of(raw if k == place else gain.variable.integer())
            for k, gain in enumerate(self._gains)
        ]
        return ServoGains(
            position_kp_1_s=values[0],
            velocity_kp_a_s_inc=values[1],
            velocity_ki_a_inc=values[2],
            current_kp_v_a=values[3],
            current_ki_v_a_s=values[4],
            velocity_feedforward=values[5],
            acceleration_feedforward_a_s2_inc=values[6],
        )
