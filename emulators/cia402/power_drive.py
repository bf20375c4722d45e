"""The power drive: state machine, power stage, option codes, faults and the mode that has the axis.

`pds_fsa` says which transition a controlword asks for; here it is earned: transition 4 waits for
the power stage, 5 and 8 for the motor to come to rest where 605Ch and 605Bh say so, 12 for the end
of the quick stop, 14 for the end of the fault reaction.
"""

from typing import Final, final

from emulators.canopen.shared import NEVER
from emulators.cia402.cyclic_position import CyclicPosition
from emulators.cia402.cyclic_torque import CyclicTorque
from emulators.cia402.cyclic_velocity import CyclicVelocity
from emulators.cia402.faults import (
    FOLLOWING_ERROR,
    UNDER_VOLTAGE,
    Standing,
    is_at_once,
)
from emulators.cia402.homing import Homing
from emulators.cia402.interpolated_position import InterpolatedPosition
from emulators.cia402.limit_guard import LimitGuard
from emulators.cia402.mode import Mode
from emulators.cia402.objects import DriveObjects
from emulators.cia402.pds_fsa import (
    NO_TRANSITION,
    Command,
    PdsFsa,
    PdsState,
    decode_controlword,
)
from emulators.cia402.profile_position import ProfilePosition
from emulators.cia402.profile_torque import ProfileTorque
from emulators.cia402.profile_velocity import ProfileVelocity
from emulators.cia402.servo_objects import ServoObjects
from emulators.cia402.settings import EMULATED_MODES
from emulators.cia402.statusword import TARGET_REACHED, compose
from emulators.cia402.touch_probe import TouchProbe
from emulators.cia402.written import (
    CONTROLWORD,
    FACTORS,
    GAINS,
    MODE,
    TORQUE_LIMIT,
    TOUCH_PROBE,
    WINDOWS,
)
from emulators.firmware import flags as f
from emulators.firmware.axis import Axis
from emulators.firmware.digital_inputs import DigitalInputs, Edge

NO_FAULT: Final = 0x0000

# 6007h, 605Ah
ABORT_FAULT: Final = 1
ABORT_DISABLE_VOLTAGE: Final = 2
ABORT_QUICK_STOP: Final = 3
_RUNNING_STATES: Final = (PdsState.OPERATION_ENABLED, PdsState.QUICK_STOP_ACTIVE)
_POWERED_STATES: Final = (PdsState.SWITCHED_ON, *_RUNNING_STATES)


