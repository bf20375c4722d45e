"""A PR-mode drive: sixteen paths, a trigger register, a status word.

A path takes effect with the register values at its trigger. A path that does not interrupt waits
for the running one (one can wait). Writing the trigger starts a motion. A relative path that is
triggered twice is executed twice, whatever is written to the registers in between.

Homing searches a switch, backs off, and sets zero there. Bit 0 of the homing mode is the direction
(1: forward). Bit 2 selects the home switch, otherwise the limit switch of that side. Without such a
switch the search continues until it is stopped, as in the real drive.
"""

from collections.abc import Callable, Mapping
from enum import Enum
from typing import Final, final

from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import NEVER_NS
from motorhil.emulators.leadshine_pr import registers as r
from motorhil.emulators.leadshine_pr.settings import LeadshineTable
from motorhil.emulators.modbus.drive import ModbusDrive
from motorhil.emulators.modbus.registers import RegisterBank
from motorhil.emulators.modbus.server import Identification
from motorhil.emulators.modbus.settings import DriveBuilder, ModbusDriveSettings

_FUNCTIONS: Final = (0x03, 0x06, 0x08, 0x10, 0x11, 0x2B)
_JOG_NS: Final = 50_000_000  # a jog ends so long after the last word that commands it: *
_MS: Final = 1_000_000
_NONE: Final = -1
_FOLLOWING_RPM_MS: Final = 0.5  # of a revolution: following error that raises the alarm
_FORWARD: Final = 0x0001  # of the homing mode
_HOME_SWITCH: Final = 0x0004


@final
class _Phase(Enum):
    IDLE = 0
    LEAVING = 1  # it began on the switch
    SEARCHING = 2
    STOPPING = 3
    BACKING = 4
    SETTLING = 5


@final
class Homing:
    """The search for the switch, tick by tick."""

    def __init__(self, drive: "LeadshinePr") -> None:
        self._drive = drive
        self._phase = _Phase.IDLE

    def is_active(self) -> bool:
        """Return whether homing is in progress."""
        return self._phase is not _Phase.IDLE

    def begin(self) -> None:
        """Begin the search for the switch."""
        self._phase = _Phase.LEAVING if self._closed() else _Phase.SEARCHING
        if self._phase is _Phase.LEAVING:
            self._run(-self._way() * self._drive.bank["homing_speed_low"])
        else:
            self._run(self._way() * self._drive.bank["homing_speed_high"])

    def abandon(self) -> None:
        """End homing, successful or not."""
        self._phase = _Phase.IDLE

    def settle(self) -> None:
        """Advance the phases according to the position of the axis."""
        drive, phase = self._drive, self._phase
        if phase is _Phase.SEARCHING and self._closed():
            self._phase = _Phase.STOPPING
            drive.axis.ramp_to_rest(drive.inc_s2(drive.bank["homing_deceleration"]))
        elif phase is _Phase.STOPPING and not drive.axis.flags & f.PROFILE_ACTIVE:
            self._phase = _Phase.BACKING
            self._run(-self._way() * drive.bank["homing_speed_low"])
        elif phase in (_Phase.BACKING, _Phase.LEAVING) and not self._closed():
            at_switch = drive.inc(drive.bank["zero_position"])
            drive.axis.set_position(at_switch)
            drive.axis.ramp_to_rest(drive.inc_s2(drive.bank["homing_deceleration"]))
            self._phase = _Phase.SETTLING
        elif phase is _Phase.SETTLING and not drive.axis.flags & f.PROFILE_ACTIVE:
            drive.is_homed = True
            self._phase = _Phase.IDLE

    def _way(self) -> int:
        return 1 if self._drive.bank["homing_mode"] & _FORWARD else -1

    def _closed(self) -> bool:
        if self._drive.bank["homing_mode"] & _HOME_SWITCH:
            return self._drive.home_closed()
        forward, backward = self._drive.limits_closed()
        return forward if self._way() > 0 else backward

    def _run(self, rpm: int) -> None:
        drive = self._drive
        drive.axis.run_at(
            drive.inc_s(rpm),
            drive.inc_s2(drive.bank["homing_acceleration"]),
            drive.inc_s2(drive.bank["homing_deceleration"]),
        )


