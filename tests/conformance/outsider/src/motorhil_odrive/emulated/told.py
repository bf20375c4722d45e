"""Values of the drive's messages, in the order of their layouts."""

from typing import TYPE_CHECKING, Final

from motorhil_odrive.emulated import messages as m

if TYPE_CHECKING:
    from motorhil_odrive.emulated.drive import OdriveController

_VERSION: Final = (2, 4, 4, 58, 0, 6, 10, 0)  # protocol 2; hardware 4.4-58 (S1); firmware 0.6.10-0


def told(drive: "OdriveController", command: int) -> tuple[float, ...]:
    """Return the present values of this message."""
    if command == m.GET_VERSION:
        return _VERSION
    if command == m.HEARTBEAT:
        return drive.errors(), drive.state, drive.result, int(drive.control.trajectory_done)
    if command == m.GET_ERROR:
        return drive.active_errors, drive.disarm_reason
    return _measured(drive, command)


def _measured(drive: "OdriveController", command: int) -> tuple[float, float]:
    control, axis = drive.control, drive.control.axis
    plant = drive.motor.plant
    current_a = axis.current_a()
    shaft_rad_s = axis.output_velocity_rad_s() * plant.gear_ratio
    mechanical_w = plant.torque_constant_n_m_a * current_a * shaft_rad_s
    electrical_w = mechanical_w + plant.resistance_ohm * current_a * current_a
    torque_target_n_m = axis.current_demand_a() * plant.torque_constant_n_m_a
    return {
        m.GET_ENCODER_ESTIMATES: (control.position(), control.velocity()),
        m.GET_IQ: (axis.current_demand_a(), current_a),
        m.GET_TEMPERATURE: (plant.extras.ambient_c, axis.winding_temperature_c()),
        m.GET_BUS_VOLTAGE_CURRENT: (axis.dc_link_v(), electrical_w / axis.dc_link_v()),
        m.GET_TORQUES: (torque_target_n_m, control.torque_n_m()),
        m.GET_POWERS: (electrical_w, mechanical_w),
    }[command]
