"""The objects of torque and current, and their units.

Torque is that of the motor shaft, in 1/1000 of the rated torque 6076h [mN m]. Current is in 1/1000
of the rated current 6075h [mA]. Only the motor's torque constant relates the two, so the torque is
correct for any 6075h and 6076h. Where they are 0 or absent, the motor's values are used.
"""

from typing import Final, final

from emulators.canopen.object_dictionary import DataType, ObjectDictionary, Variable
from emulators.cia402.factors import DriveDefaults
from emulators.cia402.units import limited
from emulators.plant.dc_motor import MotorPlant

PERMILLE_MAX: Final = 0x7FFF  # INTEGER16
SLOPE_DEFAULT: Final = 100_000  # 1/1000 of the rated torque per second: the full torque in 10 ms
_UNSIGNED16_MAX: Final = 0xFFFF
_D = DataType


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
        if self.maximum.default == 0:  # as in an EDS without a value
            self.maximum.set_default(most)
        most = -int(-1000.0 * self._motor_current_ma // self._rated_ma())
        most = min(most, _UNSIGNED16_MAX)
        self.maximum_current: Variable = ensure(0x6073, 0, _D.UNSIGNED16, most)
        if self.maximum_current.default == 0:
            self.maximum_current.set_default(most)
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
        positive, negative = self.positive.integer(), self.negative.integer()
        current_a = self.maximum_current.integer() * self._rated_ma() * 1e-6
        return min(min(most, positive) * unit, current_a), min(
            min(most, negative) * unit, current_a
        )

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
