"""The motor interface: classes and errors for applications.

Source: the CLARAty motor interface (Pivtoraiko, Nesnas, Nayar: A Reusable Software Framework for
Rover Motion Control). Adaptations to hardware are in `motorhil.motorapi.adaptations`; only they
import the libraries of their bus. Motors and groups, with all below them, are loaded when they are
first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Final

from motorhil.motorapi.commands import (
    ControlMode,
    ControlVariable,
    DerivativeLimits,
    Range,
    Setpoint,
)
from motorhil.motorapi.device import Device, DeviceGroup
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    DomainError,
    FileError,
    LimitError,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    PeerError,
    PluginError,
    StateError,
    UnsupportedError,
    UsageError,
)
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.outcome import Ending, Outcome, Progress
from motorhil.motorapi.runtime.api import Runtime
from motorhil.motorapi.runtime.wall import WallRuntime, runtime_of
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import (
    FaultReaction,
    MotionTimes,
    PathDeviation,
    SyncCapability,
    Synchronization,
    SynchronizationError,
    SyncLevel,
    SyncQuality,
)
from motorhil.motorapi.trajectory import (
    Argument,
    ComplexTrajectory,
    MotorPosition,
    Trajectory,
    TrapezoidalTrajectory,
)

if TYPE_CHECKING:
    from motorhil.motorapi.generation import Trapezoid
    from motorhil.motorapi.group import MotorGroup
    from motorhil.motorapi.motor import Motor
    from motorhil.motorapi.ownership.claim import LockAction, OwnershipEvent
    from motorhil.motorapi.ownership.reservation import Reservation

__all__ = [
    "Argument",
    "ComplexTrajectory",
    "ControlMode",
    "ControlVariable",
    "DeadlineExceeded",
    "DerivativeLimits",
    "Device",
    "DeviceFault",
    "DeviceGroup",
    "DomainError",
    "Ending",
    "Fault",
    "FaultReaction",
    "FileError",
    "LimitError",
    "LinkError",
    "LockAction",
    "Measurement",
    "Motion",
    "MotionInterrupted",
    "MotionKind",
    "MotionTimes",
    "Motor",
    "MotorBusyError",
    "MotorError",
    "MotorGroup",
    "MotorModel",
    "MotorPosition",
    "MotorState",
    "Outcome",
    "OwnershipEvent",
    "PathDeviation",
    "PeerError",
    "PluginError",
    "Progress",
    "Range",
    "Reservation",
    "Runtime",
    "Setpoint",
    "StateError",
    "SyncCapability",
    "SyncLevel",
    "SyncOffer",
    "SyncQuality",
    "Synchronization",
    "SynchronizationError",
    "Trajectory",
    "Trapezoid",
    "TrapezoidalTrajectory",
    "Trigger",
    "UnsupportedError",
    "UsageError",
    "WallRuntime",
    "runtime_of",
]

_LATE: Final = {
    "LockAction": "ownership.claim",
    "Motor": "motor",
    "MotorGroup": "group",
    "OwnershipEvent": "ownership.claim",
    "Reservation": "ownership.reservation",
    "Trapezoid": "generation",
}


def __getattr__(name: str) -> object:
    """Import a name at its first use."""
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"motorhil.motorapi.{_LATE[name]}"), name)
