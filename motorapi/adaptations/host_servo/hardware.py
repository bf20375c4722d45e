"""The hardware class of central servo: amplifier and encoder on a node.

The servo runs here, as on JPL's FIDO: the robot's computer closes the loop, and the hardware is
plain. There is one object per physical motor and process. The object works with currents and
counts, and runs the servo with the gains of the logical motor that uses it.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Final, NamedTuple, final

from motorhil.motorapi.adaptations.canopen.node import node_locks
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.canopen.objects import Value
from motorhil.motorapi.adaptations.canopen.sdo import decode_answer
from motorhil.motorapi.adaptations.host_servo.axis import (
    AMPLIFIER_FAULT,
    COMMUNICATION,
    ServoAxis,
)
from motorhil.motorapi.adaptations.host_servo.cycle import ChannelPair, CycleReport, ServoTrigger
from motorhil.motorapi.adaptations.host_servo.demand import Course
from motorhil.motorapi.adaptations.host_servo.node import (
    CHANNELS_MAX,
    READY,
    AmplifierNode,
    IoFacts,
    open_node,
)
from motorhil.motorapi.adaptations.host_servo.servo import Servo, ServoLimits, difference
from motorhil.motorapi.adaptations.host_servo.settings import IoOptions
from motorhil.motorapi.commands import as_number
from motorhil.motorapi.errors import (
    DeadlineExceeded,
    DeviceFault,
    LinkError,
    StateError,
    UsageError,
)
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.ownership.claim import LockAction
from motorhil.motorapi.ownership.fencing import announce
from motorhil.motorapi.ownership.physical_motor import (
    PhysicalMotor,
    RunStatus,
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.runtime.can_link import (
    FrameInbox,
    Transmission,
    bus_label,
    raw_frame,
)
from motorhil.motorapi.runtime.wall import runtime_of
from motorhil.motorapi.state import MotorState

if TYPE_CHECKING:
    import can

    from motorhil.motorapi.adaptations.host_servo.settings import PidGains
    from motorhil.motorapi.ownership.claim import OwnershipEvent
    from motorhil.motorapi.runtime.api import Runtime
    from motorhil.motorapi.synchronization.offer import Trigger

_RAW_PER_VOLT: Final = 32768 / 10.0  # 6411h: +-10 V, left-adjusted in 16 bits
_ENABLE_TIMEOUT_S: Final = 0.5
_STEPS_BEFORE_POWER: Final = 3  # so that an output of 0 has been latched
_OFF_TIMEOUT_S: Final = 0.1
_VELOCITY_CYCLES: Final = 5
_VELOCITY_TIMEOUT_S: Final = 0.5
_UNSURE_MAX: Final = 0.25
"""The largest uncertainty of the time between two polled counts, relative to it."""


class PolledCount(NamedTuple):
    """A count that the node had at a time between the request and its answer [ns]."""

    value: int
    since_ns: int
    until_ns: int


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
        self._place = (node_id, channel)
        lock = node_locks(bus, self.runtime, node_id, self.label)[0]
        if lock is not None:  # of this motor; that of the node is in `io.occupation`
            lock = ProcessLock(f"{lock.name}-channel{channel}", self.label, runtime=self.runtime)
        self.physical: Final[PhysicalMotor] = register_physical_motor(
            bus, self._place, self.label, self, lock
        )
        try:
            self.io: Final[AmplifierNode] = open_node(bus, node_id, self.runtime, self.options)
        except BaseException:
            release_physical_motor(bus, self._place, self)
            raise
        self.node: Final = self.io.node
        self.link: Final = self.io.link
        self.physical.news = self.node.news
        self.node.on_loss.append(self.physical.fail)
        self.objects: Final = ObjectAccess(self.node, self.physical)
        self.axis: Final = ServoAxis(
            self.io,
            channel,
            self.physical,
            self.options.cycle_ms / 1e3,
            _RAW_PER_VOLT / self.current_per_volt_a_v,
        )
        self.is_closed: bool = False
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
        self.node.on_loss.remove(self.physical.fail)
        self.io.on_facts.remove(self._take_place)
        self.io.on_inputs.remove(self.axis.see_inputs)
        if self._pair is not None:
            self._pair.place((self.channel - 1) % 2, None)
            self._pair = None
        release_physical_motor(self.link.bus, self._place, self)
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
        count = self._poll()
        self.axis.counted_ns = count.until_ns
        return count.value

    def _poll(self) -> PolledCount:
        begun_ns = self.runtime.now_ns()
        place = self.options.counter, self.channel
        value = decode_answer(self.node.node_id, place, "i32", self.node.sdo.upload(*place))
        assert isinstance(value, int)  # an i32
        return PolledCount(value, begun_ns, self.runtime.now_ns())

    # --- objects and frames ----------------------------------------------------------------

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Return the bytes of an object of the node; raises as `ObjectAccess.upload`."""
        return self.objects.upload(index, subindex)

    def download(self, index: int, subindex: int, data: bytes) -> None:
        """Write `data` to an object of the node; raises as `Cia402HwMotor.download`."""
        self.physical.require_free()
        self.objects.download(index, subindex, data)

    def read(self, what: int | str, subindex: int = 0, kind: str | None = None) -> Value:
        """Return the value of an object of the node; see `Cia402HwMotor.read`."""
        return self.objects.read(what, subindex, kind)

    def write(
        self, what: int | str, value: Value, subindex: int = 0, kind: str | None = None
    ) -> None:
        """Write a value to an object of the node; see `Cia402HwMotor.write`."""
        self.physical.require_free()
        self.objects.write(what, value, subindex, kind)

    def send_frame(self, can_id: int, data: bytes = b"", *, extended: bool = False) -> Transmission:
        """Queue a frame of the caller; see `Cia402HwMotor.send_frame`."""
        self.physical.require_free()
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

    @property
    def is_regular(self) -> bool:
        """True if the servo's velocity is that of the motor: its counts come in time."""
        return self._pair is not None and self._pair.is_regular

    def measure_velocity(self) -> float:
        """Return the mean velocity between two polled counts, at least 5 cycles apart [inc/s].

        Raises:
            DeadlineExceeded: their times are too uncertain for a velocity.
        """
        end_ns = self.runtime.now_ns() + round(_VELOCITY_TIMEOUT_S * 1e9)
        first = self._poll()
        while True:
            self.link.wait_until(lambda: False, _VELOCITY_CYCLES * self.options.cycle_ms / 1e3)
            last = self._poll()
            least_ns, most_ns = last.since_ns - first.until_ns, last.until_ns - first.since_ns
            if most_ns - least_ns <= _UNSURE_MAX * least_ns:
                return difference(last.value, first.value) * 2e9 / (least_ns + most_ns)
            if last.until_ns > end_ns:
                raise DeadlineExceeded(
                    awaited=f"{self.label}: counts at times that are known",
                    timeout_s=_VELOCITY_TIMEOUT_S,
                    last_heard=f"the last one took {(last.until_ns - last.since_ns) / 1e6:.0f} ms",
                )
            if last.until_ns - last.since_ns < first.until_ns - first.since_ns:
                first = last

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
