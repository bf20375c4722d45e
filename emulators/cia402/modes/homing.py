"""Homing mode (hm): home position by switches and index pulse.

Statusword bits 10, 12 and 13 (CiA 402-2, homing mode):

====  ====  ====  ==========================================
13    12    10
====  ====  ====  ==========================================
0     0     0     in progress
0     0     1     interrupted, or not started
0     1     0     attained, still moving
0     1     1     attained, and at rest
1     0     0     error, still moving
1     0     1     error, at rest
====  ====  ====  ==========================================

The drive searches for the switch at 6099h:1. On the switch, towards its edge and the index pulse,
it uses 6099h:2. Home is the position latched there. The drive then brakes with 609Ah and does not
return.

Errors: an unsupported method, or one of its speeds is 0; a start in motion; a limit switch in the
way at which the method does not reverse; after a reversal, the other limit switch; no index pulse
within a turn of the motor. There is no timeout: without any switch the motor runs until the host or
a following error stops it. A new start (bit 4) begins again.
"""

from enum import IntEnum
from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.limit_switches import LimitGuard
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.objects.mode_objects import HOMING_METHODS, HomingMethod
from motorhil.emulators.cia402.state_machine import (
    CW_HALT,
    HOMING_ATTAINED,
    HOMING_ERROR,
    TARGET_REACHED,
)
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import (
    INDEX_PULSE,
    NEGATIVE_LIMIT,
    POSITIVE_LIMIT,
    DigitalInputs,
    Edge,
)

HOMING_START: Final = 0x0010
_FAR_INC: Final = 1 << 44  # beyond the range of any axis


@final
class HomingState(IntEnum):
    """Progress of a homing."""

    NOT_STARTED = 0
    IN_PROGRESS = 1
    ATTAINED = 2
    FAILED = 3


