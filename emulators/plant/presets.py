"""Named plants: plausible examples, and commercial motors."""

from typing import Final

from emulators.plant.data_sheets import DATA_SHEETS
from emulators.plant.dc_motor import MotorPlant

# A 24 V, 60 W brushed motor of 30 mm, as several makers offer: about 8,800 rpm, 1 N m at stall, 3
# ms mechanical time constant. A planetary gear drives a rover's wheel of 0.1 m radius.
WHEEL_60W: Final = MotorPlant(
    resistance_ohm=0.611,
    inductance_h=0.119e-3,
    torque_constant_n_m_a=0.0259,
    rotor_inertia_kg_m2=3.37e-6,
    encoder_increments_rev=2000,
    supply_v=24.0,
    current_max_a=8.0,
    coulomb_friction_n_m=4.0e-3,
    viscous_friction_n_m_s_rad=1.0e-6,
    gear_ratio=66.0,
    load_inertia_kg_m2=0.05,
)

# The same motor with a higher gear ratio, turning a wheel about its vertical axis.
STEERING_60W: Final = MotorPlant(
    resistance_ohm=0.611,
    inductance_h=0.119e-3,
    torque_constant_n_m_a=0.0259,
    rotor_inertia_kg_m2=3.37e-6,
    encoder_increments_rev=2000,
    supply_v=24.0,
    current_max_a=8.0,
    coulomb_friction_n_m=5.0e-3,
    viscous_friction_n_m_s_rad=1.0e-6,
    gear_ratio=100.0,
    load_inertia_kg_m2=0.02,
)

# A 24 V, 20 W motor of 25 mm behind a gear, for a camera mast's pan or tilt.
MAST_20W: Final = MotorPlant(
    resistance_ohm=2.32,
    inductance_h=0.238e-3,
    torque_constant_n_m_a=0.0234,
    rotor_inertia_kg_m2=1.05e-6,
    encoder_increments_rev=2000,
    supply_v=24.0,
    current_max_a=3.0,
    coulomb_friction_n_m=1.5e-3,
    viscous_friction_n_m_s_rad=5.0e-7,
    gear_ratio=100.0,
    load_inertia_kg_m2=0.01,
)

PLAUSIBLE: Final[dict[str, MotorPlant]] = {
    "wheel_60w": WHEEL_60W,
    "steering_60w": STEERING_60W,
    "mast_20w": MAST_20W,
}
PRESETS: Final[dict[str, MotorPlant]] = {**PLAUSIBLE, **DATA_SHEETS}
