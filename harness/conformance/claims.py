"""The capability claims of the motors on a bench."""

from collections.abc import Callable
from typing import Final, final

from motorhil.harness.conformance.bench import Ability, Opener, RigProtocol
from motorhil.harness.rig.config.conformance import Capability
from motorhil.motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Motor,
    MotorError,
    Setpoint,
    SyncLevel,
    Trajectory,
    TrapezoidalTrajectory,
    UnsupportedError,
)
from motorhil.motorapi.hooks import implements

_MODES: Final = {
    Capability.POSITION_SET_POINT: (ControlMode.SETPOINT, ControlVariable.POSITION),
    Capability.VELOCITY_SET_POINT: (ControlMode.SETPOINT, ControlVariable.VELOCITY),
    Capability.TORQUE_SET_POINT: (ControlMode.SETPOINT, ControlVariable.TORQUE),
    Capability.CURRENT_SET_POINT: (ControlMode.SETPOINT, ControlVariable.CURRENT),
    Capability.POSITION_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.POSITION),
    Capability.VELOCITY_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.VELOCITY),
    Capability.TORQUE_TRAJECTORY: (ControlMode.TRAJECTORY, ControlVariable.TORQUE),
}
_SLOW: Final = (Capability.COMPLEX_POSITION, Capability.COMPLEX_VELOCITY)
"""Capabilities whose check imports numpy, which takes longer than the first verdicts."""
_HOOKS: Final = {
    Capability.LOW_LEVEL: (("_open_low_level",),),
    Capability.HOMING: (("_home",),),
    Capability.FAULTS: (("_read_fault", "_latest_fault"), ("_reset_fault",)),
}
"""The hooks that claim a capability, where an adaptation implements one of each group."""
_LATE: Final = (_SLOW, (Capability.HOMING,))
"""Groups of capabilities that are read when one of them is needed; homing changes the motor."""
_HERE: Final = (37, 35)
"""Methods of homing on the spot (CiA 402-2, 6098h)."""
_READINGS: Final = {
    Capability.MEASURED_TORQUE: Motor.torque,
    Capability.MEASURED_FOLLOWING_ERROR: Motor.following_error,
}


@final
class Claims:
    """The capability claims of a bench's motors, read when needed on separate benches.

    Connecting sends frames. Every clause must begin in the same way, whatever was asked before.
    """

    def __init__(self, open_bench: Opener) -> None:
        self._open = open_bench
        self._known: dict[Capability, str] = {}

    def why_not(self, capability: Capability) -> str:
        """Return the reason why a capability is not claimed; "" if it is claimed.

        Raises:
            MotorError: the motor cannot be reached.
        """
        if capability not in self._known:
            found: dict[Capability, str] = {}
            with self._open() as bench:
                bench.motor.logical.hooks.connect()  # what its drive lacks, it does not claim
                for one in dict.fromkeys((*_READINGS, *Capability)):  # reading shows more units
                    if any((one in late) is not (capability in late) for late in _LATE):
                        continue
                    try:
                        found[one] = _why_not(bench, one)
                    except (Exception, SystemExit):
                        if one is capability:  # clauses that need another one report its error
                            raise
            self._known.update(found)
        return self._known[capability]


def _why_not(bench: RigProtocol, capability: Capability) -> str:
    facts = bench.facts
    if capability in facts.without:
        return f"not claimed by the rig: {facts.without[capability]}"
    if capability in facts.claims:
        return ""
    if not _claims(bench.motor, capability):
        return f"the adaptation does not claim {capability.value}"
    return _why_not_homing(bench) if capability is Capability.HOMING else ""


def _why_not_homing(bench: RigProtocol) -> str:
    """Return why homing is not claimed: it is tried on a bench that begins afresh afterwards."""
    if bench.facts.seeking_method is not None or Ability.AFRESH not in bench.abilities:
        return ""
    why_not = ""
    for method in _HERE:
        try:
            bench.motor.home(method)
        except UnsupportedError as error:
            why_not = (
                f"the motor refuses homing on the spot, the rig has no seeking_method: {error}"
            )
        except MotorError:
            return ""  # the clauses on homing report it
        else:
            return ""
    return why_not


def _claims(motor: Motor, capability: Capability) -> bool:
    if capability in _MODES:
        mode, variable = _MODES[capability]
        if not motor.logical.hooks.supports(mode, variable):
            return False
        if mode is ControlMode.TRAJECTORY:
            return _accepts(motor, variable, TrapezoidalTrajectory(0.0, duration_s=1.0))
        return _accepts(motor, variable, Setpoint(0.0, variable is ControlVariable.POSITION))
    if capability in _READINGS:
        return _reads(_READINGS[capability], motor)
    if capability in _HOOKS:
        return all(any(implements(motor, hook) for hook in one) for one in _HOOKS[capability])
    if capability is Capability.COMMON_TRIGGER:
        return motor.logical.hooks.sync_offer().level >= SyncLevel.TRIGGERED
    if capability is Capability.COMPLEX_POSITION:
        return _takes_functions(motor, ControlVariable.POSITION)
    if capability is Capability.COMPLEX_VELOCITY:
        return _takes_functions(motor, ControlVariable.VELOCITY)
    if capability is Capability.LIMITED_SET_POINT:
        return _takes_limits(motor)
    if capability is Capability.LIMITED_JERK:
        return motor.logical.hooks.limits_jerk(ControlVariable.POSITION)
    return capability.is_assumed


def _reads(read: Callable[[Motor], float], motor: Motor) -> bool:
    try:
        read(motor)
    except UnsupportedError:
        return False
    return True


def _takes_functions(motor: Motor, variable: ControlVariable) -> bool:
    """Return whether the motor accepts complex trajectories; keep the motor's settings."""
    if not motor.logical.hooks.supports(ControlMode.TRAJECTORY, variable):
        return False
    from motorhil.motorapi.functions import Polynomial

    still = ComplexTrajectory(Polynomial((0.0,)).restricted(0.0, 1.0), relative=True)
    return _accepts(motor, variable, still)


def _takes_limits(motor: Motor) -> bool:
    if not motor.logical.hooks.supports(ControlMode.SETPOINT, ControlVariable.POSITION):
        return False
    slow = DerivativeLimits(first=0.5 * motor.model.velocity_max)
    return _accepts(motor, ControlVariable.POSITION, Setpoint(0.0, True, slow))


def _accepts(motor: Motor, variable: ControlVariable, command: Setpoint | Trajectory) -> bool:
    try:
        motor.logical.hooks.check_command(variable, command)
    except UnsupportedError:
        return False
    return True
