"""The hardware class of central servo: amplifier and encoder on a node.

The servo runs here, as on JPL's FIDO: the robot's computer closes the loop, and the hardware is
plain. There is one object per physical motor and process. The object works with currents and
counts, and runs the servo with the gains of the logical motor that uses it.

One motor of the servo cycle: its servo, armed course and faults.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.bus import FrameInbox, Transmission, bus_label, raw_frame
from motorhil.motorapi.adaptations.cia402.node_sharing import node_locks
from motorhil.motorapi.adaptations.cia402.object_access import DriveObjects
from motorhil.motorapi.adaptations.cia402.objects import Value
from motorhil.motorapi.adaptations.host_servo.cycle import ChannelPair, CycleReport, ServoTrigger
from motorhil.motorapi.adaptations.host_servo.demand import POSITION, Course
from motorhil.motorapi.adaptations.host_servo.node import (
    CHANNELS_MAX,
    READY,
    AmplifierNode,
    IoFacts,
    SwitchOff,
    open_node,
)
from motorhil.motorapi.adaptations.host_servo.servo import Servo, ServoLimits
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    MotorBusyError,
    MotorError,
    StateError,
    UsageError,
)
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.ownership.claim import LockAction
from motorhil.motorapi.ownership.fencing import announce
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    bus_key,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.wall import runtime_of
from motorhil.motorapi.state import Fault, MotorState

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.adaptations.host_servo.servo import PidGains
    from motorhil.motorapi.locking.process_lock import LockHandle
    from motorhil.motorapi.ownership.claim import OwnershipEvent
    from motorhil.motorapi.runtime.api import Runtime
    from motorhil.motorapi.synchronization.quality import Trigger

FAULT: Final = 2
AMPLIFIER_FAULT: Final = 0x5400  # device hardware, power section (CiA 402-2, error codes)
COMMUNICATION: Final = 0x8100
FOLLOWING_ERROR: Final = 0x8611
_RAW_MAX: Final = 32767


@final
class ServoAxis:
    """One motor of the servo cycle (protocol `Axis`); positions are increments.

    Attributes:
        servo: position, demand and output, as of the last cycle.
        is_active: whether the motor takes part in the cycle.
        is_stopped: whether a quick stop was the last command.
        failure: the error that ended the control, if it is not a fault of the motor; else None.
        fault: the fault detected by the host, or None.
        amplifier_fault_ns: the time since when the amplifier reports a fault, or None.
        counted_ns: the time of the last count (-1: none).
        steps: the number of counts since the motor became active.
        started_ns, ended_ns: the times of the last motion; None: not (yet), or ended before its
            goal.
    """

    def __init__(
        self,
        io: "AmplifierNode",
        channel: int,
        physical: "PhysicalMotor",
        period_s: float,
        raw_per_ampere: float,
    ) -> None:
        self.physical: Final = physical
        self.servo: Final = Servo(period_s)
        self.is_active = False
        self.is_stopped = False
        self.failure: MotorError | None = None
        self.fault: Fault | None = None
        self.amplifier_fault_ns: int | None = None
        self.counted_ns = -1
        self.steps = 0
        self.started_ns: int | None = None
        self.ended_ns: int | None = None
        self._io: Final = io
        self._node: Final = io.node
        self._channel: Final = channel
        self._raw_per_ampere: Final = raw_per_ampere
        self._armed: tuple[Course, PidGains, ServoLimits] | None = None
        self._moves = False  # a motion, not a stop
        self._hold: LockHandle | None = None  # of the node
        self._switching_off: SwitchOff | None = None

    # --- state -----------------------------------------------------------------------------

    @property
    def is_powered(self) -> bool:
        """True if the servo holds the motor."""
        return self.servo.course is not None

    @property
    def is_over(self) -> bool:
        """True if the goal of the last command has been reached, or the motor has no power."""
        return self._armed is None and (self.servo.is_done or self.servo.course is None)

    @property
    def state(self) -> MotorState:
        """The state of the motor, provided that its node is heard."""
        if self.current_fault() is not None:
            return MotorState.FAULT
        if not self.is_powered:
            return MotorState.DISABLED
        return MotorState.STOPPED if self.is_stopped else MotorState.ENABLED

    def current_fault(self) -> Fault | None:
        """Return the fault that prevents motion until it is reset, or None."""
        if self.fault is None and self.amplifier_fault_ns is not None:
            return Fault(AMPLIFIER_FAULT, "amplifier fault", self.amplifier_fault_ns)
        return self.fault

    # --- commands --------------------------------------------------------------------------

    def activate(self) -> None:
        """Join the cycle, without control or current at first.

        Raises:
            MotorBusyError: another process's servo runs on the node.
        """
        hold, before = self._io.occupation.occupy(), self._hold
        self._hold = hold
        if before is not None:
            before.release()
        self.end_switching_off()
        self._io.be_heard()
        self.failure = None
        self.servo.forget()
        self.is_active = True
        self.is_stopped = False
        self.steps = 0

    def hold(self, gains: "PidGains", limits: ServoLimits) -> None:
        """Hold the motor at its present position."""
        course = Course(POSITION, self.servo.position)
        self.servo.begin(course, gains, limits, self._io.cycle.count)
        self.servo.is_done = True
        self._moves = False
        self._node.news.grow()

    def arm(self, course: Course, gains: "PidGains", limits: ServoLimits) -> None:
        """Arm a course, which begins at a cycle chosen by the trigger.

        Raises:
            LinkError: the servo does not hold the motor.
        """
        if self.failure is not None and not self.is_powered:
            raise self.failure
        if not self.is_powered:
            raise LinkError(link=self.physical.label, reason="its servo is off")
        self._armed = (course, gains, limits)

    def disarm(self) -> None:
        """Cancel the armed course."""
        self._armed = None
        armed = self._io.cycle.armed
        if self in armed:
            armed.remove(self)

    def slow_down(self, deceleration_inc_s2: float, *, quickly: bool = False) -> None:
        """Bring the motor to rest at this deceleration, and hold it."""
        self.disarm()
        if self.is_powered:
            self.is_stopped = self.is_stopped or quickly
            self.servo.brake(deceleration_inc_s2)
            self._moves = False
        self._node.news.grow()

    def call_here(self, position_inc: int) -> None:
        """Define the present position as `position_inc`, without motion."""
        self.servo.call_here(position_inc)
        self.servo.is_done = True
        self._node.news.grow()

    def cut(self) -> None:
        """End control and current, and switch the amplifier off until its node confirms it.

        Raises:
            LinkError: the bus does not accept the frame.
        """
        was_active = self.is_active
        self.is_active = self.is_stopped = False
        self.disarm()
        self.servo.release()
        hold, self._hold = self._hold, None
        try:
            if was_active and self._io.is_switched(self._channel):
                self.end_switching_off()
                self._switching_off = SwitchOff(self._io, self._channel, hold)
                hold = None
                self._io.switch(self._channel, False)
        except MotorBusyError:  # Another process owns the node now, and so the amplifier.
            self.end_switching_off()
        finally:
            if hold is not None:
                hold.release()
            self._node.news.grow()

    def end_switching_off(self) -> None:
        """Stop repeating the command to switch the amplifier off."""
        switching_off, self._switching_off = self._switching_off, None
        if switching_off is not None:
            switching_off.end()

    # --- called by the cycle and the node --------------------------------------------------

    def step(self, count: int, cycle: int, time_ns: int) -> int:
        """Process the count of this cycle, and return the output for it (6411h)."""
        servo = self.servo
        was_done = servo.is_done
        self.counted_ns = time_ns
        self.steps += 1
        raw = round(servo.step(count, cycle) * self._raw_per_ampere)
        if servo.is_done and not was_done:
            if self._moves:
                self.ended_ns = time_ns
            self._node.news.grow()
        if servo.lags:
            servo.lags = False
            behind = servo.demand - servo.position
            text = f"following error: {behind:.0f} increments"
            self._trip(Fault(FOLLOWING_ERROR, text, time_ns))
            return 0
        if servo.error is not None:
            self.failure, servo.error = servo.error, None
            self.slow_down(servo.deceleration)
        return _RAW_MAX if raw > _RAW_MAX else max(raw, -_RAW_MAX)

    def look(self, count: int) -> None:
        """Process a further count of one cycle."""
        self.servo.look(count)

    def begin(self, cycle: int) -> None:
        """Begin the armed course with the count of this cycle."""
        armed, self._armed = self._armed, None
        if armed is None or not self.is_powered:
            return
        self.failure = None
        self.started_ns = self.ended_ns = None
        self._moves = True
        self.servo.begin(*armed, cycle)

    def began(self, time_ns: int) -> None:
        """Record the time when the SYNC of the beginning was on the wire."""
        if self._moves:
            self.started_ns = time_ns

    def fail(self, error: MotorError) -> None:
        """End the control, as the cycle has failed."""
        self.failure = error
        is_lost = isinstance(error, MotorBusyError)  # taken over: not a fault
        if not self._node.is_lost and self._node.is_up and not is_lost:
            now_ns = self._io.link.runtime.now_ns()
            self.fault = Fault(COMMUNICATION, str(error), now_ns)
        self._cut_anyhow()

    def see_inputs(self, time_ns: int) -> None:
        """Evaluate digital inputs received from the node."""
        if self._switching_off is not None:
            self._switching_off.see(time_ns)
        status = self._io.status(self._channel)
        if not status & FAULT:
            self.amplifier_fault_ns = None
        elif self.amplifier_fault_ns is None:
            self.amplifier_fault_ns = time_ns
        if self.is_powered and not status & READY:
            text = "amplifier fault" if status & FAULT else "amplifier not ready"
            self._trip(Fault(AMPLIFIER_FAULT, text, time_ns))

    def _trip(self, fault: Fault) -> None:
        loss = None if self._hold is None else self._hold.loss
        if loss is None:
            self.fault = fault
        else:  # caused by the process that has taken the node over
            self.failure = loss.busy(self.physical.label)
        self._cut_anyhow()

    def _cut_anyhow(self) -> None:
        """Cut from a callback; a bus that accepts no frames is not a second error."""
        try:
            self.cut()
        except LinkError as error:
            if self.failure is None:
                self.failure = error


_RAW_PER_VOLT: Final = 32768 / 10.0  # 6411h: +-10 V, left-adjusted in 16 bits
_ENABLE_TIMEOUT_S: Final = 0.5
_STEPS_BEFORE_POWER: Final = 3  # so that an output of 0 has been latched
_OFF_TIMEOUT_S: Final = 0.1


@final
class AmplifierHwMotor:
    """One motor on a channel of an I/O node, shared by all logical motors and threads.

    The cycle keeps the object alive until `close()` releases the motor.

    Args:
        bus: an open python-can bus, of any interface.
        node_id: the node-ID, 1..127.
        channel: the channel of the node, from 1.
        current_per_volt_a_v: the amplifier's current per volt at its input; < 0 if a positive
            current turns the motor towards lower counts.
        runtime: the runtime to wait with. None: the one of the bus (virtual time), else wall time.
        options: see IoOptions; equal for all channels of a node.

    Attributes:
        io: the node; `node`: its received state; `objects`: its object dictionary.
        axis: the servo and its commands.
        physical: the record that logical motors share.
        users: the number of motors built on it from settings; the last one closes it.

    Raises:
        UsageError: a hardware object for this channel exists already (the message names it), or a
            setting is invalid.
    """

    def __init__(
        self,
        bus: "can.BusABC",
        node_id: int,
        channel: int = 1,
        *,
        current_per_volt_a_v: float,
        runtime: "Runtime | None" = None,
        options: IoOptions | None = None,
    ) -> None:
        if not isinstance(node_id, int) or not 1 <= node_id <= 127:
            raise UsageError(f"node_id = {node_id!r}: a node-ID is 1 to 127")
        if not isinstance(channel, int) or not 1 <= channel <= CHANNELS_MAX:
            raise UsageError(f"channel = {channel!r}: a node's channels are 1 to {CHANNELS_MAX}")
        if not 1e-9 <= abs(as_number(current_per_volt_a_v)) <= 1e9:
            raise UsageError(
                f"current_per_volt_a_v = {current_per_volt_a_v!r}: must be a number of A/V, not 0"
            )
        self.runtime: Final = runtime_of(bus) if runtime is None else runtime
        self.options: Final = IoOptions() if options is None else options
        self.channel: Final = channel
        self.current_per_volt_a_v: Final = float(current_per_volt_a_v)
        self.label: Final = f"{bus_label(bus)} node {node_id} channel {channel}"
        self._key = (*bus_key(bus), node_id, "channel", channel)
        lock = node_locks(bus, self.runtime, node_id, self.label)[0]
        if lock is not None:  # of this motor; that of the node is in `io.occupation`
            lock = ProcessLock(f"{lock.name}-channel{channel}", self.label)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            self._key, self.label, self, lock
        )
        try:
            self.io: Final[AmplifierNode] = open_node(bus, node_id, self.runtime, self.options)
        except BaseException:
            release_physical_motor(self._key, self)
            raise
        self.node: Final = self.io.node
        self.link: Final = self.io.link
        self.physical.news = self.node.news
        self.objects: Final = DriveObjects(self.node, self.physical)
        self.axis: Final = ServoAxis(
            self.io,
            channel,
            self.physical,
            self.options.cycle_ms / 1e3,
            _RAW_PER_VOLT / self.current_per_volt_a_v,
        )
        self.is_closed = False
        self.users = 0
        self._pair: ChannelPair | None = None
        self._boot = -1
        self._homed_at_boot = -1
        self.io.on_facts.append(self._take_place)
        self.io.on_inputs.append(self.axis.see_inputs)
        self._took_over = False
        announce(self.physical.ownership, bus, channel << 8 | node_id)
        self.physical.ownership.listeners.append(self._see_ownership)

    def __repr__(self) -> str:
        return f"<AmplifierHwMotor {self.label}: {self.state().value}>"

    def close(self) -> None:
        """Switch the current off, and close the motor: nothing is sent or received afterwards."""
        if self.is_closed:
            return
        status = RunStatus.DONE if self.axis.is_over else RunStatus.GOING
        self.physical.end(f"close() of {self.label}", self.runtime.now_ns(), status)
        self.is_closed = True
        with suppress(LinkError):  # if the bus is gone, the node's supervision of the host does it
            self.axis.cut()
        self.axis.end_switching_off()
        self.io.on_facts.remove(self._take_place)
        self.io.on_inputs.remove(self.axis.see_inputs)
        if self._pair is not None:
            self._pair.place((self.channel - 1) % 2, None)
            self._pair = None
        release_physical_motor(self._key, self)
        self.io.release()

    # --- bring-up --------------------------------------------------------------------------

    def connect(self) -> IoFacts:
        """Bring the node up and configure it, unless that was done already; see `AmplifierNode`.

        Raises:
            UsageError: the node does not have the channel.
        """
        if self._took_over:
            self._end_others()
        if self._pair is not None and self.io.is_up:
            return self.io.connect()
        if self.is_closed:
            raise LinkError(link=self.label, reason="this hardware object is closed")
        with self.physical.passage(self.label, of_holder=True):
            facts = self.io.connect()
            if self._pair is None:
                self._take_place(facts)
            return facts

    def _end_others(self) -> None:
        """End the servos of the process that lost this motor, and switch the amplifiers off."""
        facts = self.io.connect()
        occupation = self.io.occupation
        with occupation.occupied(take_over=True):
            self._took_over = False
            if facts.channels and not self.axis.is_active:
                self.io.switch(self.channel, False)

    def _take_place(self, facts: IoFacts) -> None:
        """Take this motor's place in the frames after a bring-up, and read its count."""
        if self.channel > facts.channels:
            raise UsageError(f"{self.label}: the node has {facts.channels} channels")
        self._pair = self.io.place(self.channel, self.axis)
        axis = self.axis
        if axis.fault is not None and axis.fault.code == COMMUNICATION:
            axis.fault = axis.failure = None
        if axis.is_active:  # active before the bring-up: the node has lost its commands
            axis.cut()
        count = self._read_count()
        if self._boot == facts.boot:
            axis.servo.look(count)
        else:
            self._boot = facts.boot
            axis.servo.restart(count)

    def _read_count(self) -> int:
        data = self.node.sdo.upload(self.options.counter, self.channel)
        self.axis.counted_ns = self.runtime.now_ns()
        return int.from_bytes(data[:4], "little", signed=True)

    # --- objects and frames ----------------------------------------------------------------

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object of the node; raises as `DriveObjects.upload`."""
        return self.objects.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write `data` to an object of the node; raises as `DriveObjects.upload`."""
        self.objects.download(index, subindex, data)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """Return the value of an object of the node; see `Cia402HwMotor.read`."""
        return self.objects.read(what, subindex, kind)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """Write a value to an object of the node; see `Cia402HwMotor.write`."""
        self.objects.write(what, value, subindex, kind)

    def send_frame(self, can_id: int, data: bytes = b"", *, extended: bool = False) -> Transmission:
        """Queue a frame of the caller; see `Cia402HwMotor.send_frame`."""
        frame = raw_frame(can_id, data, extended=extended)
        with self.physical.passage(self.label, of_holder=True):
            return self.link.send_tracked(frame, self.io.occupation.fence)

    def listen(self, *can_ids: int) -> FrameInbox:
        """Return an inbox for raw frames of other nodes with these identifiers (none: all)."""
        return FrameInbox(self.link, can_ids)

    def fall_silent(self) -> None:
        """Wait until no frames are sent to the channel without a call; `let_in` ends this state.

        Raises:
            StateError: the servo holds the motor, or one that shares its frames.
        """
        if self.axis.is_powered:
            raise StateError(
                motor=self.label,
                operation="low_level()",
                state="its servo holds it, by a frame every cycle",
                remedy="disable() it first",
            )
        self.node.sdo.finish()
        pair = self._pair
        if pair is None or self.runtime.wait_until(lambda: not pair.is_running(), _OFF_TIMEOUT_S):
            self.node.sdo.physical = self.physical
            return
        raise StateError(
            motor=self.label,
            operation="low_level()",
            state="the servo of the neighbour channel sends to both",
            remedy="disable() that motor first",
        )

    def let_in(self) -> None:
        """End low-level access; the next `connect` brings the node up as if it were new."""
        self.node.sdo.physical = None
        self.objects.doubt()
        self.io.doubt()

    # --- state and measurements ------------------------------------------------------------

    @property
    def servo(self) -> "Servo":
        """Position, demand and output, as of the last cycle."""
        return self.axis.servo

    @property
    def is_homed(self) -> bool:
        """True if position 0 was set since the last boot-up of the node."""
        return self._homed_at_boot == self.node.boots

    def state(self) -> MotorState:
        """Return the last state received, without waiting."""
        if self.is_closed or self._pair is None or self.node.is_lost:
            return MotorState.OFFLINE
        return self.axis.state

    def refresh(self) -> None:
        """Read the position if no cycle brings it."""
        if self._pair is not None and not self._pair.is_running():
            self.axis.servo.look(self._read_count())

    def report(self) -> CycleReport:
        """Return the timing statistics of the servo."""
        if self._pair is None:
            return CycleReport(self.options.cycle_ms / 1e3, 0, 0, 0, 0, 0)
        return self._pair.report()

    # --- commands --------------------------------------------------------------------------

    def enable(self, gains: "PidGains", limits: "ServoLimits") -> None:
        """Enable the servo, which holds the motor at its present position, and run SYNC.

        Raises:
            DeviceFault: the amplifier reports a fault.
            DeadlineExceeded: the amplifier did not become ready.
            LinkError: no counts come.
            MotorBusyError: a motor that shares its frames is under low-level access, or another
                process's servo runs on the node.
        """
        self.connect()
        axis, pair = self.axis, self._pair
        axis.is_stopped = False
        if axis.is_powered or pair is None:
            return
        pair.require_free()
        axis.activate()
        try:
            if self.io.is_switched(self.channel):  # left on by a program that has ended
                self.io.switch(self.channel, False)
            pair.join()
            self._await(lambda: axis.steps >= _STEPS_BEFORE_POWER, "counts at SYNC")
            self.io.switch(self.channel, True)
            self._await(lambda: self.io.status(self.channel) != 0, "its amplifier to be ready")
            if not self.io.status(self.channel) & READY:
                self._raise_amplifier_fault()
        except BaseException:
            axis.cut()
            raise
        axis.hold(gains, limits)

    def _see_ownership(self, event: "OwnershipEvent") -> None:
        """Record that the motor was taken over, as its node must be taken over too."""
        if event.action is LockAction.TAKEN_OVER:
            self._took_over = True
        elif event.action in (LockAction.RELEASED, LockAction.LOST):
            self._took_over = False

    def _await(self, done: Callable[[], bool], awaited: str) -> None:
        axis = self.axis
        self._await_inputs(lambda: axis.failure is not None or done(), awaited, _ENABLE_TIMEOUT_S)
        if axis.failure is not None:
            raise axis.failure

    def _await_inputs(self, done: Callable[[], bool], awaited: str, timeout_s: float) -> None:
        if not self.node.link.wait_until(done, timeout_s):
            heard = f"digital inputs {self.io.inputs:02X}h"
            what = f"{self.label}: {awaited}"
            raise DeadlineExceeded(awaited=what, timeout_s=timeout_s, last_heard=heard)

    def _raise_amplifier_fault(self) -> None:
        fault = self.axis.current_fault()
        since_ns = self.runtime.now_ns() if fault is None else fault.since_ns
        raise DeviceFault(
            motor=self.label, code=AMPLIFIER_FAULT, text="amplifier fault", since_ns=since_ns
        )

    def disable(self) -> None:
        """Switch the amplifier off, and await its confirmation; raises as `enable`."""
        self.connect()
        channel = self.channel
        with self.io.occupation.occupied():
            self.axis.cut()
            self.io.switch(channel, False)
            self._await_inputs(
                lambda: not self.io.status(channel) & READY, "its amplifier off", _OFF_TIMEOUT_S
            )

    def reset_fault(self) -> None:
        """Reset the fault; the amplifier is off afterwards.

        Raises:
            DeviceFault: its cause persists.
            MotorBusyError: as `enable`.
        """
        self.connect()
        axis = self.axis
        with self.io.occupation.occupied():
            axis.cut()
            self.io.switch(self.channel, False)  # resets an amplifier
            wait_until = self.node.link.wait_until
            if not wait_until(lambda: axis.amplifier_fault_ns is None, _OFF_TIMEOUT_S):
                self._raise_amplifier_fault()
        axis.fault = axis.failure = None

    def arm(
        self, course: "Course", gains: "PidGains", limits: "ServoLimits", *, together: bool
    ) -> "Trigger":
        """Arm a course, and return its trigger; raises as `ServoAxis.arm`."""
        self.axis.arm(course, gains, limits)
        cycle = self.io.cycle
        if together:
            cycle.armed.append(self.axis)
        return ServoTrigger(cycle, None if together else self.axis)

    def call_here(self, position_inc: int) -> None:
        """Define the present position as `position_inc`, without motion."""
        self.axis.call_here(position_inc)
        self._homed_at_boot = self.node.boots
