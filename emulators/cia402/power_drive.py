"""The power drive: state machine, power stage, option codes, faults and modes.

`pds_fsa` returns the transition that a controlword requests. This module decides when it can be
taken. Transition 4 waits for the power stage. 5 and 8 wait for standstill if 605Ch and 605Bh
require it. 12 waits for the end of the quick stop, 14 for the end of the fault reaction.
"""

from typing import Final, final

from motorhil.emulators.canopen.outbox import NEVER
from motorhil.emulators.cia402.faults import FOLLOWING_ERROR, UNDER_VOLTAGE, Standing, is_at_once
from motorhil.emulators.cia402.limit_switches import LimitGuard
from motorhil.emulators.cia402.modes.base import Mode
from motorhil.emulators.cia402.modes.cyclic import CyclicPosition, CyclicTorque, CyclicVelocity
from motorhil.emulators.cia402.modes.homing import Homing, HomingState
from motorhil.emulators.cia402.modes.interpolated_position import InterpolatedPosition
from motorhil.emulators.cia402.modes.profile_position import ProfilePosition
from motorhil.emulators.cia402.modes.profile_velocity_torque import ProfileTorque, ProfileVelocity
from motorhil.emulators.cia402.objects.changes import ObjectChange
from motorhil.emulators.cia402.objects.dictionary import DriveObjects
from motorhil.emulators.cia402.objects.servo import ServoObjects
from motorhil.emulators.cia402.settings import EMULATED_MODES
from motorhil.emulators.cia402.state_machine import (
    MODE_BITS,
    NO_TRANSITION,
    TARGET_REACHED,
    Command,
    PdsFsa,
    PdsState,
    compose,
    decode_controlword,
)
from motorhil.emulators.cia402.touch_probe import TouchProbe
from motorhil.emulators.firmware import flags as f
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import DigitalInputs, Edge

NO_FAULT: Final = 0x0000

_CONTROLWORD: Final = int(ObjectChange.CONTROLWORD)
_FACTORS: Final = int(ObjectChange.FACTORS)
_GAINS: Final = int(ObjectChange.GAINS | ObjectChange.TORQUE_LIMIT)
_MODE: Final = int(ObjectChange.MODE)
_TOUCH_PROBE: Final = int(ObjectChange.TOUCH_PROBE)
_WINDOWS: Final = int(ObjectChange.WINDOWS | ObjectChange.FACTORS)

# Values of 6007h (abort connection option code)
ABORT_FAULT: Final = 1
ABORT_DISABLE_VOLTAGE: Final = 2
ABORT_QUICK_STOP: Final = 3
_RUNNING_STATES: Final = (PdsState.OPERATION_ENABLED, PdsState.QUICK_STOP_ACTIVE)
_POWERED_STATES: Final = (PdsState.SWITCHED_ON, *_RUNNING_STATES)


