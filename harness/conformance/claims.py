"""What a motor claims to be able to do: by what it accepts, and by what its rig declares."""

# ruff: noqa: SLF001 -- the kit asks whether a hook is filled in

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

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
from motorapi.functions import Polynomial
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
_HOOKS: Final = {
    Capability.MEASURED_TORQUE: "_read_torque",
    Capability.MEASURED_FOLLOWING_ERROR: "_read_following_error",
    Capability.LOW_LEVEL: "_open_low_level",
}


@final
@dataclass(frozen=True, slots=True)
class Claims:
    """What is claimed, and of all else why it is not.

    Attributes:
        why_not: of each capability that is not claimed.
        by_rig: those claimed by the rig alone.
    """

    why_not: Mapping[Capability, str]
    by_rig: tuple[Capability, ...] = ()

    def has(self, capability: Capability) -> bool:
        """Whether it is claimed."""
        return capability not in self.why_not


def claims_of(motor: Motor, facts: Facts) -> Claims:
    """What `motor` claims, with what its rig declares. Nothing is sent but what connecting takes.

    Raises:
        MotorError: the motor cannot be reached.
    """
    why_not: dict[Capability, str] = {}
    for capability in Capability:
        if capability in facts.without:
            why_not[capability] = f"the rig does not claim it: {facts.without[capability]}"
        elif capability not in facts.claims and not _claims(motor, capability):
            why_not[capability] = f"the adaptation does not claim {capability.value}"
    return Claims(why_not, facts.claims)


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
    return True  # faults, and what only the rig can say: claimed unless it says why not


def _takes_functions(motor: Motor, variable: ControlVariable) -> bool:
    """Whether a complex trajectory is taken; the motor's own settings are as before."""
    if not motor._call(motor._supports, ControlMode.TRAJECTORY, variable):
        return False
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
