"""The adaptation of the motor interface to drives with impedance control.

| command         | stream of commands                                          |
| --------------- | ----------------------------------------------------------- |
| position        | the demand with its velocity; kp, kd; torque of the inertia |
| velocity        | a ramp; kp = 0                                              |
| torque          | a ramp; kp = kd = 0: nothing limits the velocity            |
| stop, halt      | a ramp to rest, then that position                          |
| homing (35, 37) | off, zero here, on                                          |

Motors start one after another: there is no common signal.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from math import copysign
from typing import TYPE_CHECKING, Final, final

from motorhil.motorapi.adaptations.mit.frames import (
    MODELS,
    Command,
    Frames,
    Maker,
    Special,
)
from motorhil.motorapi.adaptations.mit.hardware import (
    FOLLOWING_ERROR,
    MitHwMotor,
    MitOptions,
    Plan,
)
from motorhil.motorapi.api import (
    REQUIRED,
    ControlMode,
    ControlVariable,
    DeadlineExceeded,
    Fault,
    LimitError,
    Measurement,
    Motion,
    MotionKind,
    MotionTimes,
    Motor,
    MotorModel,
    MotorState,
    PeerError,
    Ramps,
    Setpoint,
    Shared,
    SyncOffer,
    Trajectory,
    TrapezoidalTrajectory,
    UnsupportedError,
    UsageError,
    adaptation,
    can_stream,
    demand_of,
    read_settings,
    require_time,
    text,
    whole,
    word,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import can

    from motorhil.motorapi.api import Runtime

_HERE: Final = (None, 35, 37)


@final
class MitMotor(Motor):
    """A logical motor on such a drive; several of them may share one hardware object."""

    def __init__(
        self,
        hardware: MitHwMotor,
        model: MotorModel,
        *,
        name: str | None = None,
        on_close: "Callable[[], None] | None" = None,
    ) -> None:
        drive = hardware.drive
        super().__init__(
            name=name,
            model=model,
            runtime=drive.runtime,
            physical=drive.physical,
            on_close=on_close,
        )
        if model.kind is not MotionKind.ROTARY:
            raise UsageError(f"motor model {model.name}: kind = linear; expected rotary")
        self._hardware = hardware
        self._sign: Final = -1.0 if (model.gear_ratio or 1.0) < 0.0 else 1.0

    @property
    def hardware(self) -> MitHwMotor:
        """The drive, with all its abilities."""
        return self._hardware

    # --- the six -----------------------------------------------------------------------------

    def _connect(self) -> None:
        self._hardware.connect()

    def _latest(self) -> Measurement | None:
        hardware, answer, sign = self._hardware, self._hardware.answer, self._sign
        if answer is None:
            return None
        state = MotorState.ENABLED if hardware.is_held else MotorState.DISABLED
        behind = 0.0 if hardware.behind is None else sign * hardware.behind
        return Measurement(
            *(hardware.time_ns, MotorState.FAULT if hardware.fault else state),
            *(sign * answer.p, sign * answer.v, sign * answer.t, behind),
        )

    def _enable(self) -> None:
        hardware = self._hardware
        if hardware.plan is not None and hardware.is_on:
            return  # after a quick stop
        hardware.hold_here()
        hardware.ask(
            Special.ENTER, lambda: hardware.is_on or self._fault() is not None, "motor mode"
        )
        self._check_fault()

    def _disable(self) -> None:
        hardware = self._hardware
        hardware.release()
        hardware.ask(Special.LEAVE, lambda: not hardware.is_on, "the end of motor mode")

    def _command(self, motion: Motion) -> None:
        require_time(self.name, motion)
        limit, furthest = self._hardware.frames.ranges.p, motion.target
        if motion.function is not None:
            low, high = motion.function.bounds(*motion.interval)
            furthest = motion.offset + max(low, high, key=lambda end: abs(motion.offset + end))
        if motion.variable is ControlVariable.POSITION and abs(furthest) > limit:
            raise LimitError(
                motor=self.name,
                quantity="position",
                value=furthest,
                low=-limit,
                high=limit,
                unit="rad",
                reason="the range of the drive's frames",
            )
        self._hardware.follow(*self._planned(motion))

    def _stop(self) -> None:
        hardware, size = self._hardware, self._physical.stop_deceleration(self.model.deceleration)
        answer, now = hardware.answer, hardware.present()
        if not hardware.is_on or answer is None:
            return
        p, v = (now.p, now.v) if now.kp else (answer.p, answer.v)
        slower = -size if v > 0.0 else size
        end_s = abs(v) / size
        kp, kd = hardware.options.kp_n_m_rad, hardware.options.kd_n_m_s_rad

        def plan(at_s: float) -> Command:
            s = min(at_s, end_s)
            return Command(p + (v + 0.5 * slower * s) * s, v + slower * s, kp, kd)

        hardware.stop(plan)

    # --- capabilities ------------------------------------------------------------------------

    def _supports(self, mode: ControlMode, variable: ControlVariable) -> bool:
        return variable is not ControlVariable.CURRENT

    def _check_command(self, variable: ControlVariable, command: Setpoint | Trajectory) -> None:
        if not can_stream(variable, command):
            super()._check_command(variable, command)

    def _sync_offer(self) -> SyncOffer:
        return self._hardware.start_offer()

    def _motion_times(self) -> MotionTimes | None:
        return self._hardware.times()

    def _read_reference(self) -> float:
        held = self._hardware.present()
        return self._sign * held.p if held.kp else self._read_position()

    def _read_referenced(self) -> bool:
        return self._hardware.is_zeroed

    def _read_fault(self) -> Fault | None:
        return self._fault()

    def _is_done(self) -> bool:
        self._hardware.check_stream()
        if self._hardware.mismatch:
            raise PeerError(self._hardware.mismatch)
        return super()._is_done()

    def _reset_fault(self) -> None:
        hardware = self._hardware
        hardware.release()
        steps = [Special.LEAVE, Special.CLEAR]
        if hardware.frames.maker is Maker.CUBEMARS:  # it has no request to clear
            steps = [Special.LEAVE, Special.ENTER, Special.LEAVE]
        hardware.fault = 0
        with suppress(DeadlineExceeded):  # the fault remains
            for one in steps:
                hardware.tell(one)
            hardware.ask(steps[-1], lambda: self._fault() is None, "the end of the fault")
        self._check_fault()

    def _home(self, method: int | None) -> None:
        if method not in _HERE:
            feature = f"homing by method {method}"
            raise UnsupportedError(motor=self.name, feature=feature, supported="35, 37")
        self._disable()
        self._hardware.set_zero()
        self._enable()

    def _open_low_level(self) -> MitHwMotor:
        return self._hardware

    def _close_low_level(self) -> None:
        self._hardware.drive.doubt()

    # --- helpers -----------------------------------------------------------------------------

    def _planned(self, motion: Motion) -> tuple[Plan, float]:
        """Return the commands of a motion, and its duration [s]."""
        sign, options = self._sign, self._hardware.options
        kp, kd, inertia = options.kp_n_m_rad, options.kd_n_m_s_rad, options.inertia_kg_m2
        friction = options.friction_n_m
        if motion.variable is ControlVariable.POSITION:
            if motion.trajectory is None:
                motion = replace(motion, trajectory=TrapezoidalTrajectory(motion.distance))
            demand = demand_of(motion)
            begin = demand.initial_argument

            def position(at_s: float) -> Command:
                at = begin + at_s
                p, v, a = demand.value(at), demand.first(at), demand.second(at)
                rubs = copysign(friction, v) if v else 0.0
                return Command(sign * p, sign * v, kp, kd, sign * (inertia * a + rubs))

            return position, demand.final_argument - begin
        present, answer = self._hardware.present(), self._hardware.answer
        assert answer is not None  # connected
        if motion.variable is ControlVariable.VELOCITY:
            before = present.v if present.kd and not present.kp else answer.v
            ramps = Ramps(sign * before, motion.target, motion.acceleration, motion.deceleration)

            def velocity(at_s: float) -> Command:
                v = sign * _at(ramps, motion, at_s)
                return Command(0.0, v, 0.0, kd, copysign(friction, v) if v else 0.0)

            return velocity, ramps.duration_s
        ramps = Ramps(sign * present.t, motion.target, motion.slope, motion.slope)
        return lambda at_s: Command(t=sign * _at(ramps, motion, at_s)), ramps.duration_s

    def _fault(self) -> Fault | None:
        hardware, code = self._hardware, self._hardware.fault
        faults = {FOLLOWING_ERROR: "following error", **hardware.frames.maker.faults}
        texts = [faults[code]] if code in faults else [t for c, t in faults.items() if code & c]
        return Fault(code, ", ".join(texts) or "unknown", hardware.fault_ns) if code else None


def _at(ramps: Ramps, motion: Motion, at_s: float) -> float:
    on_ramp = ramps.at(at_s)
    return motion.target if on_ramp is None else on_ramp[0]


_SHARED: Final[Shared[MitHwMotor]] = Shared("drive")


def build_with(
    bus: "can.BusABC", frames: Frames, own: MitOptions, model: MotorModel, runtime: "Runtime"
) -> MitMotor:
    """Build a motor on the drive with these frames; motors on one drive share it."""
    options = own.part(MitOptions)
    hardware = _SHARED.get(
        bus,
        frames.node_id,
        lambda: MitHwMotor(bus, frames, runtime=runtime, options=options),
        lambda built: built.options == options and built.frames.ranges == frames.ranges,
    )
    name: str | None = getattr(own, "name", None)
    return MitMotor(hardware, model, name=name, on_close=lambda: _SHARED.give_back(hardware))


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class MitTable(MitOptions):
    """A motor behind a drive with MIT frames."""

    node_id: int = whole(REQUIRED, 1, 127, "", "Identifier of requests.", example="1")
    master_id: int = whole(0, 0, 0x7FF, "", "Identifier of answers.")
    drive: str = word("ak80_6_v2", MODELS, "model", "Its model, which determines the ranges.")
    name: str | None = text(None, "Name of the motor; absent: the model's.")


@adaptation(api=1)
def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: MotorModel, runtime: "Runtime"
) -> MitMotor:
    """Build the motor that a table of settings describes; motors on one drive share it.

    Raises:
        UsageError: a setting is unknown, missing, or wrong.
    """
    own = read_settings(MitTable, settings)
    maker, ranges = MODELS[own.drive]
    frames = Frames(own.node_id, own.master_id, maker, own.ranges(ranges))
    return build_with(bus, frames, own, model, runtime)
