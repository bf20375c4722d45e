"""Set-points from inputs, as in an ODrive's controller.

The motor, the servo and the profile generator are motorhil's (`motorhil.emulators.firmware.axis`).
This module gives them ODrive's meaning. Positions are turns of the motor.

| control    | input        | the axis                                            |
| ---------- | ------------ | --------------------------------------------------- |
| POSITION   | PASSTHROUGH  | steps there at once, with the given feedforward     |
| POSITION   | TRAP_TRAJ    | a trapezoid from the present set-point              |
| VELOCITY   | PASSTHROUGH  | that velocity, at once                              |
| VELOCITY   | VEL_RAMP     | a ramp                                              |
| TORQUE     | PASSTHROUGH  | that torque, at once                                |
| TORQUE     | TORQUE_RAMP  | a ramp                                              |
| any        | INACTIVE     | inputs change nothing                               |
"""

from dataclasses import dataclass, replace
from typing import Final, final

from motorhil.emulators.api import Axis, MotorSettings
from motorhil.emulators.api import flags as f

from motorhil_odrive.emulated.messages import ControlMode, InputMode
from motorhil_odrive.emulated.settings import OdriveTable

_AT_ONCE: Final = 1e9  # a ramp without duration [rev/s^2]
_SLOPE: Final = 1e300  # likewise [A/s]
_SMALLEST: Final = 1e-9  # replaces 0, with which a motion would never end

_INPUT_MODES: Final = {
    ControlMode.POSITION_CONTROL: (InputMode.PASSTHROUGH, InputMode.TRAP_TRAJ),
    ControlMode.VELOCITY_CONTROL: (InputMode.PASSTHROUGH, InputMode.VEL_RAMP),
    ControlMode.TORQUE_CONTROL: (InputMode.PASSTHROUGH, InputMode.TORQUE_RAMP),
}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class Parameters:
    """The configuration that CANSimple can write, with ODrive's defaults.

    Velocities in rev/s, accelerations in rev/s^2, of the motor. None: the plant's own value.
    """

    control_mode: ControlMode = ControlMode.POSITION_CONTROL
    input_mode: InputMode = InputMode.PASSTHROUGH
    velocity_limit: float = 10.0
    current_limit_a: float | None = None
    traj_velocity: float = 2.0
    traj_acceleration: float = 0.5
    traj_deceleration: float = 0.5
    inertia: float | None = None  # [N m/(rev/s^2)]
    position_gain: float | None = None  # [1/s]
    velocity_gain: float | None = None  # [N m/(rev/s)]
    velocity_integrator: float | None = None  # [N m/rev]