@final
class PowerDrive:
    """One power drive system. All calls come after `axis.at(now_ns)`.

    Attributes:
        error_code: 603Fh.
        told: error codes since last cleared by the caller, in order; 0 says that a fault was reset.
        voltage: whether the power stage has its supply.
        mode: 6061h.
        modes: by 6061h; a quirk may put another one in a place before power comes on.
        is_watched: whether the plant may do something to a drive that is off.
        standing: what keeps a fault from being reset, or the drive from being readied; warnings.
        inputs: 60FDh.
        touch_probe: 60B8h and what comes of it.
    """

    def __init__(
        self,
        axis: Axis,
        objects: DriveObjects,
        inputs: DigitalInputs,
        tick_ns: int,
        enable_ns: int,
    ) -> None:
        self.fsa = PdsFsa(PdsState.NOT_READY_TO_SWITCH_ON)
        self.error_code: int = NO_FAULT
        self.told: list[int] = []
        self.voltage: bool = True
        self.mode: int = 0
        self.standing: Standing = Standing()
        self.is_watched: bool = objects.settings.plant.extras.is_any()
        self._axis = axis
        self._objects = objects
        self._enable_ns = enable_ns
        self._enable_due_ns: int = NEVER
        self._at_rest: int = NO_TRANSITION  # the transition to take when the motor has come to rest
        self._servo: ServoObjects = ServoObjects(axis, objects)
        self.inputs: DigitalInputs = inputs
        self.touch_probe: TouchProbe = TouchProbe(
            objects.od, axis, inputs, objects.factors, objects.written
        )
        self._guard = LimitGuard(axis, inputs, objects.motion)
        self._guard.apply()
        self._homing = Homing(axis, objects, tick_ns, inputs, self._guard)
        self.modes: dict[int, Mode] = {
            EMULATED_MODES["pp"]: ProfilePosition(axis, objects, tick_ns),
            EMULATED_MODES["pv"]: ProfileVelocity(axis, objects, tick_ns),
            EMULATED_MODES["tq"]: ProfileTorque(axis, objects, tick_ns),
            EMULATED_MODES["hm"]: self._homing,
            EMULATED_MODES["ip"]: InterpolatedPosition(axis, objects, tick_ns),
            EMULATED_MODES["csp"]: CyclicPosition(axis, objects, tick_ns),
            EMULATED_MODES["csv"]: CyclicVelocity(axis, objects, tick_ns),
            EMULATED_MODES["cst"]: CyclicTorque(axis, objects, tick_ns),
        }
        self._no_mode = Mode(axis, objects, tick_ns)
        self._active: Mode = self._no_mode

    # --- from outside

    def power_on(self) -> None:
        """Transition 0: the firmware starts; the motor has no current."""
        self._active.leave()
        self._axis.power(False)
        self._enable_due_ns = NEVER
        self._at_rest = NO_TRANSITION
        self._homing.forget()
        self.standing.noted.clear()
        self.error_code = NO_FAULT
        self.fsa.controlword = self._objects.controlword
        self.fsa.take(0)
        self._servo.apply_windows()
        self._servo.apply_limits_and_gains()
        self.touch_probe.configure()
        self._select(self._objects.mode)

    def initialised(self, now_ns: int) -> None:
        """Transition 1: the firmware has started."""
        if self.fsa.state is PdsState.NOT_READY_TO_SWITCH_ON:
            self._take(1, now_ns)
            for code in self.standing.causes:
                self.fault(code, now_ns)
            self._obey_level(now_ns)

    def written(self, what: int, now_ns: int) -> None:
        """Objects were written: first what the numbers mean, then the mode, then the command."""
        if what & FACTORS:
            self._objects.reload_units()
        if what & (WINDOWS | FACTORS):
            self._servo.apply_windows()
        if what & (GAINS | TORQUE_LIMIT):
            self._servo.apply_limits_and_gains()
        if what & TOUCH_PROBE:
            self.touch_probe.configure()
        self._guard.written(what)
        if what & MODE and self._objects.mode != self.mode:
            self._switch_mode(now_ns)
        if self.fsa.state is PdsState.OPERATION_ENABLED and self._at_rest == NO_TRANSITION:
            self._active.written(what, now_ns)
        if what & CONTROLWORD:
            self._write_controlword(self._objects.controlword, now_ns)

    def settle(self, now_ns: int) -> None:
        """Whatever has become due by now, or shows in the axis' flags, is done."""
        flags = self._axis.flags
        if self.is_watched and flags & f.OF_EXTRAS != self.standing.seen:
            is_on = self.fsa.state in _RUNNING_STATES
            for code in self.standing.see(flags & f.OF_EXTRAS, is_on):
                if self.fsa.state is not PdsState.NOT_READY_TO_SWITCH_ON:
                    self.fault(code, now_ns)
        if now_ns >= self._enable_due_ns:
            if self._has_supply():
                self._take(4, now_ns)
            else:
                self.fault(UNDER_VOLTAGE, now_ns)
        axis = self._axis
        if axis.flags & f.OUTSIDE_GATE:
            self.saw(self.inputs.look())
            flags = axis.flags
        state = self.fsa.state
        if flags & f.FOLLOWING_ERROR and state in _RUNNING_STATES:
            self.fault(FOLLOWING_ERROR, now_ns)
        if axis.is_braking and self._at_rest == NO_TRANSITION and axis.stands():
            axis.ramp_to_rest(self._objects.motion.deceleration_inc_s2())  # and holds
        if self._at_rest != NO_TRANSITION and axis.stands():
            self._take(self._at_rest, now_ns)
            self._obey_level(now_ns)
        elif state is PdsState.OPERATION_ENABLED:
            active = self._active
            active.settle(now_ns)
            if active.lost:
                self.fault(self._objects.settings.sync_lost_code, now_ns)

    def synced(self, now_ns: int) -> bool:
        """SYNC was on the bus; True: the mode does something about it."""
        active, state = self._active, self.fsa.state
        return active.heeds_sync and state is PdsState.OPERATION_ENABLED and active.synced(now_ns)

    def saw(self, edges: list[Edge]) -> None:
        """Digital inputs have changed."""
        self.touch_probe.sees(edges)
        if self.fsa.state is PdsState.OPERATION_ENABLED and self._at_rest == NO_TRANSITION:
            self._active.sees(edges)
        self._guard.sees(edges)

    def flags_matter(self) -> bool:
        """Whether the motor has current, the plant is watched, or an input waits for the axis."""
        state = self.fsa.state
        is_on = state in _RUNNING_STATES or state is PdsState.FAULT_REACTION_ACTIVE
        return is_on or self.is_watched or self.inputs.is_gated

    def deadline_ns(self) -> int:
        """When `settle` must be called at the latest [ns], flags aside; or NEVER."""
        wake_ns = self._active.wake_ns()
        return wake_ns if wake_ns < self._enable_due_ns else self._enable_due_ns

    def fault(self, code: int, now_ns: int) -> None:
        """Transition 13 with this error code (603Fh), and the reaction of the table of faults."""
        self.told.append(code)
        self.error_code = self.standing.note(code)  # the last one, though an earlier one has led
        state = self.fsa.state
        if state is PdsState.FAULT_REACTION_ACTIVE:
            if is_at_once(code):
                self._take(14, now_ns)
        elif state is not PdsState.FAULT:
            self._react(code, now_ns)

    def lose_reference(self) -> None:
        """The position no longer means what homing made it mean."""
        self._homing.forget()

    def take_torque_off(self, code: int, now_ns: int) -> None:
        """Safe torque off: a fault with this code where the power stage was on; 0 disables only."""
        state = self.fsa.state
        if state is PdsState.FAULT_REACTION_ACTIVE:
            self._take(14, now_ns)
        elif code and state in _POWERED_STATES:
            self.fault(code, now_ns)
        else:
            self._advance(Command.DISABLE_VOLTAGE, now_ns)

    def set_voltage(self, present: bool, now_ns: int) -> None:
        """The power stage's supply comes or goes; without it a motor cannot even be braked."""
        self.voltage = present
        state = self.fsa.state
        if present:
            return
        if state is PdsState.FAULT_REACTION_ACTIVE:
            self._take(14, now_ns)
        elif state in _RUNNING_STATES:
            self.fault(UNDER_VOLTAGE, now_ns)

    def abort_connection(self, code: int, now_ns: int) -> None:
        """The host is gone: 6007h says what follows while the power stage is on.

        A fault that follows is not told here: whoever noticed has done so, or nobody can.
        """
        state = self.fsa.state
        if state not in _POWERED_STATES:
            return
        option = self._objects.options.abort_connection()
        if option == ABORT_FAULT:
            self._react(code, now_ns)
        elif option == ABORT_DISABLE_VOLTAGE:
            self._advance(Command.DISABLE_VOLTAGE, now_ns)
        elif option == ABORT_QUICK_STOP:
            self._advance(Command.QUICK_STOP, now_ns)

    # --- what shows

    def statusword(self) -> int:
        """6041h as of the axis' flags."""
        state = self.fsa.state
        active = self._active
        if state is PdsState.OPERATION_ENABLED:
            mode_bits = active.status_bits()
        elif state is PdsState.QUICK_STOP_ACTIVE:
            mode_bits = TARGET_REACHED if self._axis.stands() else 0
        else:
            mode_bits = active.idle_bits()
        remote = state is not PdsState.NOT_READY_TO_SWITCH_ON
        limit = active.limited or self._guard.is_active
        return compose(state, mode_bits, self.voltage, remote, limit, self.standing.warnings != 0)

    # --- inside

    def _write_controlword(self, word: int, now_ns: int) -> None:
        fsa = self.fsa
        previous = fsa.controlword
        if self._at_rest == NO_TRANSITION and fsa.holds(word):  # as in each cycle of a host's
            self._active.obey(word, 0, now_ns)
            return
        command = fsa.command(word)
        if command is Command.ENABLE_OPERATION:
            if self._at_rest in (5, 8):  # enabled again before it stood: nothing was disabled
                self._at_rest = NO_TRANSITION
                self._active.enter(word, now_ns)
        elif command is not None:
            self._enable_due_ns = NEVER
        self._advance(command, now_ns)
        if fsa.state is PdsState.OPERATION_ENABLED and self._at_rest == NO_TRANSITION:
            self._active.obey(word, word & ~previous, now_ns)

    def _obey_level(self, now_ns: int) -> None:
        """A transition happened by itself: the controlword, as it stands, may ask for the next."""
        word = self.fsa.controlword
        self._advance(decode_controlword(word, word), now_ns)

    def _advance(self, command: Command | None, now_ns: int) -> None:
        """As far as the command leads without waiting."""
        transition = self.fsa.asked(command)
        while transition != NO_TRANSITION and self._is_earned(transition, now_ns):
            self._take(transition, now_ns)
            transition = self.fsa.asked(command)

    def _is_earned(self, transition: int, now_ns: int) -> bool:
        """Whether the transition may be taken at once; if not, what it waits for is under way."""
        objects = self._objects
        if transition == 4:
            if self._enable_ns == 0 and self._has_supply():
                return True
            if self._enable_due_ns == NEVER:
                self._enable_due_ns = now_ns + self._enable_ns
            return False
        if transition == 2:
            return not self.standing.torque_off
        if transition == 15:
            return self.standing.lets_reset(self._has_supply())
        if transition == 16:
            return objects.options.quick_stops_and_stays()
        ramps = (
            objects.options.disable_ramps() if transition == 5 else objects.options.shutdown_ramps()
        )
        if transition not in (5, 8) or not ramps:
            return True
        if self._at_rest not in (5, 8):
            self._active.leave()
            self._axis.ramp_to_rest(objects.motion.deceleration_inc_s2())
        self._at_rest = transition
        return False

    def _take(self, transition: int, now_ns: int) -> None:
        """The transition and what the standard has the drive do in it."""
        self.fsa.take(transition)
        self._at_rest = NO_TRANSITION
        self._enable_due_ns = NEVER
        if transition == 4:
            self._axis.power(True)
            self._active.enter(self.fsa.controlword, now_ns)
        elif transition in (5, 8, 9, 12, 14):
            self._active.leave()
            self._axis.power(False)
        elif transition == 11:
            self._active.leave()
            self._quick_stop(now_ns)
        elif transition == 15:
            self.standing.noted.clear()
            self.error_code = NO_FAULT
            self.told.append(NO_FAULT)
        elif transition == 16:
            self._active.enter(self.fsa.controlword, now_ns)

    def _react(self, code: int, now_ns: int) -> None:
        running = self.fsa.state in _RUNNING_STATES
        self.error_code = self.standing.note(code)
        self._active.leave()
        self._take(13, now_ns)
        can_brake = running and self.voltage and not is_at_once(code)
        if can_brake and self._objects.options.react(self._axis):
            self._at_rest = 14
        else:
            self._take(14, now_ns)

    def _has_supply(self) -> bool:
        return self.voltage and not self._axis.flags & f.UNDER_VOLTAGE

    def _quick_stop(self, now_ns: int) -> None:
        """605Ah."""
        options = self._objects.options
        if not options.quick_stop(self._axis):
            self._take(12, now_ns)
        elif not options.quick_stops_and_stays():
            self._at_rest = 12

    def _select(self, mode: int) -> None:
        self.mode = mode
        self._active = self.modes.get(mode, self._no_mode)
        self._guard.select(mode)

    def _switch_mode(self, now_ns: int) -> None:
        self._active.leave()
        self._select(self._objects.mode)
        if self.fsa.state is PdsState.OPERATION_ENABLED and self._at_rest == NO_TRANSITION:
            if self._active is self._no_mode:
                self._axis.ramp_to_rest(self._objects.motion.deceleration_inc_s2())
            self._active.enter(self.fsa.controlword, now_ns)