@final
class PowerDrive:
    """One power drive system. Call its methods after `axis.at(now_ns)`.

    Attributes:
        error_code: 603Fh.
        told: error codes since the caller cleared the list, in order; 0 stands for a fault reset.
        voltage: True if the power stage has its supply.
        mode: 6061h.
        modes: the modes by 6061h; a quirk can replace one before power comes on.
        is_watched: True if the plant can cause faults even while the drive is off.
        standing: causes that block a fault reset or transition 2, and warnings.
        inputs: 60FDh.
        touch_probe: 60B8h and its results.
    """

    def __init__(
        self,
        axis: Axis,
        objects: DriveObjects,
        inputs: DigitalInputs,
        tick_ns: int,
        enable_ns: int,
    ) -> None:
        self.fsa: PdsFsa = PdsFsa(PdsState.NOT_READY_TO_SWITCH_ON)
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
            objects.od, axis, inputs, objects.factors, objects.changes
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
        self.quirk_bits: int = 0  # of 6041h: always set; in fault alone
        self.fault_bits: int = 0
        self._active: Mode = self._no_mode

    # --- interface of the drive

    def power_on(self) -> None:
        """Take transition 0: the firmware starts; the motor has no current."""
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
        """Take transition 1: the firmware has started."""
        if self.fsa.state is PdsState.NOT_READY_TO_SWITCH_ON:
            self._take(1, now_ns)
            for code in self.standing.causes:
                self.fault(code, now_ns)
            self._obey_level(now_ns)

    def written(self, what: int, now_ns: int) -> None:
        """Apply written objects: first units and settings, then the mode and the controlword."""
        if what & _FACTORS:
            self._objects.reload_units()
        if what & _WINDOWS:
            self._servo.apply_windows()
        if what & _GAINS:
            self._servo.apply_limits_and_gains()
        if what & _TOUCH_PROBE:
            self.touch_probe.configure()
        self._guard.written(what)
        if what & _MODE and self._objects.mode != self.mode:
            self._switch_mode(now_ns)
        if self._mode_works():
            self._active.written(what, now_ns)
        if what & _CONTROLWORD:
            self._write_controlword(self._objects.controlword, now_ns)

    def settle(self, now_ns: int) -> None:
        """Handle everything that is due, or that the axis' flags show."""
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
        elif self._mode_works():
            active = self._active
            active.settle(now_ns)
            if active.lost:
                self.fault(self._objects.settings.sync_lost_code, now_ns)

    def synced(self, now_ns: int) -> bool:
        """Pass SYNC to the mode; return True if the mode has new work or a new deadline."""
        active, state = self._active, self.fsa.state
        return active.heeds_sync and state is PdsState.OPERATION_ENABLED and active.synced(now_ns)

    def saw(self, edges: list[Edge]) -> None:
        """Handle edges of digital inputs."""
        self.touch_probe.sees(edges)
        if self._mode_works():
            self._active.sees(edges)
        self._guard.sees(edges)

    def flags_matter(self) -> bool:
        """Return True if a change of the axis' flags can matter in the present state."""
        state = self.fsa.state
        is_on = state in _RUNNING_STATES or state is PdsState.FAULT_REACTION_ACTIVE
        return is_on or self.is_watched or self.inputs.is_gated

    def _mode_works(self) -> bool:
        """Return True if the mode moves the motor, which is not being stopped or disabled."""
        return self.fsa.state is PdsState.OPERATION_ENABLED and self._at_rest == NO_TRANSITION

    def deadline_ns(self) -> int:
        """Return when `settle` must be called at the latest [ns], or NEVER; ignores flags.

        The mode is woken only where `settle` asks it.
        """
        wake_ns = self._active.wake_ns() if self._mode_works() else NEVER
        return wake_ns if wake_ns < self._enable_due_ns else self._enable_due_ns

    def fault(self, code: int, now_ns: int) -> None:
        """Take transition 13 with this error code (603Fh), with the reaction of the fault table."""
        self.told.append(code)
        self.error_code = self.standing.note(code)  # the last, not always the reaction's cause
        state = self.fsa.state
        if state is PdsState.FAULT_REACTION_ACTIVE:
            if is_at_once(code):
                self._take(14, now_ns)
        elif state is not PdsState.FAULT:
            self._react(code, now_ns)

    def is_homed(self) -> bool:
        """Return whether home was attained."""
        return self._homing.state is HomingState.ATTAINED

    def lose_reference(self) -> None:
        """Discard the home position."""
        self._homing.forget()

    def take_torque_off(self, code: int, now_ns: int) -> None:
        """Switch torque off (STO): a fault with this code if power was on; 0: only disable."""
        state = self.fsa.state
        if state is PdsState.FAULT_REACTION_ACTIVE:
            self._take(14, now_ns)
        elif code and state in _POWERED_STATES:
            self.fault(code, now_ns)
        else:
            self._advance(Command.DISABLE_VOLTAGE, now_ns)

    def set_voltage(self, present: bool, now_ns: int) -> None:
        """Connect or disconnect the power stage's supply; without it the motor cannot be braked."""
        self.voltage = present
        state = self.fsa.state
        if present:
            return
        if state is PdsState.FAULT_REACTION_ACTIVE:
            self._take(14, now_ns)
        elif state in _RUNNING_STATES:
            self.fault(UNDER_VOLTAGE, now_ns)

    def abort_connection(self, code: int, now_ns: int) -> None:
        """Apply 6007h after a lost connection, if the power stage is on.

        A resulting fault is not reported here: the code that noticed it has reported it, or cannot.
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

    # --- outputs

    def statusword(self) -> int:
        """Return 6041h according to the axis' flags."""
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
        word = compose(state, mode_bits, self.voltage, remote, limit, self.standing.warnings != 0)
        return word | self._quirk_bits(state) if self.quirk_bits or self.fault_bits else word

    # --- internals

    def _quirk_bits(self, state: PdsState) -> int:
        """Return the bits of 6041h by quirks; a mode's own bits stay its own while it works."""
        if state is PdsState.OPERATION_ENABLED or state is PdsState.QUICK_STOP_ACTIVE:
            return self.quirk_bits & ~MODE_BITS
        is_fault = state is PdsState.FAULT or state is PdsState.FAULT_REACTION_ACTIVE
        return self.quirk_bits | self.fault_bits if is_fault else self.quirk_bits

    def _write_controlword(self, word: int, now_ns: int) -> None:
        fsa = self.fsa
        previous = fsa.controlword
        if self._at_rest == NO_TRANSITION and fsa.holds(word):  # as in each cycle of a cyclic host
            self._active.obey(word, 0, now_ns)
            return
        command = fsa.command(word)
        if command is Command.ENABLE_OPERATION:
            if self._at_rest in (5, 8):  # enabled again before standstill: nothing was disabled
                self._at_rest = NO_TRANSITION
                self._active.enter(word, now_ns)
        elif command is not None:
            self._enable_due_ns = NEVER
        self._advance(command, now_ns)
        if self._mode_works():
            self._active.obey(word, word & ~previous, now_ns)

    def _obey_level(self, now_ns: int) -> None:
        """Obey the present controlword again after an automatic transition."""
        word = self.fsa.controlword
        self._advance(decode_controlword(word, word), now_ns)

    def _advance(self, command: Command | None, now_ns: int) -> None:
        """Take all transitions of the command that need no waiting."""
        transition = self.fsa.asked(command)
        while transition != NO_TRANSITION and self._is_earned(transition, now_ns):
            self._take(transition, now_ns)
            transition = self.fsa.asked(command)

    def _is_earned(self, transition: int, now_ns: int) -> bool:
        """Return True if the transition can be taken now; otherwise start what it waits for."""
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
        """Take the transition, with the actions that the standard assigns to it."""
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
        """Start the reaction of 605Ah."""
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
        if self._mode_works():
            if self._active is self._no_mode:
                self._axis.ramp_to_rest(self._objects.motion.deceleration_inc_s2())
            self._active.enter(self.fsa.controlword, now_ns)
