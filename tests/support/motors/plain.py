"""An adaptation to ideal hardware in memory, with switches to make it fail.

Nothing of motorapi is replaced: this is one more kind of hardware.
"""

from dataclasses import replace
from math import floor

from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.errors import LinkError, MotionInterrupted, PeerError
from motorhil.motorapi.generation import shortest
from motorhil.motorapi.model import MotorModel
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.ownership.physical_motor import (
    register_physical_motor,
    release_physical_motor,
)
from motorhil.motorapi.state import Fault, Measurement, MotorState
from motorhil.motorapi.synchronization.offer import SyncOffer
from motorhil.motorapi.synchronization.quality import MotionTimes, SyncLevel

MODEL = MotorModel(name="plain", velocity_max=2.0, acceleration_max=4.0)
ABLE = {
    (ControlMode.SETPOINT, ControlVariable.POSITION),
    (ControlMode.SETPOINT, ControlVariable.VELOCITY),
    (ControlMode.SETPOINT, ControlVariable.TORQUE),
    (ControlMode.TRAJECTORY, ControlVariable.POSITION),
}


class PlainBus:
    """The common trigger of some motors."""

    def __init__(self, name="bus0"):
        self.name = name
        self.hardware = []
        self.fired = 0
        self.fire_error = None

    def fire(self):
        if self.fire_error is not None:
            raise self.fire_error
        self.fired += 1
        for hardware in self.hardware:
            hardware.begin()


class PlainHwMotor:
    """One motor in memory. `log` lists its calls in order; `fail[hook]` is raised there.

    position_step, velocity_step, acceleration_step: its rounding units (0: none).
    latency_s: from trigger to motion.  acts_s: duration of an action on the bus.
    lock: shared with other processes.
    """

    def __init__(
        self,
        runtime,
        node=1,
        bus=None,
        *,
        position=0.0,
        acts_s=0.0,
        latency_s=0.0,
        position_step=0.0,
        velocity_step=0.0,
        acceleration_step=0.0,
        lock=None,
    ):
        self.runtime = runtime
        self.bus = bus if bus is not None else PlainBus()
        self.node = node
        self.place = (self.bus.name, node)
        label = f"{self.bus.name} node {node}"
        self.physical = register_physical_motor(runtime, self.place, label, self, lock)
        self.bus.hardware.append(self)
        self.acts_s = acts_s
        self.latency_s = latency_s
        self.steps = (position_step, velocity_step, acceleration_step)
        self.log = []
        self.fail = {}
        self.polled_s = 0.001
        self.state = MotorState.DISABLED
        self.fault = None
        self.referenced = False
        self.heard = True
        self.armed = None
        self.motion = None
        self.held = position
        self.began_ns = 0
        self.ended_ns = None
        self.speed = 0.0
        self.after_fire = None
        self.connecting_s = 0.0
        self.sag = 0.0  # its drop when the brake is released

    def __repr__(self):
        return f"PlainHwMotor({self.bus.name!r}, node={self.node})"

    def close(self):
        release_physical_motor(self.runtime, self.place, self)

    def act(self, name, *facts):
        """Perform one exchange on the bus, which takes time and may fail."""
        self.log.append((name, *facts))
        if self.acts_s:
            self.runtime.wait_until(lambda: False, self.acts_s)
        if name in self.fail:
            raise self.fail[name]

    def begin(self):
        if self.armed is None:
            return
        self.held = self.position()
        self.motion, self.armed = self.armed, None
        self.began_ns = self.runtime.now_ns() + round(self.latency_s * 1e9)
        self.ended_ns = None
        self.speed = self.motion.target if self.is_velocity() else 0.0

    def is_velocity(self):
        return self.motion is not None and self.motion.variable is ControlVariable.VELOCITY

    def profile(self):
        motion = self.motion
        distance = motion.target - self.held
        return shortest(distance, motion.velocity, motion.acceleration, motion.deceleration)

    def elapsed_s(self):
        return (self.runtime.now_ns() - self.began_ns) / 1e9

    def position(self):
        if self.motion is None or self.motion.variable is ControlVariable.TORQUE:
            return self.held
        if self.is_velocity():
            return self.held + self.speed * self.elapsed_s()
        return self.held + self.profile().position(self.elapsed_s())

    def velocity(self):
        if self.motion is None:
            return 0.0
        return self.speed if self.is_velocity() else self.profile().velocity(self.elapsed_s())

    def freeze(self):
        self.held = self.position()
        self.motion = self.armed = None
        self.speed = 0.0

    def done(self):
        if self.armed is not None:
            return False
        if self.motion is None or self.motion.variable is not ControlVariable.POSITION:
            return True
        # Half a nanosecond: time is an integer number of them, the end of the profile is not.
        return self.elapsed_s() >= self.profile().duration_s - 0.5e-9


