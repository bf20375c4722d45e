"""The objects of torque, servo gains, and offsets of the cyclic modes.

Torque is that of the motor shaft, in 1/1000 of the rated torque 6076h [mN m]. Current is in 1/1000
of the rated current 6075h [mA]. Only the motor's torque constant relates the two, so the torque is
correct for any 6075h and 6076h. Where they are 0 or absent, the motor's values are used.

Servo gains are objects: current (60F6h), velocity (60F9h) and position loop (60FBh). CiA 402-2
leaves the contents of these three sets to the manufacturer. The meaning below therefore
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

from motorhil.emulators.canopen.codes import OK, AbortCode
from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from motorhil.emulators.cia402.objects.units import DriveDefaults, FactorGroup, limited
from motorhil.emulators.firmware.servo_tables import ServoGains, tables_of
from motorhil.emulators.plant.dc_motor import MotorPlant

PERMILLE_MAX: Final = 0x7FFF  # INTEGER16
SLOPE_DEFAULT: Final = 100_000  # 1/1000 of the rated torque per second: the full torque in 10 ms
_UNSIGNED16_MAX: Final = 0xFFFF
_D = DataType

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
class TorqueObjects:
    """6071h, 6072h, 6073h, 6075h, 6076h, 6087h, 60E0h, 60E1h in amperes of the motor.

    Attributes:
        target, maximum, maximum_current, slope: 6071h, 6072h, 6073h, 6087h.
        positive, negative: 60E0h, 60E1h.
    """

    def __init__(self, od: ObjectDictionary, plant: MotorPlant, defaults: DriveDefaults) -> None:
        self._torque_n_m_a = plant.torque_constant_n_m_a
        self._motor_current_ma = plant.current_max_a * 1000.0
        self._motor_torque_mn_m = plant.current_max_a * plant.torque_constant_n_m_a * 1000.0
        ensure = od.ensure
        self._rated_current_ma: Variable = ensure(
            0x6075, 0, _D.UNSIGNED32, defaults.rated_current_ma
        )
        self._rated_torque_mn_m: Variable = ensure(
            0x6076, 0, _D.UNSIGNED32, defaults.rated_torque_mn_m
        )
        self.target: Variable = ensure(0x6071, 0, _D.INTEGER16, 0)
        # Rounded up, so that the default does not reduce the motor's torque.
        most = -int(-1000.0 * self._motor_torque_mn_m // self._torque_unit_mn_m())
        most = min(most, _UNSIGNED16_MAX)
        self.maximum: Variable = ensure(0x6072, 0, _D.UNSIGNED16, most)
        most = -int(-1000.0 * self._motor_current_ma // self._rated_ma())
        most = min(most, _UNSIGNED16_MAX)
        self.maximum_current: Variable = ensure(0x6073, 0, _D.UNSIGNED16, most)
        self.positive: Variable = ensure(0x60E0, 0, _D.UNSIGNED16, _UNSIGNED16_MAX)
        self.negative: Variable = ensure(0x60E1, 0, _D.UNSIGNED16, _UNSIGNED16_MAX)
        self.slope: Variable = ensure(0x6087, 0, _D.UNSIGNED32, SLOPE_DEFAULT)

    def target_a(self) -> float:
        """Return the current for the torque 6071h [A]."""
        return self.current_of_a(self.target.integer())

    def current_of_a(self, torque_raw: int) -> float:
        """Return the current for a torque in 1/1000 of 6076h [A]."""
        return torque_raw * self._per_permille_a()

    def limits_a(self) -> tuple[float, float]:
        """Return the forward and backward current limits: 6073h, 6072h, 60E0h, 60E1h [A]."""
        unit, most = self._per_permille_a(), self.maximum.integer()
        positive = self.positive.integer()
        negative = abs(self.negative.integer())  # some vendors' 60E1h has a sign
        current_a = self.maximum_current.integer() * self._rated_ma() * 1e-6
        return min(min(most, positive) * unit, current_a), min(
            min(most, negative) * unit, current_a
        )

    def doubts(self) -> list[str]:
        """Return warnings about power-on limits of 0, which leave no torque; one line each."""
        names = [
            f"{one.index:04X}h" for one in (self.maximum, self.maximum_current) if not one.default
        ]
        remedy = "set it in the rig (objects)"
        return [
            f"{name} is 0 at power-on: no torque until a host writes it; {remedy}" for name in names
        ]

    def slope_a_s(self) -> float:
        """Return 6087h as a slope of the current [A/s]; always > 0."""
        raw = self.slope.integer()
        return (raw if raw > 0 else SLOPE_DEFAULT) * self._per_permille_a()

    def torque_raw(self, current_a: float) -> int:
        """Return the torque of a current [1/1000 of 6076h]."""
        return limited(current_a / self._per_permille_a(), PERMILLE_MAX)

    def current_raw(self, current_a: float) -> int:
        """Return a current [1/1000 of 6075h]."""
        return limited(current_a * 1e6 / self._rated_ma(), PERMILLE_MAX)

    def _rated_ma(self) -> float:
        rated = self._rated_current_ma.integer()
        return float(rated) if rated > 0 else self._motor_current_ma

    def _torque_unit_mn_m(self) -> float:
        rated = self._rated_torque_mn_m.integer()
        return float(rated) if rated > 0 else self._motor_torque_mn_m

    def _per_permille_a(self) -> float:
        return self._torque_unit_mn_m() * 1e-6 / self._torque_n_m_a


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


@final
class OffsetObjects:
    """60B0h, 60B1h and 60B2h (CiA 402-2, cyclic synchronous modes)."""

    def __init__(self, od: ObjectDictionary, factors: FactorGroup, torque: TorqueObjects) -> None:
        self._factors = factors
        self._torque = torque
        self._position = od.ensure(0x60B0, 0, _D.INTEGER32, 0)
        self._velocity = od.ensure(0x60B1, 0, _D.INTEGER32, 0)
        self._torque_offset = od.ensure(0x60B2, 0, _D.INTEGER16, 0)

    def are_set(self) -> bool:
        """Return True if any offset is not 0."""
        return (
            self._position.integer() != 0
            or self._velocity.integer() != 0
            or self._torque_offset.integer() != 0
        )

    def position_inc(self) -> int:
        """Return 60B0h [increments]."""
        return self._factors.units.position_inc(self._position.integer())

    def velocity_inc_s(self) -> float:
        """Return 60B1h [increments/s]."""
        units = self._factors.units
        return self._velocity.integer() * units.velocity_unit_inc_s * units.velocity_sign

    def current_a(self) -> float:
        """Return 60B2h as the current that causes this torque [A]."""
        return self._torque.current_of_a(self._torque_offset.integer())
