"""Motions of a CiA 402 drive: arming, starting and confirming.

The mode of operation for each command:

| command                                  | mode | how it starts                             |
| ---------------------------------------- | ---- | ----------------------------------------- |
| set-point or simple trajectory, position | pp   | new set-point, changed immediately        |
| set-point or simple trajectory, velocity | pv   | target velocity 60FFh; ramps 6083h, 6084h |
| set-point or simple trajectory, torque   | tq   | target torque 6071h; slope 6087h          |
| trajectory that is a function            | csp  | its first set-point, latched by SYNC      |

A set-point in pp is an absolute target while the drive's position counter has not wrapped. Beyond
its 32 bits it is a distance, which every drive understands alike (controlword bit 6).

Before a motion, settings of the logical motor and of this motion alone are written: a torque slope,
a quick stop within the model's limit, the ramp of a halt. The drive gets its own values back
afterwards. Motions of several drives begin together as `sync_start` describes.
"""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.canopen.errors import SdoAborted
from motorhil.motorapi.adaptations.cia402.csp import CspStream, StreamedMotion
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.cia402.motion_status import (
    SETTLE_NS,
    MotionWatch,
    SetpointWatch,
    StreamWatch,
)
from motorhil.motorapi.adaptations.cia402.objects import FAULT_BIT, Mode
from motorhil.motorapi.adaptations.cia402.parameters import (
    HALT_OPTION,
    POSITIONING_OPTION,
    QUICK_STOP_DECELERATION,
    WINDOW_OFF,
    Cia402Parameters,
    Place,
)
from motorhil.motorapi.adaptations.cia402.profile import (
    STEEPEST,
    DriveLimits,
    DriveProfile,
    as_motion,
    as_torque_motion,
    check_limits,
    check_target,
    expected_s,
    profile_of,
    ramp_s,
    torque_profile_of,
)
from motorhil.motorapi.adaptations.cia402.sync_start import (
    ArmedGroup,
    ArmedSetPoint,
    ArmedStream,
    HandOverTrigger,
    SyncTrigger,
    armed_group,
    offer_of,
)
from motorhil.motorapi.adaptations.cia402.units import DriveUnits
from motorhil.motorapi.commands import ControlVariable
from motorhil.motorapi.errors import DeadlineExceeded, StateError
from motorhil.motorapi.motion import Motion
from motorhil.motorapi.planning.functions import from_here
from motorhil.motorapi.synchronization.offer import SyncOffer, Trigger
from motorhil.motorapi.synchronization.quality import MotionTimes

if TYPE_CHECKING:
    from motorhil.motorapi.model import MotorModel

_CONFIRM_TIMEOUT_S: Final = 0.5
_RESEND_S: Final = 0.1
_BEHIND: Final = 10.0  # start tolerances: no drive stands still that far behind its set-points
_STOPPING_PERIODS: Final = 4
POLL_S: Final = 0.01
_PREVIOUS_TARGET, _DEMAND, _ACTUAL = range(3)  # 60F2h, bits 0 and 1: where a distance begins
_HERE_IS_ZERO: Final = (35, 37)
_LIVE: Final = {ControlVariable.VELOCITY: 0x60FF, ControlVariable.TORQUE: 0x6071}


def times_of_stream(watch: "StreamWatch", stream: "CspStream | None") -> MotionTimes:
    """Return the motion times of streamed set-points."""
    source = "SYNC of the first set-point on the wire; position within its window in a TPDO"
    if stream is not None and stream.late:
        source += f"; {stream.late} of {stream.sent} set-points were late"
    if stream is not None and stream.missed:
        source += f"; the host missed {stream.missed} periods"
    return MotionTimes(watch.started_ns, watch.ended_ns, source, latched_ns=watch.started_ns)


def times_of_set_point(
    watch: "SetpointWatch", point: "ArmedSetPoint | None", *, together: bool
) -> MotionTimes:
    """Return the motion times of one set-point; `point` is what a SYNC has started, if any."""
    commanded_ns, ended_ns = watch.commanded_ns, watch.ended_ns
    if point is not None:
        source = "SYNC on the wire; target reached in a TPDO"
        if point.straddles:
            source += f"; it began {point.straddles} SYNC later than the first"
        return MotionTimes(commanded_ns, ended_ns, source, point.latched_ns, point.straddles)
    if together:
        source = "its command on the wire; target reached in a TPDO"
        return MotionTimes(commanded_ns, ended_ns, source, commanded_ns)
    source = "set-point acknowledge and target reached in a TPDO"
    return MotionTimes(watch.started_ns, ended_ns, source, commanded_ns)