@final
class Homing(Mode):
    """Mode 6."""

    def __init__(
        self,
        axis: Axis,
        objects: DriveObjects,
        tick_ns: int,
        inputs: DigitalInputs,
        guard: LimitGuard,
    ) -> None:
        super().__init__(axis, objects, tick_ns)
        self.state: HomingState = HomingState.NOT_STARTED
        self._inputs = inputs
        self._guard = guard
        self._method: HomingMethod = HOMING_METHODS[37]
        self._way: int = 0  # direction of the present motion
        self._searching: bool = False  # for the switch, in the first direction
        self._turned: bool = False  # reversed at a limit switch
        self._past_edge: bool = False  # the index pulse is next
        self._wake_ns: int = NEVER

    def enter(self, word: int, now_ns: int) -> None:
        """Bring the motor to rest; an attained home stays attained."""
        self.leave()
        self.halted: bool = word & CW_HALT != 0
        self.axis.ramp_to_rest(self.objects.motion.deceleration_inc_s2())

    def leave(self) -> None:
        """Interrupt a homing in progress."""
        self.halted = False
        if self.state is HomingState.IN_PROGRESS:
            self._end(HomingState.NOT_STARTED)

    def forget(self) -> None:
        """Discard the home position (power-on, or a lost encoder)."""
        self._end(HomingState.NOT_STARTED)
        self._guard.fence()

    def obey(self, word: int, rising: int, now_ns: int) -> None:
        """Start on a rising bit 4; interrupt on a falling bit 4, or on bit 8 (halt)."""
        halt = word & CW_HALT != 0
        objects = self.objects
        if halt and not self.halted and self.state is HomingState.IN_PROGRESS:
            objects.options.halt(self.axis, objects.homing.acceleration_inc_s2())
            self._end(HomingState.NOT_STARTED)
        self.halted = halt
        if halt:
            return
        if not word & HOMING_START:
            if self.state is HomingState.IN_PROGRESS:
                self.axis.ramp_to_rest(objects.homing.acceleration_inc_s2())
                self._end(HomingState.NOT_STARTED)
        elif rising & HOMING_START:
            self._begin(now_ns)

    def settle(self, now_ns: int) -> None:
        """Finish homing on the present position a tick later; fail if the motion has ended."""
        if self.state is not HomingState.IN_PROGRESS:
            return
        if now_ns >= self._wake_ns:
            self._attain(self.axis.count())
        elif self._wake_ns == NEVER and not self.axis.flags & f.PROFILE_ACTIVE:
            self._fail()

    def sees(self, edges: list[Edge]) -> None:
        """Handle edges of digital inputs."""
        for edge in edges:
            if self.state is not HomingState.IN_PROGRESS or self._wake_ns != NEVER:
                return
            if edge.bit == INDEX_PULSE:
                if self._past_edge and edge.forward == (self._method.direction > 0):
                    self._attain(edge.count)
            elif edge.bit == self._method.switch:
                self._meet_switch(edge)
            elif edge.active and edge.bit == self._limit_in_the_way():
                self._meet_limit()

    def wake_ns(self) -> int:
        """Return one tick after the start, for homing on the present position [ns]."""
        return self._wake_ns

    def status_bits(self) -> int:
        """Return bits 10, 12 and 13."""
        if self.state is HomingState.IN_PROGRESS:
            return 0
        bits = 0 if self._moves() else TARGET_REACHED
        if self.state is HomingState.ATTAINED:
            return bits | HOMING_ATTAINED
        if self.state is HomingState.FAILED:
            return bits | HOMING_ERROR
        return TARGET_REACHED

    def idle_bits(self) -> int:
        """Return the bits of an attained home, which are also shown with the power stage off."""
        return HOMING_ATTAINED | TARGET_REACHED if self.state is HomingState.ATTAINED else 0

    # --- internals

    def _begin(self, now_ns: int) -> None:
        objects = self.objects.homing
        method = HOMING_METHODS.get(objects.method())
        bits = self._inputs.bits
        if self.state is HomingState.IN_PROGRESS:
            self._end(HomingState.NOT_STARTED)
        if method is None or self._moves():
            self.state = HomingState.FAILED
            return
        self._method = method
        self._turned = self._past_edge = self._searching = False
        if method.direction == 0:
            self.state = HomingState.IN_PROGRESS
            self._wake_ns = (now_ns // self.tick_ns + 1) * self.tick_ns
            return
        stuck = objects.zero_speed_inc_s() <= 0.0
        stuck = stuck or (method.switch != 0 and objects.switch_speed_inc_s() <= 0.0)
        if stuck:
            self.state = HomingState.FAILED
            return
        self.state = HomingState.IN_PROGRESS
        self._guard.homes(True)
        if method.index:
            self._inputs.watch_index(True)
        if not method.switch:
            self._seek_index(self.axis.count())
        elif not bits & method.switch:
            self._searching = True
            self._go(method.search, objects.switch_speed_inc_s())
        elif method.before:
            self._go(method.direction, objects.zero_speed_inc_s())
        else:
            self._go(-method.direction, objects.switch_speed_inc_s())

    def _meet_switch(self, edge: Edge) -> None:
        """Handle an edge of the method's switch: home itself, or an edge on the way to it."""
        method = self._method
        objects = self.objects.homing
        if self._past_edge:
            return
        forward = method.direction > 0
        if edge.forward == forward and edge.active != method.before:
            if method.index:
                self._seek_index(edge.count)
            else:
                self._attain(edge.count)
        elif edge.active == method.before:  # the switch is now in the state before the home edge
            self._searching = False
            self._go(method.direction, objects.zero_speed_inc_s())
        elif self._searching:  # passed it: return
            self._searching = False
            self._go(-method.direction, objects.switch_speed_inc_s())

    def _meet_limit(self) -> None:
        """Reverse at a limit switch if the method does so and it is the first time; else fail."""
        if self._searching and self._method.turns and not self._turned:
            self._turned = True
            self._go(-self._way, self.objects.homing.switch_speed_inc_s())
        else:
            self._fail()

    def _seek_index(self, start_count: int) -> None:
        """Move on to the first index pulse; fail beyond a turn from `start_count`."""
        objects = self.objects.homing
        speed = objects.zero_speed_inc_s()
        acceleration = objects.acceleration_inc_s2()
        self._past_edge = True
        self._searching = False
        turn = self.objects.settings.plant.encoder_increments_rev
        reach = turn + turn // 50 + int(speed * speed / (2.0 * acceleration)) + 1
        offset_inc = self.axis.position_inc() - self.axis.count()
        way = self._method.direction
        self._send(way, start_count + way * reach + offset_inc, speed)

    def _go(self, way: int, speed_inc_s: float) -> None:
        self._send(way, way * _FAR_INC, speed_inc_s)

    def _send(self, way: int, target_inc: int, speed_inc_s: float) -> None:
        self._way = way
        if self._inputs.bits & self._limit_in_the_way() & ~self._method.switch:
            self._meet_limit()
            return
        acceleration = self.objects.homing.acceleration_inc_s2()
        self.axis.move_to(target_inc, speed_inc_s, acceleration, acceleration)

    def _limit_in_the_way(self) -> int:
        return POSITIVE_LIMIT if self._way > 0 else NEGATIVE_LIMIT

    def _attain(self, count: int) -> None:
        self.axis.set_position(self.objects.homing.home_inc(), count)
        self._end(HomingState.ATTAINED)
        if self._method.direction:
            self.axis.ramp_to_rest(self.objects.homing.acceleration_inc_s2())

    def _fail(self) -> None:
        self.axis.ramp_to_rest(self.objects.homing.acceleration_inc_s2())
        self._end(HomingState.FAILED)

    def _end(self, state: HomingState) -> None:
        """End the homing and restore the monitoring of inputs and limits."""
        if self.state is HomingState.IN_PROGRESS and self._method.index:
            self._inputs.watch_index(False)
        self.state = state
        self._wake_ns = NEVER
        self._guard.homes(False)

    def _moves(self) -> bool:
        axis = self.axis
        return axis.demand_velocity_inc_s() != 0.0 or (axis.is_braking and not axis.stands())
