"""Capability claims of motors, from their hooks and their rig."""

# ruff: noqa: SLF001 -- the kit asks whether a hook is filled in

from typing import Final, final

from harness.conformance.bench import Opener
from harness.conformance.capability import Capability
from harness.conformance.facts import Facts
from motorapi import (
    ComplexTrajectory,
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Motor,
    Setpoint,
    SyncLevel,
    UnsupportedError,
)
from motorapi.hooks import MotorHooks

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
    Capability.MEASURED_TORQUE: "_read_torque",
    Capability.MEASURED_FOLLOWING_ERROR: "_read_following_error",
    Capability.LOW_LEVEL: "_open_low_level",
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
                for one in Capability:
                    if (one in _SLOW) is not (capability in _SLOW):
                        continue
                    try:
                        found[one] = _why_not(bench.motor, bench.facts, one)
                    except (Exception, SystemExit):
                        if (
                            one is capability
                        ):  # clauses that need another capability report its error
                            raise
            self._known.update(found)
        return self._known[capability]


def _why_not(motor: Motor, facts: Facts, capability: Capability) -> str:
    if capability in facts.without:
        return f"not claimed by the rig: {facts.without[capability]}"
    if capability not in facts.claims and not _claims(motor, capability):
        return f"the adaptation does not claim {capability.value}"
    return ""


def _claims(motor: Motor, capability: Capability) -> bool:
    if capability in _MODES:
        return motor._call(motor._supports, *_MODES[capability])
    if capability in _HOOKS:
        hook = _HOOKS[capability]
        return getattr(type(motor), hook) is not getattr(MotorHooks, hook)
    if capability is Capability.COMMON_TRIGGER:
        motor._call(motor._connect)
        return motor._call(motor._sync_offer).level >= SyncLevel.TRIGGERED
    if capability is Capability.COMPLEX_POSITION:
        return _takes_functions(motor, ControlVariable.POSITION)
    if capability is Capability.COMPLEX_VELOCITY:
        return _takes_functions(motor, ControlVariable.VELOCITY)
    if capability is Capability.LIMITED_SET_POINT:
        return _takes_limits(motor)
    return True  # faults, and what only the rig can know: claimed unless it is in `without`


def _takes_functions(motor: Motor, variable: ControlVariable) -> bool:
    """Return whether the motor accepts complex trajectories; keep the motor's settings."""
    if not motor._call(motor._supports, ControlMode.TRAJECTORY, variable):
        return False
    from motorapi.functions import Polynomial

    still = ComplexTrajectory(Polynomial((0.0,)).restricted(0.0, 1.0), relative=True)
    return _accepts(motor, variable, still)


def _takes_limits(motor: Motor) -> bool:
    if not motor._call(motor._supports, ControlMode.SETPOINT, ControlVariable.POSITION):
        return False
    slow = DerivativeLimits(first=0.5 * motor.model.velocity_max)
    return _accepts(motor, ControlVariable.POSITION, Setpoint(0.0, True, slow))


def _accepts(
    motor: Motor, variable: ControlVariable, command: Setpoint | ComplexTrajectory
) -> bool:
    try:
        motor._call(motor._check_command, variable, command)
    except UnsupportedError:
        return False
    return True
