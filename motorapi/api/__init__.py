"""The adaptation API: all that a third party's adaptation may import, and enough.

An adaptation derives from `Motor` (its hooks: `motorhil.motorapi.hooks`), contains a hardware
object, and is built by a function that `adaptation` marks. On CAN, `CanHardware`, `CanMotor` and
`CanBuilder` have all but protocol and units; `StreamedMotor` serves drives without a profile
generator. On a line, `ExchangeLine` with a `Codec` asks and answers, `LineUnit` has the ownership
of one drive, and `PolledMotor` follows a drive that makes its profiles and sends nothing by itself.

`VERSION` grows when a name or a promise changes; the old name then stays for one release. Names of
other modules of motorhil may change at any time.
"""

from motorhil.motorapi.api.can_drive import CanDrive, SignOfLife, checked_node
from motorhil.motorapi.api.can_hardware import CanHardware, Estimate, StreamedCanHardware
from motorhil.motorapi.api.can_motor import (
    CanBuilder,
    CanMotor,
    motor_turns,
    output_sign,
    require_here,
    whole_steps,
)
from motorhil.motorapi.api.line_builder import LineBuilder
from motorhil.motorapi.api.line_exchanges import (
    ByteLine,
    Codec,
    Exchange,
    ExchangeLine,
    LineProtocolViolation,
)
from motorhil.motorapi.api.line_unit import LineUnit
from motorhil.motorapi.api.polled_hardware import (
    BOOT_S,
    Numbers,
    Poll,
    PolledHardware,
    PolledStatus,
)
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.registration import API_VERSION as VERSION
from motorhil.motorapi.api.registration import Options, Shared, adaptation, read_settings
from motorhil.motorapi.api.setpoint_stream import SetpointStream
from motorhil.motorapi.api.streamed_motion import StreamedMotion, can_stream, require_time
from motorhil.motorapi.api.streamed_motor import StreamedMotor
from motorhil.motorapi.commands import ControlMode, ControlVariable, Setpoint
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LimitError,
    LinkError,
    MotionInterrupted,
    MotorBusyError,
    MotorError,
    PeerError,
    StateError,
    UnsupportedError,
    UsageError,
    require_within,
)
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.model import MotionKind, MotorModel
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.ownership.fencing import BoundFence
from motorhil.motorapi.planning.sampling import Ramps, demand_of
from motorhil.motorapi.runtime.api import Registration, Runtime, wait_until
from motorhil.motorapi.runtime.can_link import Transmission as SentFrame
from motorhil.motorapi.state import Fault, Measurement, MotorState, texts_of
from motorhil.motorapi.synchronization.bus_load import PeriodicMessage
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel
from motorhil.motorapi.trajectory import (
    ComplexTrajectory,
    Trajectory,
    TrapezoidalTrajectory,
    asks_for_smoothness,
)
from motorhil.settings import REQUIRED, SettingError, amount, number, positive, text, whole, word

__all__ = [
    "BOOT_S",
    "REQUIRED",
    "VERSION",
    "BoundFence",
    "ByteLine",
    "CanBuilder",
    "CanDrive",
    "CanHardware",
    "CanMotor",
    "Codec",
    "ComplexTrajectory",
    "ControlMode",
    "ControlVariable",
    "DeadlineExceeded",
    "DeviceFault",
    "Estimate",
    "Exchange",
    "ExchangeLine",
    "Fault",
    "LimitError",
    "LineBuilder",
    "LineProtocolViolation",
    "LineUnit",
    "LinkError",
    "Measurement",
    "Motion",
    "MotionInterrupted",
    "MotionKind",
    "MotionTimes",
    "Motor",
    "MotorBusyError",
    "MotorError",
    "MotorModel",
    "MotorState",
    "Numbers",
    "Options",
    "PeerError",
    "PeriodicMessage",
    "Poll",
    "PolledHardware",
    "PolledMotor",
    "PolledStatus",
    "ProcessLock",
    "Ramps",
    "Registration",
    "Runtime",
    "SentFrame",
    "Setpoint",
    "SetpointStream",
    "SettingError",
    "Shared",
    "SignOfLife",
    "StateError",
    "StreamedCanHardware",
    "StreamedMotion",
    "StreamedMotor",
    "SyncLevel",
    "SyncOffer",
    "Trajectory",
    "TrapezoidalTrajectory",
    "Trigger",
    "UnsupportedError",
    "UsageError",
    "adaptation",
    "amount",
    "asks_for_smoothness",
    "can_stream",
    "checked_node",
    "demand_of",
    "motor_turns",
    "number",
    "output_sign",
    "positive",
    "read_settings",
    "require_here",
    "require_time",
    "require_within",
    "text",
    "texts_of",
    "wait_until",
    "whole",
    "whole_steps",
    "word",
]
