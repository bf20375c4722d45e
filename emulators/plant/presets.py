"""Named plants: plausible examples, and commercial motors.

Commercial motors have no gear and load. Numbers are as printed, converted to SI units. The sheets
give no current limit, because it belongs to the drive. Here the limit is slightly above the stall
current at nominal voltage, so that the power stage can apply the full voltage. The encoder has 500
lines, which both makers offer for these motors. Tests compare the published no-load speed, stall
torque and mechanical time constant with experiments (test_data_sheets).
"""

from typing import Final

from motorhil.emulators.plant.dc_motor import MotorPlant
from motorhil.emulators.plant.nonlinear import PlantExtras

# maxon EC 13, 13 mm, brushless, 6 W, 24 V winding: order number 305194, catalogue page "EC 13".
# Lines 1 (voltage), 3 (no-load current; times the torque constant, this is the friction), 10 to 12,
# 16, 17 to 20 (thermal).
MAXON_EC_13_305194: Final = MotorPlant(
    resistance_ohm=24.6,
    inductance_h=0.357e-3,
    torque_constant_n_m_a=8.03e-3,
    rotor_inertia_kg_m2=0.165e-7,
    encoder_increments_rev=2000,
    supply_v=24.0,
    current_max_a=1.1,
    coulomb_friction_n_m=8.03e-3 * 45.8e-3,
    extras=PlantExtras(
        thermal_resistance_winding_housing_k_w=2.46,
        thermal_resistance_housing_ambient_k_w=32.0,
        thermal_time_constant_winding_s=0.72,
        thermal_time_constant_motor_s=188.0,
    ),
)

# Faulhaber 1331 T 012 SR, 13 mm, ironless with precious-metal commutation: data sheet
# "DC-Micromotors 3,2 mNm, Series 1331 ... SR"; lines 1, 2, 8 (friction), 11 (constant), 14, 16, 18,
# 19.
FAULHABER_1331T012SR: Final = MotorPlant(
    resistance_ohm=13.7,
    inductance_h=310e-6,
    torque_constant_n_m_a=11.4e-3,
    rotor_inertia_kg_m2=0.67e-7,
    encoder_increments_rev=2000,
    supply_v=12.0,
    current_max_a=1.0,
    coulomb_friction_n_m=0.12e-3,
    extras=PlantExtras(
        thermal_resistance_winding_housing_k_w=6.0,
        thermal_resistance_housing_ambient_k_w=25.0,
        thermal_time_constant_winding_s=5.0,
        thermal_time_constant_motor_s=190.0,
    ),
)

# Faulhaber 3564 K 036 B, 35 mm, brushless, 100 W: data sheet "Brushless DC-Servomotors 47,1 mNm,
# Series 3564 ... B"; lines 1, 2, 8 and 9 (friction, static and dynamic: 2.4e-4 mN m per rpm), 12
# (constant), 15, 17, 19, 20.
FAULHABER_3564K036B: Final = MotorPlant(
    resistance_ohm=2.8,
    inductance_h=427e-6,
    torque_constant_n_m_a=29.50e-3,
    rotor_inertia_kg_m2=34e-7,
    encoder_increments_rev=2000,
    supply_v=36.0,
    current_max_a=14.0,
    coulomb_friction_n_m=1.10e-3,
    viscous_friction_n_m_s_rad=2.2918e-6,
    extras=PlantExtras(
        thermal_resistance_winding_housing_k_w=2.5,
        thermal_resistance_housing_ambient_k_w=6.3,
        thermal_time_constant_winding_s=23.0,
        thermal_time_constant_motor_s=1175.0,
    ),
)

DATA_SHEETS: Final[dict[str, MotorPlant]] = {
    "maxon_ec_13_305194": MAXON_EC_13_305194,
    "faulhaber_1331t012sr": FAULHABER_1331T012SR,
    "faulhaber_3564k036b": FAULHABER_3564K036B,
}


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
