"""The servo's gains as objects: current (60F6h), velocity (60F9h) and position loop (60FBh).

CiA 402-2 leaves what is in these three sets to the manufacturer. So they mean this only in a drive
that is ours by its identity (1018h); in any other file they are numbers that may be kept and read.

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

At power-on they show the gains the servo was tuned to, rounded; until one is written another value
the servo uses the exact one.
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

# Where, and what 1 is in the unit of ServoGains' attribute of this place.
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
    """One of the seven: its variable, and what it stands for."""

    def __init__(self, variable: Variable, unit: float, exact: float) -> None:
        self.variable = variable
        self.unit = unit
        self.exact = exact
        self.exact_raw: int = min(limited(exact / unit, _UNSIGNED32_MAX), _UNSIGNED32_MAX)

    def value_of(self, raw: int) -> float:
        """The gain this number stands for."""
        return self.exact if raw == self.exact_raw else raw * self.unit


@final
class ControlParameters:
    """The gains a host may change.

    Attributes:
        places: their variables; the drive sets the writers.
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
        """As they stand in the objects now."""
        return self._with(-1, 0)

    def check(self, place: int, raw: int) -> int:
        """Whether this may be written there: 0, or an abort code if the servo would be unstable."""
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