class PlainMotor(Motor):
    def __init__(self, hardware, model=MODEL, name=None):
        self.hw = hardware
        super().__init__(
            name=name or f"m{hardware.node}",
            model=model,
            runtime=hardware.runtime,
            physical=hardware.physical,
        )

    def _supports(self, mode, variable):
        return (mode, variable) in ABLE

    def _sync_offer(self):
        bound = (self.hw.latency_s, self.hw.latency_s)
        return SyncOffer(
            *(SyncLevel.TRIGGERED, self.hw.bus.name, bound, "one signal of its bus"),
            oscillator_ppm=0.0,
            end_s=(0.0, 0.0),
        )

    def _quantise(self, motion):
        position_step, velocity_step, acceleration_step = self.hw.steps
        if position_step:
            target = round(motion.target / position_step) * position_step
            motion = replace(motion, target=target)
        return replace(
            motion,
            velocity=_floor(motion.velocity, velocity_step),
            acceleration=_floor(motion.acceleration, acceleration_step),
            deceleration=_floor(motion.deceleration, acceleration_step),
        )

    def _connect(self):
        if "_connect" in self.hw.fail:
            raise self.hw.fail["_connect"]
        if self.hw.connecting_s:
            self.runtime.wait_until(lambda: False, self.hw.connecting_s)

    def _read_state(self):
        return self.hw.state

    def _read_fault(self):
        return self.hw.fault

    def _read_referenced(self):
        return self.hw.referenced

    def _read_position(self):
        return self.hw.position()

    def _read_velocity(self):
        return self.hw.velocity()

    def _read_reference(self):
        return self.hw.position()

    def _latest(self):
        hw = self.hw
        return Measurement(self.runtime.now_ns(), hw.state, hw.position(), hw.velocity())

    def _refresh(self):
        return self.hw.polled_s

    def _enable(self):
        self.hw.act("_enable")
        self.hw.held -= self.hw.sag
        self.hw.state = MotorState.ENABLED

    def _disable(self):
        self.hw.act("_disable")
        self.hw.freeze()
        self.hw.state = MotorState.DISABLED

    def _reset_fault(self):
        self.hw.act("_reset_fault")
        self.hw.fault = None
        self.hw.state = MotorState.DISABLED

    def _home(self, method):
        self.hw.act("_home", method)
        self.hw.referenced = True

    def _arm(self, motion, *, together):
        self.hw.act("_arm", together)
        self.hw.armed = self._quantise(motion)
        return self.hw.bus

    def _disarm(self):
        self.hw.act("_disarm")
        self.hw.armed = None

    def _confirm(self, motion):
        self.hw.act("_confirm")
        if self.hw.after_fire is not None:
            self.hw.after_fire()

    def _is_done(self):
        hw = self.hw
        if hw.fault is not None:
            fault = hw.fault
            raise fault.as_error(self.name)
        if not hw.heard:
            raise LinkError(link=self._physical.label, reason="no longer heard")
        if "_is_done" in hw.fail:
            raise hw.fail["_is_done"]
        done = hw.done()
        if done and hw.ended_ns is None:
            hw.ended_ns = self.runtime.now_ns()
        return done

    def _stop(self):
        self.hw.log.append(("_stop",))
        if "_stop" in self.hw.fail:
            raise self.hw.fail["_stop"]
        self.hw.freeze()

    def _quick_stop(self):
        self.hw.log.append(("_quick_stop",))
        self.hw.freeze()
        self.hw.state = MotorState.STOPPED

    def _motion_times(self):
        return MotionTimes(self.hw.began_ns, self.hw.ended_ns, "the motor's own clock")


def _floor(value, step):
    return max(floor(value / step * (1 + 1e-12)), 1) * step if step else value


def fault_now(hardware, code=0x7500, text="communication"):
    hardware.fault = Fault(code, text, hardware.runtime.now_ns())
    hardware.state = MotorState.FAULT
    hardware.freeze()


__all__ = ["MODEL", "MotionInterrupted", "PeerError", "PlainBus", "PlainHwMotor", "PlainMotor"]