@final
class LeadshinePr(ModbusDrive):
    """The drive; `register_map` documents its registers.

    Raises: as `ModbusDrive`.
    """

    def __init__(self, settings: ModbusDriveSettings) -> None:
        names = {0: "motorhil", 1: "PR-mode drive", 2: "1.0"}
        super().__init__(settings, RegisterBank(r.ROWS), Identification(names), _FUNCTIONS)
        sides_rad = settings.limit_forward_rad, settings.limit_backward_rad
        self._has_limits = sides_rad != (None, None)
        self._homing = Homing(self)
        self._path = _NONE  # that runs, or dwells
        self._waiting = _NONE  # that runs next
        self._dwell_until_ns = NEVER_NS
        self._is_positioning = False
        self._jog_until_ns = NEVER_NS
        self._command_done = True
        self._path_done = True
        self.is_homed: bool = False
        self._bind()

    def _bind(self) -> None:
        bank = self.bank
        bank.on_read("motion_status", self.status)
        bank.on_read("feedback_position", lambda: self.pulses(self.axis.position_inc()))
        bank.on_read("motor_position", lambda: self.pulses(self.axis.demand_inc()))
        bank.on_read("feedback_speed", self._speed_rpm)
        bank.on_read("trigger", self._trigger_state)
        bank.on_write("trigger", self._triggered)
        bank.on_write("control_word", self._controlled)
        bank.on_write("force_enable", self._enabled)
        bank.on_write("path0_special", self._special)
        bank.on_write("peak_current", self._limit_current)

    # --- units ---------------------------------------------------------------------------------

    def _sign(self) -> int:
        return -1 if self.bank["direction"] else 1

    def pulses(self, inc: int) -> int:
        """Convert encoder increments to pulses, rounded down."""
        return self._sign() * inc * self.bank["pulses_per_revolution"] // self.turn_inc

    def inc(self, pulses: int) -> int:
        """Convert pulses to encoder increments, rounded down."""
        return self._sign() * pulses * self.turn_inc // self.bank["pulses_per_revolution"]

    def inc_s(self, rpm: float) -> float:
        """Convert a velocity from rpm to [inc/s]."""
        return rpm * self.turn_inc / 60.0

    def inc_s2(self, ms: int) -> float:
        """Convert an acceleration, given as [ms] for a change of 1000 rpm, to [inc/s^2]."""
        return self.inc_s(1000.0) * 1000.0 / ms

    def _speed_rpm(self) -> int:
        return int(self._sign() * self.axis.velocity_inc_s() * 60.0 / self.turn_inc + 0.5)

    # --- values read -----------------------------------------------------------------------------

    def is_enabled(self) -> bool:
        """Return whether the motor has current."""
        return bool(self.bank["force_enable"]) and not self.bank["alarm"]

    def is_running(self) -> bool:
        """Return whether a motion is running or pending."""
        busy = self._homing.is_active() or self._jog_until_ns != NEVER_NS
        return busy or bool(self.axis.flags & f.PROFILE_ACTIVE) or self._path != _NONE

    def status(self) -> int:
        """Return the status word, 1003h."""
        word = r.FAULT if self.bank["alarm"] else 0
        word |= r.ENABLED if self.is_enabled() else 0
        word |= r.RUNNING if self.is_running() else 0
        word |= r.COMMAND_DONE if self._command_done else 0
        word |= r.PATH_DONE if self._path_done else 0
        return word | (r.HOMED if self.is_homed else 0)

    def _trigger_state(self) -> int:
        if self._path != _NONE:
            return r.PATH_RUNS | self._path
        if self._command_done and not self._path_done:
            return r.POSITIONING_DONE
        return 0

    # --- values written --------------------------------------------------------------------------

    def _enabled(self, value: int) -> int:
        if value and not self.bank["alarm"]:
            self.axis.power(True)
        else:
            self._abandon()
            self.axis.power(False)
        return 0

    def _limit_current(self, value: int) -> int:
        self.axis.set_current_limit(value / 10.0)
        return 0

    def _special(self, value: int) -> int:
        """Trigger by the eighth register of path 0: one request sets and starts a motion."""
        return self._triggered(value) if value & 0xFF0 == r.RUN_PATH else 0

    def _triggered(self, value: int) -> int:
        if value == r.QUICK_STOP:
            self._stop(self.bank["quick_stop_deceleration"])
        elif value == r.SET_ZERO:
            if not self.is_running():
                self.axis.set_position(0)
                self.is_homed = True
        elif not self.is_enabled():
            if value:
                self.tell("warning", f"trigger {value:03X}h ignored: the motor is not enabled")
        elif value == r.RUN_HOMING:
            self._abandon()
            self._command_done = self._path_done = False
            self._homing.begin()
        elif value & ~0x00F == r.RUN_PATH:
            self._request(value & 0x00F)
        return 0

    def _request(self, path: int) -> None:
        mode = self.bank[f"path{path}_mode"]
        if self._is_positioning and not mode & r.INTERRUPTS:
            self._waiting = path
            return
        self._begin(path)

    def _begin(self, path: int) -> None:
        for _ in range(r.PATHS):
            path = self._run(path)
            if path == _NONE:
                return
        self.tell("warning", "paths without a motion jump in a circle; the last one ends")

    def _run(self, path: int) -> int:
        """Run a path; return the path that follows at once, if it has no motion."""
        bank, axis = self.bank, self.axis
        self._homing.abandon()
        self._waiting, self._jog_until_ns, self._dwell_until_ns = _NONE, NEVER_NS, NEVER_NS
        mode = bank[f"path{path}_mode"]
        kind = mode & r.KIND_MASK
        faster = self.inc_s2(bank[f"path{path}_acceleration"])
        slower = self.inc_s2(bank[f"path{path}_deceleration"])
        speed = bank[f"path{path}_speed"]
        self._path, self._command_done, self._path_done = path, False, False
        self._is_positioning = kind == r.POSITIONING
        if kind == r.POSITIONING:
            pulses = bank[f"path{path}_position"]
            if mode & r.RELATIVE:
                target = self.inc(pulses) + axis.demand_inc()
            else:
                target = self.inc(pulses + self.wraps(self.pulses(axis.demand_inc())))
            axis.move_to(target, self.inc_s(abs(speed)), faster, slower)
        elif kind == r.VELOCITY:
            axis.run_at(self._sign() * self.inc_s(speed), faster, slower)
        elif kind == r.HOMING:
            self._path = _NONE
            self._homing.begin()
        else:
            return self._end()
        return _NONE

    def _controlled(self, value: int) -> int:
        if value == r.RESET_ALARM:
            if self.bank["alarm"]:
                self.bank["alarm"] = 0
                self.tell("info", "alarm reset")
                self._enabled(self.bank["force_enable"])
        elif value == r.SAVE:
            self.bank.keep(r.SAVED)
            self.tell("info", "parameters saved")
        elif value == r.RESTORE:
            self.tell("info", "parameters as delivered, from the next power-on")
            self.bank.forget_kept()
        elif value in (r.JOG_FORWARD, r.JOG_BACKWARD) and self.is_enabled():
            self._jog(1 if value == r.JOG_FORWARD else -1)
        return 0

    def _jog(self, way: int) -> None:
        ramp = self.inc_s2(self.bank["jog_acceleration"])
        if self._jog_until_ns == NEVER_NS:
            self._abandon()
            self._command_done = self._path_done = False
        self._jog_until_ns = self.now_ns + _JOG_NS
        self.axis.run_at(way * self._sign() * self.inc_s(self.bank["jog_speed"]), ramp, ramp)

    # --- events ----------------------------------------------------------------------------------

    def power_on(self) -> None:
        """Power on without a motion; the motor has current if its register says so."""
        self._abandon()
        self.is_homed = False
        self._command_done = self._path_done = True
        self._limit_current(self.bank["peak_current"])
        following_inc = round(_FOLLOWING_RPM_MS * self.turn_inc)
        self.axis.set_windows(following_window_inc=following_inc, following_window_ns=100 * _MS)
        self._enabled(self.bank["force_enable"])

    def power_off(self) -> None:
        """Forget everything except saved parameters."""
        self._abandon()

    def settle(self) -> None:
        """End a path, its dwell or an unrepeated jog, and start the next path."""
        if self.axis.flags & f.FOLLOWING_ERROR and self.is_enabled():
            self.alarm(r.FOLLOWING_ERROR)
        if not self.is_enabled():
            return
        if self._homing.is_active():
            self._homing.settle()
            if not self._homing.is_active():
                self._command_done = self._path_done = True
            return
        if self.now_ns >= self._jog_until_ns:
            self._stop(self.bank["jog_acceleration"])
        self._look_at_limits()
        if self._path != _NONE:
            self._follow_path()
        elif not self._path_done and not self.axis.flags & f.PROFILE_ACTIVE:
            self._command_done = self._path_done = True

    def _follow_path(self) -> None:
        if not self._is_positioning:
            self._command_done = bool(self.axis.flags & f.IN_VELOCITY_WINDOW)
            return
        if self.axis.flags & f.PROFILE_ACTIVE:
            return
        if self._dwell_until_ns == NEVER_NS:
            self._command_done = True
            self._dwell_until_ns = self.now_ns + self.bank[f"path{self._path}_dwell"] * _MS
        if self.now_ns < self._dwell_until_ns or not self.axis.flags & f.IN_TARGET_WINDOW:
            return
        follower = self._end()
        if follower != _NONE:
            self._begin(follower)

    def _end(self) -> int:
        """End the path; return the one that follows."""
        mode, follower = self.bank[f"path{self._path}_mode"], self._waiting
        if follower == _NONE and mode & r.JUMPS:
            follower = mode >> r.JUMP_SHIFT & 0x0F
        self._path, self._is_positioning, self._dwell_until_ns = _NONE, False, NEVER_NS
        self._command_done = self._path_done = True
        return follower

    def _look_at_limits(self) -> None:
        if self._path == _NONE and self._jog_until_ns == NEVER_NS:
            return  # nothing runs, or it slows down already
        forward, backward = self.limits_closed()
        velocity = self.axis.demand_velocity_inc_s()
        if (forward and velocity > 0.0) or (backward and velocity < 0.0):
            side = "forward" if velocity > 0.0 else "backward"
            self.tell("warning", f"stopped at the {side} limit switch")
            self._stop(self.bank["limit_deceleration"])

    def wake_ns(self) -> int:
        """Return the end of a dwell or a jog; while switches matter, the next tick."""
        due_ns = self._jog_until_ns
        if self.now_ns < self._dwell_until_ns < due_ns:  # after it, the target window is awaited
            due_ns = self._dwell_until_ns
        if self._homing.is_active() or (self._has_limits and self.is_running()):
            tick_ns = self.settings.tick_ns
            due_ns = min(due_ns, (self.now_ns // tick_ns + 1) * tick_ns)
        return due_ns

    def _stop(self, ramp_ms: int) -> None:
        running = self.is_running()
        self._abandon()
        if self.is_enabled() and running:
            self._command_done = self._path_done = False
            self.axis.ramp_to_rest(self.inc_s2(ramp_ms))

    def _abandon(self) -> None:
        self._homing.abandon()
        self._path, self._waiting = _NONE, _NONE
        self._is_positioning = False
        self._dwell_until_ns = self._jog_until_ns = NEVER_NS

    def alarm(self, code: int) -> None:
        """Raise the alarm: no motion, and no current."""
        self.tell("error", f"alarm {code:02X}h")
        self.bank["alarm"] = code
        self._abandon()
        self.axis.power(False)

    def own_stimuli(self) -> Mapping[str, Callable[[float], None]]:
        """Return the stimulus of an emergency stop input (22h)."""
        return {"emergency_stop": self._emergency_stop}

    def _emergency_stop(self, value: float) -> None:
        if value not in (0, 1):
            raise ValueError(f"emergency_stop is 0 or 1, not {value}")
        if value:
            self._stop(self.bank["quick_stop_deceleration"])

    def own_truth(self) -> Mapping[str, float]:
        """Return its status word and the running path (-1: none)."""
        return {"status": float(self.status()), "path": float(self._path)}


build: Final = DriveBuilder(LeadshinePr, r.ROWS, LeadshineTable)