def settings_of(
    motion: Motion, parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> dict[Place, int]:
    """Return the values to write, by object; all other objects get the drive's own values.

    Raises:
        LimitError: a value does not fit the drive.
    """
    units = reader.known()[0]
    wanted = parameters.objects(units)
    if motion.function is not None:
        # A quick stop in mid-stream must not exceed the model's deceleration.
        own = hardware.parameters.own((0x6085, 0))
        if own is None:
            own = hardware.objects.read_optional(0x6085)
        highest = units.acceleration_raw(motion.deceleration)
        if own is not None and (own == 0 or own > highest):
            wanted[0x6085, 0] = highest
    elif motion.variable is ControlVariable.TORQUE:
        slope = torque_profile_of(motion, reader.torque_unit()).slope
        if slope is not None and slope != STEEPEST:
            wanted[0x6087, 0] = slope
    return wanted | halt_settings(hardware, reader, motion)


_SLOW_DOWN_RAMP, _QUICK_STOP_RAMP = 1, 2  # values of 605Dh


def halt_settings(
    hardware: Cia402HwMotor, reader: DriveReader, motion: Motion | None = None
) -> dict[Place, int]:
    """Return the settings with which a halt has the deceleration of the motion (None: homing).

    605Dh = 1 selects the ramp of the mode: 6084h, in hm 609Ah. 2 selects the quick stop ramp,
    6085h, which is set to the deceleration meanwhile, if the motion has one for its stop, or if the
    drive keeps 605Dh at 2.
    """
    units, limits = reader.known()
    kept = hardware.parameters.own((HALT_OPTION, 0))
    option = limits.halt_option if kept is None else kept
    if option is None:
        return {}
    wanted = _SLOW_DOWN_RAMP
    ramp: int | None = None
    if motion is not None:
        ramp = units.acceleration_raw(motion.stop_deceleration or motion.deceleration)
        if ramp != units.acceleration_raw(motion.deceleration):
            wanted = _QUICK_STOP_RAMP
    if hardware.parameters.keeps_halt_option:
        wanted = option
    settings = {} if wanted == option else {(HALT_OPTION, 0): wanted}
    if wanted == _QUICK_STOP_RAMP and ramp is not None:
        settings[QUICK_STOP_DECELERATION, 0] = ramp
    return settings


def window_of(
    parameters: Cia402Parameters, hardware: Cia402HwMotor, reader: DriveReader
) -> int | None:
    """Return the position window of the target [increments], or None if the drive has none."""
    units, limits = reader.known()
    if parameters.position_window is not None:
        return parameters.objects(units)[0x6067, 0]
    own = hardware.parameters.own((0x6067, 0))
    return limits.window if own is None else (None if own == WINDOW_OFF else own)


@final
class SetPointTrigger:
    """The controlword that makes one drive accept its target position."""

    def __init__(self, hardware: Cia402HwMotor, watch: SetpointWatch) -> None:
        self._hardware = hardware
        self._watch = watch

    def fire(self) -> None:
        """Send the controlword and wait until it was on the wire."""
        transmission = self._hardware.control.send_set_point()
        if transmission is not None:
            self._hardware.link.confirmed([transmission])
        now_ns = self._hardware.runtime.now_ns()
        self._watch.begin(now_ns if transmission is None else transmission.time_ns or now_ns)


@final
class LiveTargetTrigger:
    """One drive's target velocity (60FFh) or torque (6071h), which takes effect when written."""

    def __init__(
        self, hardware: Cia402HwMotor, watch: SetpointWatch, index: int, target: int
    ) -> None:
        self._hardware = hardware
        self._watch = watch
        self._index = index
        self._target = target

    def fire(self) -> None:
        """Write the target to the drive, and release a halt."""
        hardware = self._hardware
        hardware.objects.write(self._index, self._target)
        transmission = hardware.control.send_holding_word()
        if transmission is not None:
            hardware.link.confirmed([transmission])
        self._watch.begin(hardware.runtime.now_ns())


@final
class DriveMotions:
    """The motions of one logical motor in its drive, from arming to the end.

    Attributes:
        parameters: the parameters to write before a motion of this logical motor begins.
    """

    def __init__(
        self, hardware: Cia402HwMotor, model: "MotorModel", reader: DriveReader, motor: str
    ) -> None:
        self._hardware = hardware
        self._runtime = hardware.runtime
        self._node = hardware.node
        self._control = hardware.control
        self._objects = hardware.objects
        self._model = model
        self._reader = reader
        self._motor = motor
        self.parameters: Cia402Parameters = Cia402Parameters()
        self._watch: SetpointWatch | StreamWatch | None = None
        self._before: MotionWatch | None = None
        self._armed: CspStream | None = None  # the stream that begins, or began last
        self._point: ArmedSetPoint | None = None  # of the last group start
        self._together = False
        # A start asks for the motions that its prediction has asked for: fastest, and in time.
        self._quantised: list[tuple[tuple[Motion, DriveUnits, DriveLimits], Motion]] = []
        self._group = armed_group(hardware.node.bus)

    @property
    def _set_point_period_s(self) -> float:
        return self._hardware.options.set_point_period_ms / 1e3

    # --- prediction ----------------------------------------------------------------------------

    def offer(self, variable: ControlVariable, *, streamed: bool) -> SyncOffer:
        """Return how a motion of `variable` can begin together with others."""
        return offer_of(self._hardware, variable, streamed=streamed)

    def quantise(self, motion: Motion) -> Motion:
        """Return the motion in the drive's resolution; see `MotorHooks._quantise`."""
        if motion.function is not None:
            return motion  # its set-points are rounded to increments one by one
        if motion.variable is ControlVariable.TORQUE:
            unit = self._reader.torque_unit()
            return as_torque_motion(motion, torque_profile_of(motion, unit), unit)
        known = (motion, *self._reader.known_of(motion.variable))
        for before, made in self._quantised:
            if before == known:
                return made
        _, units, limits = known
        made = as_motion(motion, profile_of(motion, self._model, units, limits), units)
        self._quantised = [(known, made), *self._quantised[:1]]
        return made

    # --- arming ----------------------------------------------------------------------------

    def arm(self, motion: Motion, *, together: bool) -> Trigger:
        """Arm a motion in the drive; see `MotorHooks._arm`."""
        self._together = together
        self._point = None
        stream = self._hardware.stream
        if stream is not None and stream.is_stopping:
            self._runtime.wait_until(lambda: stream.ended, _STOPPING_PERIODS * stream.period_s)
        is_streamed = stream is not None and not stream.ended
        if is_streamed is not bool(motion.initial_velocity):
            state = "set-points are being streamed to it"
            if not is_streamed:
                state = "it moves, but not by set-points of the host, and changes to csp at rest"
            raise StateError(
                motor=self._motor, operation="start", state=state, remedy="stop() first"
            )
        wanted = settings_of(motion, self.parameters, self._hardware, self._reader)
        if motion.function is not None:
            self._apply(motion, wanted)
            return self._arm_stream(motion)
        if motion.variable is ControlVariable.TORQUE:
            self._apply(motion, wanted)
            return self._arm_torque(motion)
        units, limits = self._reader.known_of(motion.variable)
        profile = profile_of(motion, self._model, units, limits)
        origin_inc = None
        if motion.variable is ControlVariable.POSITION:
            origin_inc = self._origin(profile.target, wanted)
        self._apply(motion, wanted)
        check_limits(self._motor, profile, units, limits)
        if motion.variable is ControlVariable.VELOCITY:
            return self._arm_velocity(motion, profile)
        return self._arm_position(motion, profile, origin_inc)

    def _apply(self, motion: Motion | None, wanted: dict[Place, int]) -> None:
        """Write settings to the drive, and others if it keeps its own halt option."""
        store = self._hardware.parameters
        kept = store.keeps_halt_option
        store.apply(self._motor, wanted)
        if store.keeps_halt_option and not kept:
            wanted = wanted | halt_settings(self._hardware, self._reader, motion)
            store.apply(self._motor, wanted)

    def before_homing(self, method: int | None) -> None:
        """Write the drive's settings for homing, and the deceleration of its stop.

        Homing at the present position makes it 0, whatever the drive's home offset.
        """
        settings = halt_settings(self._hardware, self._reader)
        self._apply(None, self.parameters.objects(self._reader.known()[0]) | settings)
        store = self._hardware.parameters
        if method in _HERE_IS_ZERO:
            is_written = store.home_here(self._motor, method)
        else:
            is_written = store.home_by_own_offset()
        if is_written:
            self._hardware.home_changes += 1

    def _origin(self, target_inc: int, wanted: dict[Place, int]) -> int | None:
        """Return where a distance to the target begins; None: the target is absolute.

        60F2h, if the drive has it, gets its value in `wanted`. Without it, a distance begins at the
        previous target, which a drive at rest holds.
        """
        node = self._node
        if node.is_within_counter(target_inc):
            return None
        watch = node.watch
        demand = self._objects.read_optional(0x6062)
        origin_inc, code = node.position_inc, _ACTUAL
        if isinstance(watch, SetpointWatch) and watch.is_under_way and not self._control.is_halted:
            origin_inc, code = watch.target_inc or 0, _PREVIOUS_TARGET
        elif demand is not None:
            origin_inc, code = node.on_from(demand), _DEMAND
        self._reader.known()[0].require_distance(target_inc - origin_inc)
        option = self._objects.read_optional(POSITIONING_OPTION)
        if option is not None:
            wanted[POSITIONING_OPTION, 0] = option & ~3 | code
        return origin_inc

    def _arm_position(
        self, motion: Motion, profile: DriveProfile, origin_inc: int | None
    ) -> Trigger:
        units, limits = self._reader.known()
        check_target(self._motor, profile.target, units, limits)
        self._control.set_mode(Mode.PROFILE_POSITION)
        self._push_ramps(profile.acceleration, profile.deceleration)
        self._objects.push(0x6081, profile.speed)
        self._control.take_set_points(relative=origin_inc is not None)
        watch = SetpointWatch(
            commanded_ns=None,
            expected_ns=round(expected_s(motion, profile, units) * 1e9),
            acknowledged=True,
            target_inc=profile.target,
            tolerance_inc=self._window(),
            distance_inc=profile.target - self._node.position_inc,
            acknowledge_at_rest=self._control.acknowledge_at_rest,
        )
        self._follow(watch)
        self._reader.held = (profile.target, motion.target)
        target = profile.target - (origin_inc or 0)
        if self._can_arm(0x607A):
            return self._arm_latched(0x607A, target, watch)
        self._objects.push(0x607A, target)
        return SetPointTrigger(self._hardware, watch)

    def _arm_velocity(self, motion: Motion, profile: DriveProfile) -> Trigger:
        units, _ = self._reader.known_of(motion.variable)
        self._control.require(Mode.PROFILE_VELOCITY)
        if not self._control.is_in(Mode.PROFILE_VELOCITY):
            self._objects.write(0x60FF, 0)  # an old target would take effect at once
            self._control.set_mode(Mode.PROFILE_VELOCITY)
        self._push_ramps(profile.acceleration, profile.deceleration)
        change = abs(motion.target - self._reader.velocity())
        slowest = min(motion.acceleration, motion.deceleration)
        self._control.keep_halt()
        watch = _live_watch(change / slowest, as_motion(motion, profile, units).duration_s)
        self._follow(watch)
        if self._can_arm(0x60FF):
            return self._arm_latched(0x60FF, profile.target, watch)
        return LiveTargetTrigger(self._hardware, watch, 0x60FF, profile.target)

    def _arm_torque(self, motion: Motion) -> Trigger:
        unit = self._reader.torque_unit()
        profile = torque_profile_of(motion, unit)
        if not self._control.is_in(Mode.PROFILE_TORQUE):
            # In tq any value of 6071h takes effect at once; with 0, a load would drop.
            self._control.hold()
            self._control.set_mode(Mode.PROFILE_TORQUE)
        self._push_stopping_ramps(motion)
        if profile.slope == STEEPEST:
            with suppress(SdoAborted):  # A drive with a steepest slope of its own keeps that.
                self._objects.push(0x6087, STEEPEST)
        self._control.keep_halt()
        made_s = as_torque_motion(motion, profile, unit).duration_s
        watch = _live_watch(max(ramp_s(motion, profile, unit), SETTLE_NS / 1e9), made_s)
        self._follow(watch)
        return LiveTargetTrigger(self._hardware, watch, 0x6071, profile.target)

    def _arm_stream(self, motion: Motion) -> Trigger:
        hardware, period_s = self._hardware, self._set_point_period_s
        units = self._reader.known()[0]
        velocity = motion.variable is ControlVariable.VELOCITY
        if velocity and abs(motion.start) > motion.acceleration * period_s:
            raise StateError(
                motor=self._motor,
                operation="start",
                state=f"the trajectory begins at {motion.start:g} {units.unit}/s, and the "
                "drive changes to csp at rest",
                remedy="begin it at 0",
            )
        if not velocity:
            self._check_ends(motion)
        self._push_stopping_ramps(motion)
        self._control.keep_halt()
        watch = StreamWatch(period_ns=round(period_s * 1e9), tolerance_inc=self._window())

        def next_target(cycle: int) -> int | None:
            was_over = streamed.over
            try:
                target = streamed.target(cycle)
            except Exception as error:
                watch.fail(error)
                raise
            if was_over and not watch.has_arrived:  # the last one goes with the SYNC just queued
                last = None if streamed.velocity else stream.target
                self._node.bus.sync.at_next(partial(watch.arrive, last))
            return target

        hardware.connect()
        running = hardware.stream if motion.initial_velocity else None
        stream = running or CspStream(
            self._control,
            period_s,
            next_target,
            began=watch.begin,
            lost=watch.fail,
            at_once=False,
            behind_inc=abs(round(units.increments(_BEHIND * self._model.start_tolerance))),
        )
        streamed = StreamedMotion(self._motor, motion, units, period_s, stream.target)
        self._armed = hardware.stream = stream
        self._follow(watch)
        self._reader.held = self._held_by(motion)
        if running is not None:

            def heir() -> Callable[[int], int | None]:
                nonlocal streamed
                held_inc = running.target
                try:
                    here = from_here(self._motor, self._model, motion, units.position(held_inc))
                except Exception as error:
                    watch.fail(error)
                    raise
                streamed = StreamedMotion(self._motor, here, units, period_s, held_inc)
                return next_target

            return HandOverTrigger(
                running, partial(running.hand_over, heir, watch.begin, watch.fail)
            )
        armed = self._group if self._together else ArmedGroup()
        armed.streams.append(ArmedStream(stream, streamed))
        return SyncTrigger(self._node.bus, armed)

    def _held_by(self, motion: Motion) -> tuple[int | None, float]:
        """Return `DriveReader.held` for the end of a stream, if it is known."""
        trajectory = motion.trajectory
        end = motion.rest_at if motion.final_velocity else motion.target
        is_shifted = motion.initial_velocity and trajectory is not None and trajectory.is_relative
        if motion.variable is ControlVariable.VELOCITY or end is None or is_shifted:
            return None, 0.0
        return self._reader.known()[0].position_inc(end), end

    def _check_ends(self, motion: Motion) -> None:
        """Check that the whole trajectory is within the drive's own software position limits."""
        units, limits = self._reader.known()
        if motion.function is None or limits.position is None:
            return
        found = motion.function.extrema(*motion.interval)
        for value in (found.minimum, found.maximum):
            check_target(self._motor, units.position_inc(value + motion.offset), units, limits)

    def _push_stopping_ramps(self, motion: Motion) -> None:
        """Write the model's ramps for stop and halt (6084h), where the mode has no ramps."""
        units = self._reader.known()[0]
        self._push_ramps(
            units.acceleration_raw(motion.acceleration), units.acceleration_raw(motion.deceleration)
        )

    def _window(self) -> int | None:
        return window_of(self.parameters, self._hardware, self._reader)

    def _push_ramps(self, acceleration: int, deceleration: int) -> None:
        self._objects.push(0x6083, acceleration)
        if self._reader.known()[1].has_deceleration:
            self._objects.push(0x6084, deceleration)

    def _can_arm(self, index: int) -> bool:
        """Return whether SYNC can start the target, together with others."""
        return self._together and index in self._hardware.connect().latched_ids

    def _arm_latched(self, index: int, target: int, watch: SetpointWatch) -> Trigger:
        """Write the target for the next SYNC; while a cyclic SYNC runs, only prepare it."""
        bus, link, armed = self._node.bus, self._node.link, self._group
        point = ArmedSetPoint(self._control, index, target, watch.begin)
        self._point = point
        # If a foreign SYNC has already begun some motors, the others do not wait for another.
        has_begun = any(one.latched_ns is not None for one in armed.set_points)
        armed.set_points.append(point)
        cyclic = bus.sync.known() if has_begun else bus.sync.find_cyclic()
        if cyclic is None:
            point.mark(self._hardware.connect().latched_ids[index])
            point.send()
            if point.transmission is not None:
                link.confirmed([point.transmission])
        return SyncTrigger(bus, armed)

    def _follow(self, watch: SetpointWatch | StreamWatch) -> None:
        self._before = self._node.watch
        self._watch = watch
        self._hardware.follow(watch)

    def disarm(self) -> None:
        """Cancel an armed motion; see `MotorHooks._disarm`."""
        watch, stream = self._watch, self._armed
        if watch is not None and watch is self._node.watch and not _is_commanded(watch):
            self._hardware.follow(self._before)  # for example a stop that came while arming
        if stream is not None and stream.started_ns is None and not stream.is_stopping:
            stream.cancel()
        point, self._point = self._point, None
        if point in self._group.set_points:
            self._group.set_points.remove(point)
        try:
            self._control.disarm()
        finally:
            if point is not None:
                point.unmark()

    # --- confirming ----------------------------------------------------------------------------

    def confirm(self, motion: Motion) -> None:
        """Confirm that the motion has begun; see `MotorHooks._confirm`."""
        watch = self._watch
        if watch is None or self._control.is_halted:
            return
        if isinstance(watch, StreamWatch):
            self._node.check_motion(self._motor)  # the trigger has waited for the first SYNC
        elif motion.variable is ControlVariable.POSITION:
            self._await_acknowledge(watch)
        else:
            self._confirm_target(motion)
        if not self._control.is_halted:
            self._control.has_started()
            if motion.variable is ControlVariable.POSITION and isinstance(watch, SetpointWatch):
                self._control.send_holding_word()

    def _await_acknowledge(self, watch: SetpointWatch) -> None:
        """Await the set-point acknowledge; send a lost controlword again.

        Repeating is safe: the drive detects an edge of bit 4, and there is no edge if it has the
        controlword already.
        """
        node = self._node
        deadline_ns = self._runtime.now_ns() + round(_CONFIRM_TIMEOUT_S * 1e9)

        def is_over() -> bool:
            ends = watch.started_ns is not None or self._control.is_halted
            is_gone = node.is_lost or not node.is_up
            return ends or node.statusword & FAULT_BIT != 0 or is_gone

        while True:
            node.refresh()
            pause_s = _RESEND_S if node.status_is_cyclic else POLL_S
            if self._runtime.wait_until(is_over, pause_s):
                if not self._control.is_halted:
                    node.check_motion(self._motor)
                return
            if self._runtime.now_ns() >= deadline_ns:
                raise DeadlineExceeded(
                    awaited=f"{self._motor}: set-point acknowledge",
                    timeout_s=_CONFIRM_TIMEOUT_S,
                    last_heard=node.describe_status(),
                )
            if not self._together:
                self._control.send_set_point()

    def _confirm_target(self, motion: Motion) -> None:
        """Read the target back, as pv and tq have no acknowledge."""
        index = _LIVE[motion.variable]
        if motion.variable is ControlVariable.TORQUE:
            target = torque_profile_of(motion, self._reader.torque_unit()).target
        else:
            units, limits = self._reader.known_of(motion.variable)
            target = profile_of(motion, self._model, units, limits).target
        found = self._objects.read_int(index)
        if found != target and not self._control.is_halted:
            raise DeadlineExceeded(
                awaited=f"{self._motor}: target {motion.variable.value} {target} in the drive",
                timeout_s=0.0,
                last_heard=f"{index:04X}h = {found}",
            )
        self._node.check_motion(self._motor)

    def times(self) -> MotionTimes | None:
        """Return the times of the motion; see `MotorHooks._motion_times`."""
        watch = self._watch
        if watch is None:
            return None
        if isinstance(watch, StreamWatch):
            return times_of_stream(watch, self._armed)
        return times_of_set_point(watch, self._point, together=self._together)


def _live_watch(expected_s: float, duration_s: float | None) -> SetpointWatch:
    """Return the watch of a target that has neither acknowledge nor position.

    `duration_s` is that of a trajectory; None for a set-point, which ends within the window.
    """
    return SetpointWatch(
        commanded_ns=None,
        expected_ns=round(expected_s * 1e9),
        acknowledged=False,
        target_inc=None,
        tolerance_inc=None,
        lasts_ns=0 if duration_s is None else round(duration_s * 1e9),
    )


def _is_commanded(watch: SetpointWatch | StreamWatch) -> bool:
    if isinstance(watch, StreamWatch):
        return watch.started_ns is not None
    return watch.commanded_ns is not None