@final
class Control:
    """The set-points of one axis; call every method after `axis.at` of the same time.

    Attributes:
        axis: the motor's axis.
        parameters: the active parameters.
        is_armed: whether the motor has current.
        trajectory_done: whether the set-point has reached the end of its trapezoid.
        torque_target_n_m: the last torque input.
    """

    def __init__(self, axis: Axis, motor: MotorSettings, settings: OdriveTable) -> None:
        self.axis: Final = axis
        self._motor: Final = motor
        self.parameters = Parameters()
        self.is_armed = False
        self.trajectory_done = True
        self.torque_target_n_m = 0.0
        self._settings = settings
        self._inc = motor.plant.encoder_increments_rev
        self._torque_constant = motor.plant.torque_constant_n_m_a
        self._velocity = 0.0
        self._positions = False  # whether the axis follows a position
        self._feed_forward = True

    # --- measurements ------------------------------------------------------------------------

    def position(self) -> float:
        """Return the motor's position [rev]."""
        return self.axis.position_inc() / self._inc

    def velocity(self) -> float:
        """Return the motor's velocity [rev/s]."""
        return self.axis.velocity_inc_s() / self._inc

    def torque_n_m(self) -> float:
        """Return the torque of the motor's current at its shaft [N m]."""
        return self.axis.current_a() * self._torque_constant

    def is_too_fast(self) -> bool:
        """Return whether the motor exceeds the tolerance of the velocity limit."""
        return abs(self.velocity()) > 1.2 * self.parameters.velocity_limit

    # --- power ---------------------------------------------------------------------------------

    def power_on(self, parameters: Parameters) -> None:
        """Activate these parameters, and forget the former position reference."""
        self.disarm()
        self.take(parameters)
        self.axis.set_position(self.axis.count())

    def arm(self) -> None:
        """Switch the motor's current on, at rest in its position."""
        self.is_armed = True
        self._feed(True)
        self.axis.power(True)
        self._velocity = self.torque_target_n_m = 0.0
        self._enter()

    def disarm(self) -> None:
        """Switch the motor's current off; it coasts."""
        self.is_armed = False
        self.trajectory_done = True
        self._positions = False
        self.torque_target_n_m = 0.0
        self.axis.power(False)

    # --- inputs ----------------------------------------------------------------------------------

    def set_mode(self, control: ControlMode, mode: InputMode) -> bool:
        """Activate these modes; return False if they cannot be combined."""
        if mode is not InputMode.INACTIVE and mode not in _INPUT_MODES.get(control, ()):
            return False
        self.parameters = replace(self.parameters, control_mode=control, input_mode=mode)
        if self.is_armed:
            self._enter()
        return True

    def take(self, parameters: Parameters) -> None:
        """Activate these parameters; an active motion keeps its profile."""
        plant, mine = self._motor.plant, self._motor.gains
        self.parameters = parameters
        amps = plant.current_max_a
        self.axis.set_current_limit(
            amps if parameters.current_limit_a is None else parameters.current_limit_a
        )
        a_inc = 1.0 / (self._torque_constant * self._inc)
        kp, ki, inertia = (
            *(parameters.velocity_gain, parameters.velocity_integrator),
            parameters.inertia,
        )
        feed = mine.acceleration_feedforward_a_s2_inc if inertia is None else inertia * a_inc
        gain = parameters.position_gain
        self.axis.set_gains(
            replace(
                mine,
                position_kp_1_s=mine.position_kp_1_s if gain is None else gain,
                velocity_kp_a_s_inc=mine.velocity_kp_a_s_inc if kp is None else kp * a_inc,
                velocity_ki_a_inc=mine.velocity_ki_a_inc if ki is None else ki * a_inc,
                velocity_feedforward=1.0 if self._feed_forward else 0.0,
                acceleration_feedforward_a_s2_inc=feed if self._feed_forward else 0.0,
            )
        )

    def input_position(self, rev: float, feed_rev_s: float, feed_n_m: float) -> None:
        """Handle Set_Input_Pos (0Ch)."""
        if self._is_deaf(ControlMode.POSITION_CONTROL):
            return
        target = round(rev * self._inc)
        if self.parameters.input_mode is InputMode.TRAP_TRAJ:
            self._move(target)
            return
        self._positions = True
        self.trajectory_done = True
        self._feed(False)
        limit = self.parameters.velocity_limit
        fed = max(-limit, min(limit, feed_rev_s))
        self.axis.follow(target, 0, fed * self._inc)
        self.axis.feed_current(feed_n_m / self._torque_constant)

    def input_velocity(self, rev_s: float, feed_n_m: float) -> None:
        """Handle Set_Input_Vel (0Dh)."""
        self._velocity = rev_s
        if not self._is_deaf(ControlMode.VELOCITY_CONTROL):
            self._run()
            self.axis.feed_current(feed_n_m / self._torque_constant)

    def input_torque(self, n_m: float) -> None:
        """Handle Set_Input_Torque (0Eh)."""
        self.torque_target_n_m = n_m
        if not self._is_deaf(ControlMode.TORQUE_CONTROL):
            self._push()

    def call_here(self, rev: float) -> None:
        """Set the present position to this value (19h); the set-point changes with it."""
        self.axis.set_position(round(rev * self._inc))

    def home_run(self, way: int) -> None:
        """Run towards (-1) or away from (1) the end stop, along a ramp."""
        self._positions = False
        self._feed(True)
        self._at(way * self._settings.homing_speed_rev_s, self._settings.velocity_ramp_rev_s2)

    def rest(self) -> None:
        """Brake, and hold the position of rest."""
        self._positions = True
        self.trajectory_done = False
        slower = max(self.parameters.traj_deceleration, _SMALLEST)
        self.axis.ramp_to_rest(slower * self._inc)

    def settle(self) -> None:
        """Note the end of a trapezoid."""
        if self._positions and not self.axis.flags & f.PROFILE_ACTIVE:
            self.trajectory_done = True

    # --- helpers -------------------------------------------------------------------------------

    def _is_deaf(self, wanted: ControlMode) -> bool:
        own = self.parameters
        return (
            not self.is_armed
            or own.control_mode is not wanted
            or own.input_mode is InputMode.INACTIVE
        )

    def _enter(self) -> None:
        """Begin the mode without a step of position, with the last inputs."""
        control, mode = self.parameters.control_mode, self.parameters.input_mode
        self._positions = False
        if mode is InputMode.INACTIVE:
            return
        if control is ControlMode.POSITION_CONTROL:
            if mode is InputMode.TRAP_TRAJ:
                self._move(self.axis.position_inc())
            else:
                self.input_position(self.position(), 0.0, 0.0)
        elif control is ControlMode.VELOCITY_CONTROL:
            self._run()
        else:
            self._push()

    def _move(self, target_inc: int) -> None:
        own, inc = self.parameters, self._inc
        self._feed(True)
        self._positions = True
        self.trajectory_done = False
        self.axis.move_to(
            target_inc,
            max(min(own.traj_velocity, own.velocity_limit), _SMALLEST) * inc,
            max(own.traj_acceleration, _SMALLEST) * inc,
            max(own.traj_deceleration, _SMALLEST) * inc,
        )

    def _run(self) -> None:
        ramps = self.parameters.input_mode is InputMode.VEL_RAMP
        self._feed(ramps)
        self._at(self._velocity, self._settings.velocity_ramp_rev_s2 if ramps else _AT_ONCE)

    def _at(self, rev_s: float, ramp: float) -> None:
        limit = self.parameters.velocity_limit
        wanted = max(-limit, min(limit, rev_s))
        self.axis.run_at(wanted * self._inc, ramp * self._inc, ramp * self._inc)

    def _push(self) -> None:
        ramps = self.parameters.input_mode is InputMode.TORQUE_RAMP
        slope = self._settings.torque_ramp_n_m_s / self._torque_constant if ramps else _SLOPE
        amps = self.torque_target_n_m / self._torque_constant
        self.axis.apply_current(amps, slope, self.parameters.velocity_limit * self._inc)

    def _feed(self, forward: bool) -> None:
        """Feed forward a trapezoid's velocity and acceleration, or only the values of an input."""
        if forward != self._feed_forward:
            self._feed_forward = forward
            self.take(self.parameters)
