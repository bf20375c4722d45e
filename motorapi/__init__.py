"""The motor interface: classes and errors for applications.

Source: the CLARAty motor interface (Pivtoraiko, Nesnas, Nayar: A Reusable Software Framework for
Rover Motion Control). Adaptations to hardware are in `motorapi.adaptations`; only they import the
libraries of their bus.
"""

from motorapi.trajectory import Argument, MotorPosition
from motorapi.commands import ControlMode, ControlVariable, DerivativeLimits, Motion, Range, Setpoint
from motorapi.device import Device, DeviceGroup
from motorapi.errors import DeadlineExceeded, DeviceFault, DomainError, FileError, LimitError, LinkError, MotionInterrupted, MotorBusyError, MotorError, PeerError, PluginError, StateError, SynchronizationError, UnsupportedError, UsageError
from motorapi.generation import Trapezoid
from motorapi.group import MotorGroup
from motorapi.model import MotionKind, MotorModel
from motorapi.motor import Motor
from motorapi.motor import Ending, Outcome
from motorapi.ownership.claim import LockAction, OwnershipEvent
from motorapi.motor import Progress
from motorapi.ownership.reservation import Reservation
from motorapi.runtime.api import Runtime, runtime_of
from motorapi.state import Fault, Measurement, MotorState
from motorapi.synchronization.quality import FaultReaction, MotionTimes, PathDeviation, SyncCapability, Synchronization, SyncLevel, SyncOffer, SyncQuality, Trigger
from motorapi.trajectory import ComplexTrajectory, Trajectory, TrapezoidalTrajectory
from motorapi.runtime.wall import WallRuntime

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
