"""Frames of an ODrive in words, for `motorhil show`.

Names and units are those of the message set of firmware 0.6.10, as ODrive describes it in a DBC.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Final

from motorhil.traces.api import EFF, ERR, RTR, BusMessage, Signal, fields

from motorhil_odrive.emulated import messages as cansimple

_UNITS: Final = {
    **dict.fromkeys(("Pos_Estimate", "Input_Pos", "Position"), "rev"),
    **dict.fromkeys(("Vel_Estimate", "Input_Vel", "Vel_FF"), "rev/s"),
    **dict.fromkeys(("Velocity_Limit", "Traj_Vel_Limit"), "rev/s"),
    **dict.fromkeys(("Traj_Accel_Limit", "Traj_Decel_Limit"), "rev/s^2"),
    **dict.fromkeys(("Torque_FF", "Input_Torque_FF", "Input_Torque"), "Nm"),
    **dict.fromkeys(("Torque_Target", "Torque_Estimate"), "Nm"),
    **dict.fromkeys(("Iq_Setpoint", "Iq_Measured", "Bus_Current", "Current_Limit"), "A"),
    **dict.fromkeys(("FET_Temperature", "Motor_Temperature"), "deg C"),
    **dict.fromkeys(("Electrical_Power", "Mechanical_Power"), "W"),
    "Bus_Voltage": "V",
    "Traj_Inertia": "Nm/(rev/s^2)",
    "Pos_Gain": "(rev/s) / rev",
    "Vel_Gain": "Nm / (rev/s)",
    "Vel_Integrator_Gain": "Nm / rev",
}
_WORDS: Final[dict[str, type[IntEnum]]] = {
    "Axis_State": cansimple.AxisState,
    "Axis_Requested_State": cansimple.AxisState,
    "Procedure_Result": cansimple.ProcedureResult,
    "Axis_Error": cansimple.Error,
    "Active_Errors": cansimple.Error,
    "Disarm_Reason": cansimple.Error,
    "Control_Mode": cansimple.ControlMode,
    "Input_Mode": cansimple.InputMode,
    "Action": cansimple.Action,
}
_NAMES: Final = {
    cansimple.GET_VERSION: "Get_Version",
    cansimple.HEARTBEAT: "Heartbeat",
    cansimple.ESTOP: "Estop",
    cansimple.GET_ERROR: "Get_Error",
    cansimple.SET_AXIS_STATE: "Set_Axis_State",
    cansimple.GET_ENCODER_ESTIMATES: "Get_Encoder_Estimates",
    cansimple.SET_CONTROLLER_MODE: "Set_Controller_Mode",
    cansimple.SET_INPUT_POS: "Set_Input_Pos",
    cansimple.SET_INPUT_VEL: "Set_Input_Vel",
    cansimple.SET_INPUT_TORQUE: "Set_Input_Torque",
    cansimple.SET_LIMITS: "Set_Limits",
    cansimple.SET_TRAJ_VEL_LIMIT: "Set_Traj_Vel_Limit",
    cansimple.SET_TRAJ_ACCEL_LIMITS: "Set_Traj_Accel_Limits",
    cansimple.SET_TRAJ_INERTIA: "Set_Traj_Inertia",
    cansimple.GET_IQ: "Get_Iq",
    cansimple.GET_TEMPERATURE: "Get_Temperature",
    cansimple.REBOOT: "Reboot",
    cansimple.GET_BUS_VOLTAGE_CURRENT: "Get_Bus_Voltage_Current",
    cansimple.CLEAR_ERRORS: "Clear_Errors",
    cansimple.SET_ABSOLUTE_POSITION: "Set_Absolute_Position",
    cansimple.SET_POS_GAIN: "Set_Pos_Gain",
    cansimple.SET_VEL_GAINS: "Set_Vel_Gains",
    cansimple.GET_TORQUES: "Get_Torques",
    cansimple.GET_POWERS: "Get_Powers",
    cansimple.ENTER_DFU_MODE: "Enter_DFU_Mode",
}
_LAYOUTS: Final = {**cansimple.TOLD, **cansimple.HEARD}
_SCALED: Final = ("Vel_FF", "Torque_FF")


def build(node_id: int) -> Callable[[bytes], BusMessage | None]:
    """Return the decoder of one drive's frames."""

    def decode(frame: bytes) -> BusMessage | None:
        told = fields(frame)
        if told.can_id & (EFF | ERR | RTR) or told.fd:
            return None
        node, command = divmod(told.can_id, cansimple.COMMAND_MASK + 1)
        if node != node_id or command not in _NAMES:
            return None
        layout, names = _LAYOUTS[command]
        if len(told.data) < layout.size:
            problem = f"{len(told.data)} bytes; {layout.size} are needed"
            return BusMessage(_NAMES[command], problem=problem)
        pairs = zip(names, layout.unpack_from(told.data), strict=True)
        signals = (Signal(name, _value(name, raw), _UNITS.get(name, "")) for name, raw in pairs)
        return BusMessage(_NAMES[command], tuple(signals))

    return decode


def _value(name: str, raw: float) -> float | str:
    """Return a number in its unit, or the name of a number."""
    if name in _SCALED:
        return raw * cansimple.FEED_FORWARD_SCALE
    words = _WORDS.get(name)
    if words is None or not isinstance(raw, int) or raw not in {one.value for one in words}:
        return raw
    return words(raw).name
