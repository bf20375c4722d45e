"""Commands to the drive, with finite values that match the layout."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from motorhil_odrive.emulated import messages as m
from motorhil_odrive.emulated.messages import Action, AxisState, ControlMode, Error, InputMode

if TYPE_CHECKING:
    from motorhil_odrive.emulated.drive import OdriveController

_FAR_REV: Final = 1e6  # largest distance or velocity that this emulator accepts


def _estop(drive: "OdriveController") -> None:
    drive.fail(Error.ESTOP_REQUESTED)


def _set_axis_state(drive: "OdriveController", state: int) -> None:
    if state in tuple(AxisState):
        drive.request(AxisState(state))
    else:
        drive.warn(f"there is no axis state {state}")


def _set_controller_mode(drive: "OdriveController", control: int, mode: int) -> None:
    known = control in tuple(ControlMode) and mode in tuple(InputMode)
    if not known or not drive.control.set_mode(ControlMode(control), InputMode(mode)):
        drive.warn(f"control mode {control} with input mode {mode} is not emulated")


def _set_input_pos(drive: "OdriveController", rev: float, velocity: int, torque: int) -> None:
    if _is_sane(drive, "Input_Pos", rev):
        scale = m.FEED_FORWARD_SCALE
        drive.control.input_position(rev, velocity * scale, torque * scale)


def _set_input_vel(drive: "OdriveController", rev_s: float, n_m: float) -> None:
    if _is_sane(drive, "Input_Vel", rev_s):
        drive.control.input_velocity(rev_s, n_m)


def _set_input_torque(drive: "OdriveController", n_m: float) -> None:
    drive.control.input_torque(n_m)


def _set_absolute_position(drive: "OdriveController", rev: float) -> None:
    if _is_sane(drive, "Position", rev):
        drive.control.call_here(rev)


def _reboot(drive: "OdriveController", action: int) -> None:
    if action == Action.SAVE_CONFIGURATION:
        drive.save()
    elif action == Action.ERASE_CONFIGURATION:
        drive.erase()
    if action == Action.ENTER_DFU_MODE:
        _enter_dfu_mode(drive)
    elif action in tuple(Action):
        drive.reboot()
    else:
        drive.warn(f"there is no action {action}")


def _clear_errors(drive: "OdriveController", identify: int) -> None:
    drive.clear_errors()


def _enter_dfu_mode(drive: "OdriveController") -> None:
    drive.note("info", "waits for new firmware, until power goes off and on")
    drive.fall_silent()


def _is_sane(drive: "OdriveController", name: str, value: float) -> bool:
    if abs(value) > _FAR_REV:
        drive.warn(f"{name} = {value:g} is ignored")
        return False
    return True


def _parameters(*names: str) -> "Callable[..., None]":
    """Return a command that sets these parameters; a negative value changes nothing."""

    def write(drive: "OdriveController", *values: float) -> None:
        if any(not 0.0 <= value <= _FAR_REV for value in values):
            drive.warn(f"{', '.join(names)} = {values} is ignored")
            return
        given = dict(zip(names, values, strict=True))
        drive.control.take(replace(drive.control.parameters, **given))  # type: ignore[arg-type]  # names of its own fields

    return write


COMMANDS: "Final[dict[int, Callable[..., None]]]" = {
    m.ESTOP: _estop,
    m.SET_AXIS_STATE: _set_axis_state,
    m.SET_CONTROLLER_MODE: _set_controller_mode,
    m.SET_INPUT_POS: _set_input_pos,
    m.SET_INPUT_VEL: _set_input_vel,
    m.SET_INPUT_TORQUE: _set_input_torque,
    m.SET_LIMITS: _parameters("velocity_limit", "current_limit_a"),
    m.SET_TRAJ_VEL_LIMIT: _parameters("traj_velocity"),
    m.SET_TRAJ_ACCEL_LIMITS: _parameters("traj_acceleration", "traj_deceleration"),
    m.SET_TRAJ_INERTIA: _parameters("inertia"),
    m.REBOOT: _reboot,
    m.CLEAR_ERRORS: _clear_errors,
    m.SET_ABSOLUTE_POSITION: _set_absolute_position,
    m.SET_POS_GAIN: _parameters("position_gain"),
    m.SET_VEL_GAINS: _parameters("velocity_gain", "velocity_integrator"),
    m.ENTER_DFU_MODE: _enter_dfu_mode,
}
