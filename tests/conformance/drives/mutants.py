"""Drives with one mistake each, and the clause that must find it.

A mistake breaks a class of the emulator for one test (pytest's monkeypatch), or is a quirk or an
object of the rig. Its docstring describes it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from motorhil.emulators.can.frame import pack
from motorhil.emulators.canopen import (
    error_control,
    lss,
    object_dictionary,
    pdo,
    pdo_mapping,
    sdo_server,
    sync,
)
from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.emcy import CanWatch, EmcyProducer
from motorhil.emulators.canopen.error_control import HeartbeatConsumer, HeartbeatProducer
from motorhil.emulators.canopen.files import parameter_storage
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.pdo import Rpdo
from motorhil.emulators.canopen.pdo_parameters import PdoParameters
from motorhil.emulators.cia402 import drive, limit_switches, power_drive, state_machine, touch_probe
from motorhil.emulators.cia402.drive import Readings
from motorhil.emulators.cia402.faults import Standing
from motorhil.emulators.cia402.modes import cyclic, homing
from motorhil.emulators.cia402.modes.interpolated_position import InterpolatedPosition
from motorhil.emulators.cia402.modes.profile_position import ProfilePosition
from motorhil.emulators.cia402.modes.profile_velocity_torque import ProfileTorque, ProfileVelocity
from motorhil.emulators.cia402.objects import mode_objects, units
from motorhil.emulators.cia402.objects.dictionary import GainWatch
from motorhil.emulators.cia402.objects.mode_objects import HomingObjects, IpObjects
from motorhil.emulators.cia402.objects.motion import MotionObjects, OptionCodes, WindowObjects
from motorhil.emulators.cia402.objects.servo import ServoObjects
from motorhil.emulators.cia402.objects.torque import OffsetObjects, TorqueObjects
from motorhil.emulators.cia402.power_drive import PowerDrive
from motorhil.emulators.cia402.state_machine import Command, PdsState
from motorhil.emulators.firmware import (
    axis,
    clock,
    flags,
    nonlinear_servo,
    nonlinear_tables,
    profile,
    servo,
    servo_tables,
)
from motorhil.emulators.firmware.axis import Axis
from motorhil.emulators.firmware.digital_inputs import TOUCH_PROBE_2, DigitalInputs
from motorhil.emulators.plant.dc_motor import sample
from tests.conformance.drives.rigs import DRIVES

_S, _C = PdsState, Command
SWITCHES = DRIVES["switches"]


@dataclass(frozen=True)
class Mutant:
    """A mistake: its name, the clause that kills it, what to patch, and the rig's own keys."""

    name: str
    killer: str
    plant: Callable
    keys: str = ""


MUTANTS: dict[str, Mutant] = {}


def mutant(killer, keys=""):
    def register(plant):
        def plant_alone(patch):
            patch.setattr(axis, "extras_tables", nonlinear_tables.extras_tables.__wrapped__)
            plant(patch)  # no table is shared with an axis before or after it

        assert plant.__doc__
        assert plant.__name__ not in MUTANTS
        MUTANTS[plant.__name__] = Mutant(plant.__name__, killer, plant_alone, keys)
        return plant

    return register


def _wrap(patch, owner, name, make):
    patch.setattr(owner, name, make(getattr(owner, name)))


def _always(patch, owner, name, value):
    patch.setattr(owner, name, lambda *_, **__: value)


def _aborts_as(patch, codes, instead):
    def make(good):
        return lambda self, code, now: good(self, instead if code in codes else code, now)

    _wrap(patch, sdo_server.SdoServer, "_abort", make)


# --- dictionary


@mutant("OD-01", 'objects = { "1000h" = 0x20191 }')
def device_type_of_an_io_node(patch):
    """1000h says profile 401."""


@mutant("OD-02")
def unknown_object_is_a_general_error(patch):
    """An object that does not exist is refused with 0800 0000h."""
    _aborts_as(patch, (AbortCode.NO_SUCH_OBJECT,), AbortCode.GENERAL_ERROR)


@mutant("OD-02")
def unknown_subindex_is_an_unknown_object(patch):
    """A sub-index that does not exist is refused with 0602 0000h."""
    _aborts_as(patch, (AbortCode.NO_SUCH_SUBINDEX,), AbortCode.NO_SUCH_OBJECT)


@mutant("OD-03")
def read_only_is_a_wrong_value(patch):
    """A download to a read-only object is refused with 0609 0030h."""
    _aborts_as(patch, (AbortCode.READ_ONLY,), AbortCode.INVALID_VALUE)


@mutant("OD-04")
def wrong_length_is_a_wrong_value(patch):
    """A download with a wrong length is refused with 0609 0030h."""
    lengths = (AbortCode.LENGTH_MISMATCH, AbortCode.LENGTH_TOO_HIGH, AbortCode.LENGTH_TOO_LOW)
    _aborts_as(patch, lengths, AbortCode.INVALID_VALUE)


@mutant("OD-05")
def csp_is_claimed_falsely(patch):
    """6502h claims csp, but 6061h never shows it."""
    _wrap(patch, PowerDrive, "_select", lambda good: lambda s, mode: mode == 8 or good(s, mode))


@mutant("OD-07", 'quirks = ["halt_holds_mode"]')
def halt_holds_the_mode(patch):
    """6060h is ignored while bit 8 of 6040h is 1."""


@mutant("OD-06")
def store_needs_no_signature(patch):
    """1010h stores with any signature."""
    _wrap(
        patch,
        parameter_storage._Command,
        "write",
        lambda good: lambda self, value: good(self, self._signature),
    )


@mutant("OD-06")
def store_does_nothing(patch):
    """1010h accepts "save", and stores nothing."""
    _always(patch, parameter_storage.ParameterStore, "save", 0)


# --- network


@mutant("NMT-01")
def boot_up_is_not_sent(patch):
    """There is no boot-up message."""
    _always(patch, HeartbeatProducer, "boot_up", None)


@mutant("NMT-02")
def heartbeat_always_says_operational(patch):
    """The heartbeat does not show the NMT state."""
    _wrap(patch, HeartbeatProducer, "_send", lambda good: lambda s, state: good(s, state and 5))


@mutant("NMT-03")
def heartbeat_is_twice_as_slow(patch):
    """The period of the heartbeat is twice 1017h."""

    def make(good):
        def configure(self, now_ns):
            good(self, now_ns)
            self._period_ns *= 2

        return configure

    _wrap(patch, HeartbeatProducer, "configure", make)


@mutant("NMT-04")
def host_is_never_lost(patch):
    """1016h has no effect."""
    _always(patch, HeartbeatConsumer, "receive", False)


@mutant("NMT-04")
def abort_connection_is_ignored(patch):
    """6007h has no effect."""
    _always(patch, PowerDrive, "abort_connection", None)


@mutant("NMT-04")
def connection_is_watched_in_operation_alone(patch):
    """6007h has no effect before operation is enabled."""

    def make(good):
        def abort(self, code, now_ns):
            if self.fsa.state is not _S.SWITCHED_ON:
                good(self, code, now_ns)

        return abort

    _wrap(patch, PowerDrive, "abort_connection", make)


# --- power


@mutant("PDS-01")
def shutdown_is_ignored_when_switched_on(patch):
    """Transition 6 is missing."""
    patch.delitem(state_machine.TRANSITIONS, (_S.SWITCHED_ON, _C.SHUTDOWN))


@mutant("PDS-02")
def switch_on_disabled_takes_enable(patch):
    """Enable operation leaves switch on disabled."""
    patch.setitem(state_machine.TRANSITIONS, (_S.SWITCH_ON_DISABLED, _C.ENABLE_OPERATION), 2)


@mutant("PDS-03")
def remote_is_never_set(patch):
    """Bit 9 of 6041h is always 0."""
    _wrap(patch, power_drive, "compose", lambda good: lambda *args: good(*args) & ~0x0200)


@mutant("PDS-04")
def fault_reset_is_a_level(patch):
    """The level of bit 7 resets a fault."""

    def make(good):
        return lambda word, before: _C.FAULT_RESET if word & 0x80 else good(word, before)

    _wrap(patch, state_machine, "decode_controlword", make)


# --- profile position


def _taken_with(patch, change):
    _wrap(
        patch,
        ProfilePosition,
        "_take",
        lambda good: lambda s, word, now: good(s, change(word), now),
    )


@mutant("PP-01")
def relative_is_absolute(patch):
    """Bit 6 of 6040h is ignored."""
    _taken_with(patch, lambda word: word & ~0x40)


@mutant("PP-01", 'quirks = ["single_set_point_only"]')
def set_points_need_bit_5(patch):
    """A set-point without bit 5 is not executed."""


@mutant("PP-02")
def acknowledge_is_never_cleared(patch):
    """Bit 12 stays 1 after the first set-point."""

    def make(good):
        def obey(self, word, rising, now_ns):
            was = self._acknowledged
            good(self, word, rising, now_ns)
            self._acknowledged = was or self._acknowledged

        return obey

    _wrap(patch, ProfilePosition, "obey", make)


@mutant("PP-02", 'quirks = ["inverted_set_point_acknowledge"]')
def acknowledge_is_inverted(patch):
    """Bit 12 is 0 while a set-point is acknowledged."""


@mutant("PP-03")
def buffered_set_point_is_executed_at_once(patch):
    """Bit 5 of 6040h is taken as 1."""
    _taken_with(patch, lambda word: word | 0x20)


@mutant("PP-03")
def buffered_set_point_is_lost(patch):
    """A waiting set-point is acknowledged and dropped."""

    def make(good):
        def settle(self, now_ns):
            self._waiting = None
            good(self, now_ns)

        return settle

    _wrap(patch, ProfilePosition, "settle", make)


@mutant("PP-04")
def change_immediately_is_ignored(patch):
    """Bit 5 of 6040h is taken as 0."""
    _taken_with(patch, lambda word: word & ~0x20)


def _windows_with(patch, place, value):
    def make(good):
        def read(self):
            windows = list(good(self))
            windows[place] = value
            return tuple(windows)

        return read

    _wrap(patch, WindowObjects, "read", make)


@mutant("PP-05")
def position_window_time_is_ignored(patch):
    """6068h has no effect."""
    _windows_with(patch, 1, 0)


@mutant("PP-05", "quirks = { stale_target_reached = { for_s = 0.05 } }")
def target_reached_is_stale(patch):
    """Bit 10 of the last move stays 1 for 50 ms."""


@mutant("PP-06")
def halt_drops_the_move(patch):
    """The move is not continued without halt."""

    def make(good):
        def obey(self, word, rising, now_ns):
            if word & 0x100:
                self._running = None
            good(self, word, rising, now_ns)

        return obey

    _wrap(patch, ProfilePosition, "obey", make)


# --- profile velocity


@mutant("PV-01")
def velocity_has_the_wrong_sign(patch):
    """606Ch is negative at positive velocities."""
    _wrap(patch, units.Units, "velocity_raw", lambda good: lambda s, value: -good(s, value))


@mutant("PV-02")
def velocity_unit_is_undeclared(patch):
    """The velocity unit is not what the dictionary declares."""

    def make(good):
        def units_of(*args, **kwargs):
            found = good(*args, **kwargs)
            return replace(found, velocity_unit_inc_s=2.0 * found.velocity_unit_inc_s)

        return units_of

    _wrap(patch, units, "units_of", make)


@mutant("PV-03")
def slowing_down_at_the_acceleration(patch):
    """6083h is used for slowing down as well."""
    patch.setattr(MotionObjects, "deceleration_inc_s2", MotionObjects.acceleration_inc_s2)


@mutant("PV-04")
def velocity_window_time_is_ignored(patch):
    """606Eh has no effect."""
    _windows_with(patch, 5, 0)


@mutant("PV-05")
def threshold_time_delays_the_rest_only(patch):
    """Bit 12 is 0 as soon as the threshold is exceeded."""

    def make(good):
        return lambda s: good(s) & ~0x1000 if not s.axis.flags & flags.SPEED_ZERO else good(s)

    _wrap(patch, ProfileVelocity, "status_bits", make)


@mutant("PV-06")
def halt_always_slows_down(patch):
    """605Dh = 2 has the effect of 1."""
    _always(patch, MotionObjects, "quick_stop_deceleration_inc_s2", 200_000.0)


@mutant("PV-07")
def velocity_limit_is_ignored(patch):
    """607Fh has no effect."""
    _wrap(
        patch,
        MotionObjects,
        "velocity_max_inc_s",
        lambda good: lambda self: self._velocity_physical_inc_s,
    )


@mutant("PV-07")
def velocity_limit_is_not_told(patch):
    """Bit 11 stays 0 at 607Fh."""
    _always(patch, MotionObjects, "is_velocity_cut", False)


@mutant("POL-01")
def velocity_polarity_is_ignored(patch):
    """607Eh bit 6 has no effect."""
    patch.setattr(units, "VELOCITY_POLARITY", 0)


# --- supervision


@mutant("FOL-01")
def following_error_is_ignored(patch):
    """6065h has no effect."""
    _windows_with(patch, 2, 1 << 62)


@mutant("FOL-01")
def following_error_time_is_ignored(patch):
    """6066h has no effect."""
    _windows_with(patch, 3, 0)


@mutant("LIM-01")
def software_limits_are_ignored(patch):
    """607Dh has no effect."""
    _always(patch, MotionObjects, "has_position_limits", False)


@mutant("LIM-01")
def software_limits_are_not_told(patch):
    """Bit 11 stays 0 when a target is clamped to 607Dh."""

    def make(good):
        def take(self, word, now_ns):
            good(self, word, now_ns)
            self.limited = False

        return take

    _wrap(patch, ProfilePosition, "_take", make)


# --- stopping


@mutant("STOP-01")
def quick_stop_uses_6084h(patch):
    """A quick stop with 605Ah = 2 slows down at 6084h."""
    patch.setattr(
        MotionObjects, "quick_stop_deceleration_inc_s2", MotionObjects.deceleration_inc_s2
    )


class _Code:
    """An option code with another value."""

    def __init__(self, value):
        self._value = value

    def integer(self):
        return self._value


def _quick_stop_as(patch, instead):
    """Take quick stop option codes as others."""

    def make(good):
        def quick_stop(self, axis):
            own = self._quick_stop
            self._quick_stop = _Code(instead.get(own.integer(), own.integer()))
            try:
                return good(self, axis)
            finally:
                self._quick_stop = own

        return quick_stop

    _wrap(patch, OptionCodes, "quick_stop", make)


@mutant("STOP-02")
def option_1_is_taken_as_2(patch):
    """A quick stop with 605Ah = 1 brakes at 6085h."""
    _quick_stop_as(patch, {1: 2})


@mutant("STOP-03")
def quick_stop_never_stays(patch):
    """The drive leaves quick stop active with 605Ah = 5 and 6 as well."""
    _always(patch, OptionCodes, "quick_stops_and_stays", False)


@mutant("STOP-04")
def option_0_brakes(patch):
    """A quick stop with 605Ah = 0 brakes at 6085h before."""
    _quick_stop_as(patch, {0: 2})


@mutant("STOP-05")
def option_3_is_a_ramp(patch):
    """A quick stop with 605Ah = 3 brakes at 6085h."""
    _quick_stop_as(patch, {3: 2})


@mutant("STOP-05")
def servo_stays_weak_after_a_hard_stop(patch):
    """The gains of a quick stop with 605Ah = 4 or 8 stay for good."""

    def make(good):
        def end(self):
            self._is_shorted = False
            good(self)

        return end

    _wrap(patch, Axis, "_end_braking", make)


@mutant("STOP-11")
def it_stops_before_it_goes_on(patch):
    """Enabled again while it slows down by 605Ch, the motor comes to rest first."""

    def make(good):
        def write(self, word, now_ns):
            if self._at_rest == 5:
                self.fsa.controlword = word
            else:
                good(self, word, now_ns)

        return write

    _wrap(patch, PowerDrive, "_write_controlword", make)


@mutant("STOP-06")
def shutdown_never_ramps(patch):
    """605Bh = 1 has the effect of 0."""
    _always(patch, OptionCodes, "shutdown_ramps", False)


@mutant("STOP-07")
def disable_operation_never_ramps(patch):
    """605Ch = 1 has the effect of 0."""
    _always(patch, OptionCodes, "disable_ramps", False)


@mutant("STOP-08")
def fault_reaction_coasts(patch):
    """605Eh has no effect: a fault disables at once."""
    _always(patch, OptionCodes, "react", False)


# --- homing


@mutant("HOME-01")
def home_offset_is_ignored(patch):
    """607Ch has no effect."""
    _always(patch, HomingObjects, "home_inc", 0)


@mutant("HOME-01")
def home_offset_has_the_other_sign(patch):
    """The position of home is +607Ch."""
    _wrap(patch, HomingObjects, "home_inc", lambda good: lambda self: -good(self))


@mutant("HOME-02")
def reserved_method_homes(patch):
    """Method 15 is taken as 37."""
    patch.setitem(mode_objects.HOMING_METHODS, 15, mode_objects.HOMING_METHODS[37])


# --- errors


@mutant("ERR-01")
def emergency_is_not_sent(patch):
    """A fault sends no EMCY."""
    _always(patch, CanopenNode, "emergency", None)


@mutant("ERR-01", 'quirks = ["misplaced_error_register"]')
def error_register_is_misplaced(patch):
    """The error register is the fourth byte of an EMCY."""


@mutant("ERR-02")
def history_is_empty(patch):
    """1003h keeps no errors."""
    _always(patch, EmcyProducer, "_remember", None)


# --- process data


def _types(patch, change, receive):
    def make(good):
        def transmission_type(self):
            kind = good(self)
            return change(kind) if self._receive is receive else kind

        return transmission_type

    _wrap(patch, PdoParameters, "transmission_type", make)


@mutant("PDO-01")
def synchronous_rpdo_acts_at_once(patch):
    """An RPDO of type 1 does not wait for SYNC."""
    _types(patch, lambda kind: 255, True)


@mutant("PDO-02")
def event_driven_rpdo_waits_for_sync(patch):
    """An RPDO of type 255 waits for SYNC."""
    _types(patch, lambda kind: 1, True)


@mutant("PDO-03")
def short_rpdo_is_dropped_silently(patch):
    """An RPDO that is too short sends no EMCY."""

    def make(good):
        def receive(self, frame, now_ns):
            if frame[4] >= self.mapping.length_bytes:
                good(self, frame, now_ns)

        return receive

    _wrap(patch, Rpdo, "receive", make)


@mutant("PDO-04")
def synchronous_tpdo_is_sent_at_once(patch):
    """A TPDO of type 1 is sent at its event."""
    _types(patch, lambda kind: 255, False)


@mutant("PDO-04")
def every_sync_sends_the_tpdo(patch):
    """A TPDO of type 3 is sent after every SYNC."""
    _types(patch, lambda kind: 1 if 1 < kind <= 240 else kind, False)


@mutant("PDO-05")
def type_0_is_taken_as_1(patch):
    """A TPDO of type 0 is sent after every SYNC."""
    _types(patch, lambda kind: kind or 1, False)


@mutant("PDO-06")
def inhibit_time_is_ignored(patch):
    """1800h:3 has no effect."""
    _always(patch, PdoParameters, "inhibit_100us", 0)


@mutant("PDO-07")
def event_timer_is_ignored(patch):
    """1800h:5 has no effect."""
    _always(patch, PdoParameters, "event_timer_ms", 0)


@mutant("CSP-01")
def csp_does_not_tell_that_it_follows(patch):
    """Bit 12 of 6041h stays 0 in csp."""
    patch.setattr(cyclic, "FOLLOWS_COMMAND", 0)


@mutant("CSV-01")
def csv_target_acts_at_once(patch):
    """In csv, 60FFh by a synchronous RPDO does not wait for SYNC."""
    _types(patch, lambda kind: 255, True)


# --- inputs


@mutant("DIN-01")
def home_switch_is_bit_3(patch):
    """60FDh shows the home switch in bit 3."""
    _wrap(
        patch, DigitalInputs, "_bits_now", lambda good: lambda s: good(s) & ~4 | (good(s) & 4) << 1
    )


@mutant("DIN-02", DRIVES["much backlash"])
def home_switch_is_at_the_motor(patch):
    """The home switch follows the encoder of the motor, not the output."""
    patch.setattr(Axis, "output_count", Axis.count)


@mutant("LSW-01")
def limit_switch_is_ignored(patch):
    """A limit switch has no effect on the motion."""
    _always(patch, Axis, "bar", None)


@mutant("LSW-02")
def software_limits_hold_in_pp_alone(patch):
    """607Dh has no effect in pv."""
    patch.setattr(limit_switches, "_FENCED_MODES", ())


@mutant("LSW-02")
def software_limits_hold_from_the_next_mode_on(patch):
    """607Dh has no effect when it is written in pv."""
    _always(patch, limit_switches.LimitGuard, "written", None)


@mutant("LIM-02")
def a_left_mode_stays_limited(patch):
    """Bit 11 is 1 in pp until the first set-point."""

    def make(good):
        def leave(self):
            good(self)
            self.limited = True

        return leave

    _wrap(patch, ProfilePosition, "leave", make)


@mutant("HOME-10")
def hm_lets_the_motor_turn(patch):
    """hm leaves a motor in motion as it is."""
    _always(patch, homing.Homing, "enter", None)


@mutant("HOME-11")
def homing_fails_in_the_tick_of_its_mode(patch):
    """Homing fails if it is started in the tick in which hm is selected."""

    def make(good):
        return lambda self: good(self) or bool(self.axis.flags & flags.PROFILE_ACTIVE)

    _wrap(patch, homing.Homing, "_moves", make)


@mutant("PP-12")
def pp_lets_the_motor_turn(patch):
    """pp leaves a motor in motion as it is, until its first set-point."""
    patch.setattr(ProfilePosition, "enter", lambda self, word, now_ns: self.leave())


@mutant("PP-11")
def a_slow_move_has_no_end(patch):
    """The last ramp of a move is left out if it is slow."""

    def make(good):
        def move(*values):
            pieces = good(*values)
            return (
                pieces[:-2] + pieces[-1:] if max(abs(one[3]) for one in pieces) <= 1.0 else pieces
            )

        return move

    patch.setattr(profile, "move", make(profile.move))


@mutant("TP-01")
def falling_edges_are_rising_ones(patch):
    """Touch probes latch falling edges at rising ones."""
    _wrap(
        patch,
        touch_probe.Latch,
        "__init__",
        lambda good: lambda s, enabling, shown, rising: good(s, enabling, shown, True),
    )


@mutant("TP-02")
def index_pulse_is_half_a_turn_apart(patch):
    """The index pulse comes twice a turn."""

    def make(good):
        return lambda s, axis, switches, index, turn: good(s, axis, switches, index, turn * 3 // 4)

    _wrap(patch, DigitalInputs, "__init__", make)


@mutant("TP-03")
def probe_sources_are_swapped(patch):
    """60D0h = 1 is the input of touch probe 2."""
    patch.setitem(touch_probe._SOURCES, 1, TOUCH_PROBE_2)


@mutant("TP-04", SWITCHES)
def probe_latches_a_tick_late(patch):
    """A touch probe latches the position of the tick after the edge."""

    def make(good):
        def look(self):
            edges = good(self)
            for edge in edges:
                edge.count = self._axis.count()
            return edges

        return look

    _wrap(patch, DigitalInputs, "look", make)


# --- homing by switches


def _method(patch, number, **changes):
    row = mode_objects.HOMING_METHODS[number]
    names = ("switch", "direction", "before", "search", "turns", "index")
    values = {name: getattr(row, name) for name in names} | changes
    patch.setitem(mode_objects.HOMING_METHODS, number, mode_objects.HomingMethod(**values))


@mutant("HOME-03", SWITCHES)
def method_2_needs_no_index(patch):
    """Method 2 ends at the edge of the limit switch."""
    _method(patch, 2, index=False)


@mutant("HOME-04", SWITCHES)
def method_25_is_26(patch):
    """Method 25 takes the left edge."""
    _method(patch, 25, direction=1)


@mutant("HOME-05", SWITCHES)
def method_8_needs_no_index(patch):
    """Method 8 ends at the edge of the switch."""
    _method(patch, 8, index=False)


@mutant("HOME-06")
def method_33_goes_right(patch):
    """Method 33 takes the index pulse in positive direction."""
    _method(patch, 33, direction=1)


@mutant("HOME-07")
def search_is_at_zero_speed(patch):
    """The search runs at 6099h:2."""
    patch.setattr(HomingObjects, "switch_speed_inc_s", HomingObjects.zero_speed_inc_s)


@mutant("HOME-08")
def limit_switch_is_no_homing_error(patch):
    """A homing that meets a limit switch stays in progress."""
    _always(patch, homing.Homing, "_meet_limit", None)


@mutant("HOME-09")
def home_survives_a_reset(patch):
    """Bit 12 stays 1 after a reset of the node."""
    _always(patch, homing.Homing, "forget", None)


# --- torque


@mutant("TQ-01")
def torque_slope_is_ignored(patch):
    """6087h has no effect."""
    _always(patch, TorqueObjects, "slope_a_s", 1e9)


@mutant("TQ-02")
def motor_speed_limit_is_ignored(patch):
    """6080h has no effect in tq."""
    _always(patch, MotionObjects, "torque_speed_max_inc_s", 1e300)


@mutant("TQ-03")
def halt_is_ignored_in_tq(patch):
    """Halt has no effect in tq."""
    _always(patch, ProfileTorque, "obey", None)


@mutant("STOP-12")
def mode_begins_without_its_halt(patch):
    """Torque modes begin at once, even if bit 8 is 1 by then."""
    for mode in (ProfileTorque, cyclic.CyclicTorque):
        _wrap(patch, mode, "enter", lambda good: lambda s, word, now_ns: good(s, 0x0F, now_ns))


@mutant("TQ-04")
def torque_limits_are_swapped(patch):
    """60E0h limits negative torques, and 60E1h positive ones."""
    _wrap(patch, TorqueObjects, "limits_a", lambda good: lambda s: good(s)[::-1])


@mutant("TQ-06")
def torque_limit_of_0_is_none(patch):
    """60E0h = 0 and 60E1h = 0 are taken for no limit."""

    _wrap(
        patch, TorqueObjects, "limits_a", lambda good: lambda s: tuple(x or 99.0 for x in good(s))
    )


@mutant("TQ-05")
def current_has_no_sign(patch):
    """6078h is never negative."""
    _wrap(patch, TorqueObjects, "current_raw", lambda good: lambda s, value: abs(good(s, value)))


@mutant("PV-08")
def slippage_is_ignored(patch):
    """60F8h has no effect."""
    _always(patch, MotionObjects, "slippage_inc_s", 0.0)


@mutant("PV-10")
def windows_are_never_applied(patch):
    """Windows and thresholds that are written have no effect."""
    _always(patch, ServoObjects, "apply_windows", None)


@mutant("PV-09")
def acceleration_limit_is_ignored(patch):
    """60C5h has no effect."""
    _wrap(
        patch,
        MotionObjects,
        "acceleration_inc_s2",
        lambda good: (
            lambda s: s._acceleration.integer() * s._factors.units.acceleration_unit_inc_s2
        ),
    )


# --- factors


@mutant("VAL-01")
def velocity_demand_is_not_shown(patch):
    """606Bh is 0."""
    _always(patch, Readings, "velocity_demand", 0)


@mutant("CSP-02")
def following_error_has_the_other_sign(patch):
    """60F4h is 6064h - 6062h."""
    _wrap(patch, units.Units, "length_raw", lambda good: lambda s, value: -good(s, value))


@mutant("VAL-03")
def internal_position_is_in_turns(patch):
    """6063h is in turns of the motor."""
    _wrap(patch, Readings, "position_internal", lambda good: lambda s: good(s) // 2000)


@mutant("VAL-04", DRIVES["more objects"])
def velocity_sensor_is_in_rpm(patch):
    """6069h is in rpm."""
    _wrap(patch, Readings, "velocity_sensor", lambda good: lambda s: good(s) * 60 // 2000)


@mutant("VAL-02", DRIVES["more objects"])
def dc_link_voltage_is_in_volts(patch):
    """6079h is in V."""
    _wrap(patch, Readings, "supply", lambda good: lambda s: good(s) // 1000)


@mutant("FAC-01")
def velocity_factor_is_ignored(patch):
    """6096h has no effect."""

    def make(good):
        return lambda od, plant, position, dimension, factor: good(
            od, plant, position, dimension, 0x5FFF if factor == 0x6096 else factor
        )

    _wrap(patch, units, "_rate_unit", make)


@mutant("RNG-01")
def directions_are_swapped(patch):
    """60F2h = 40h moves in positive direction."""
    _wrap(patch, MotionObjects, "way_round", lambda good: lambda s: (0, 2, 1, 3)[good(s)])


@mutant("PP-08")
def relative_moves_count_from_the_target(patch):
    """60F2h bits 0 and 1 have no effect."""
    _always(patch, MotionObjects, "relative_to", 0)


@mutant("PP-08")
def relative_moves_count_from_the_demand(patch):
    """60F2h = 2 means the demand, not the position."""
    _wrap(patch, MotionObjects, "relative_to", lambda good: lambda s: min(good(s), 1))


@mutant("PP-09")
def end_velocity_is_ignored(patch):
    """6082h has no effect."""
    _always(patch, MotionObjects, "end_velocity_inc_s", 0.0)


@mutant("PP-10")
def third_set_point_replaces_the_second(patch):
    """A third set-point is taken although one waits."""

    def make(good):
        def take(self, word, now_ns):
            self._waiting = None
            good(self, word, now_ns)

        return take

    _wrap(patch, ProfilePosition, "_take", make)


# --- cyclic modes


@mutant("CSP-02")
def position_offset_is_ignored(patch):
    """60B0h has no effect."""
    _always(patch, OffsetObjects, "position_inc", 0)


@mutant("CSP-03")
def software_limits_are_ignored_in_csp(patch):
    """607Dh has no effect in csp."""
    _wrap(patch, MotionObjects, "within_limits_inc", lambda good: lambda s, position: position)


@mutant("CSP-04")
def halt_is_ignored_in_csp(patch):
    """Halt has no effect in csp."""
    _always(patch, cyclic.CyclicMode, "obey", None)


@mutant("CSP-05")
def velocity_limit_is_ignored_in_csp(patch):
    """607Fh has no effect in csp."""

    def make(good):
        return lambda s, position, over, fed=0.0, has_target=False, speed_max_inc_s=0.0: good(
            s, position, over, fed, has_target
        )

    _wrap(patch, Axis, "follow", make)


@mutant("CSP-08")
def csp_lets_the_motor_turn(patch):
    """csp leaves a motor in motion as it is, until its first target."""
    patch.setattr(cyclic.CyclicPosition, "enter", cyclic.CyclicMode.enter)


@mutant("IP-05", 'objects = { "60C0h" = 1 }')
def interpolation_is_of_a_reserved_kind(patch):
    """60C0h says 1, which is reserved."""


@mutant("CSP-07")
def csp_never_turns_round(patch):
    """With 607Bh, targets of csp are approached in positive direction only."""
    patch.setattr(cyclic, "NEAREST", 2)


@mutant("CSP-06")
def interpolation_period_is_in_ms_always(patch):
    """60C2h:2 has no effect."""
    _wrap(
        patch,
        MotionObjects,
        "interpolation_ns",
        lambda good: lambda s: s._period.integer() * 1_000_000,
    )


@mutant("CSV-02")
def velocity_offset_is_ignored(patch):
    """60B1h has no effect."""
    _always(patch, OffsetObjects, "velocity_inc_s", 0.0)


@mutant("CST-01")
def torque_offset_is_subtracted(patch):
    """60B2h is subtracted from 6071h."""
    _wrap(patch, OffsetObjects, "current_a", lambda good: lambda s: -good(s))


@mutant("CYC-01", DRIVES["sync supervision"])
def lost_sync_is_noticed_late(patch):
    """Lost SYNC is a fault after twice the stated time."""

    def make(good):
        def init(self, *args):
            good(self, *args)
            self._patience *= 2

        return init

    _wrap(patch, cyclic.CyclicMode, "__init__", make)


@mutant("CYC-02")
def motor_runs_on_without_sync(patch):
    """In csp the motor keeps its speed without SYNC."""

    def make(good):
        def follow(self, position_inc, over_ns, *args, **kwargs):
            way = position_inc - self.demand_inc()
            return good(self, position_inc + 200 * way, 201 * over_ns, *args)

        return follow

    _wrap(patch, Axis, "follow", make)


@mutant("IP-01")
def records_are_taken_last_first(patch):
    """The newest record is taken first."""
    _wrap(patch, IpObjects, "take_inc", lambda good: lambda s: s._records.reverse() or good(s))


@mutant("IP-02")
def halt_is_ignored_in_ip(patch):
    """Bit 8 has no effect in ip."""
    _wrap(
        patch,
        InterpolatedPosition,
        "obey",
        lambda good: lambda s, word, rising, now: good(s, word & ~0x100, rising, now),
    )


@mutant("IP-03")
def buffer_is_never_full(patch):
    """60C4h:2 has no effect."""
    _always(patch, IpObjects, "_room", 64)


# --- faults of the hardware


@mutant("ERR-03")
def fault_with_its_cause_is_reset(patch):
    """A fault is reset although its cause is present."""
    _always(patch, Standing, "lets_reset", True)


@mutant("ERR-04")
def warning_is_never_set(patch):
    """Bit 7 of 6041h is always 0."""
    _always(patch, Standing, "warn", None)


@mutant("ERR-05")
def home_survives_a_lost_encoder(patch):
    """Bit 12 stays 1 after the encoder was lost."""
    _always(patch, PowerDrive, "lose_reference", None)


@mutant("ERR-06")
def lost_supply_is_no_fault(patch):
    """A drive without its supply stays enabled."""
    _wrap(patch, PowerDrive, "set_voltage", lambda good: lambda s, present, now: None)


@mutant("ERR-07")
def safe_torque_off_does_not_hold(patch):
    """Transition 2 is taken although safe torque off is on."""
    _wrap(
        patch,
        PowerDrive,
        "_is_earned",
        lambda good: lambda s, transition, now: transition == 2 or good(s, transition, now),
    )


@mutant("ERR-08")
def passive_node_is_silent(patch):
    """A passive node sends no EMCY."""
    _always(patch, CanWatch, "find", None)


@mutant("ERR-09")
def short_circuit_waits_for_the_brake(patch):
    """A short circuit does not end the fault reaction."""
    patch.setattr(power_drive, "is_at_once", lambda code: False)


@mutant("NMT-05")
def stopped_node_moves_on(patch):
    """NMT stop and reset communication have no effect on the motion."""
    _always(patch, PowerDrive, "abort_connection", None)


@mutant("STOP-09")
def halt_option_3_is_a_ramp(patch):
    """605Dh = 3 and 4 have the effect of 1."""

    def make(good):
        def halt(self, *args, **kwargs):
            own, self._halt = self._halt, _Code(1)
            try:
                return good(self, *args, **kwargs)
            finally:
                self._halt = own

        return halt

    _wrap(patch, OptionCodes, "halt", make)


@mutant("STOP-10")
def fault_option_3_is_a_ramp(patch):
    """605Eh = 3 and 4 have the effect of 2."""

    def make(good):
        def react(self, axis):
            own, self._fault_reaction = self._fault_reaction, _Code(2)
            try:
                return good(self, axis)
            finally:
                self._fault_reaction = own

        return react

    _wrap(patch, OptionCodes, "react", make)


@mutant("STOP-11")
def disabling_is_not_taken_back(patch):
    """Enable operation has no effect while the drive slows down to be disabled."""

    def make(good):
        def write(self, word, now_ns):
            if self._at_rest not in (5, 8):
                good(self, word, now_ns)

        return write

    _wrap(patch, PowerDrive, "_write_controlword", make)


# --- transfers and services of the node


@mutant("SDO-01")
def block_crc_begins_with_ones(patch):
    """The CRC of block transfers begins with FFFFh."""

    def make(good):
        return lambda data: good(b"\x84\xcf" + data)  # after these two bytes it is FFFFh

    _wrap(patch, sdo_server, "block_crc", make)


@mutant("SDO-01")
def lost_segment_is_not_repeated(patch):
    """A block upload goes on behind a segment that was not confirmed."""

    def make(good):
        return lambda self, good_ones, size: good(self, self._sent, size)

    _wrap(patch, sdo_server.BlockUpload, "confirm", make)


@mutant("SDO-02")
def gap_in_a_block_is_taken(patch):
    """A block download takes its segments whatever their numbers."""

    def make(good):
        def segment(self, head, data):
            self._good = (head & 0x7F) - 1
            return good(self, head, data)

        return segment

    _wrap(patch, sdo_server.BlockDownload, "segment", make)


@mutant("SDO-03")
def toggle_error_is_a_general_error(patch):
    """A toggle bit that does not alternate is refused with 0800 0000h."""
    _aborts_as(patch, (AbortCode.TOGGLE_BIT_NOT_ALTERNATED,), AbortCode.GENERAL_ERROR)


@mutant("SDO-03")
def wrong_crc_is_taken(patch):
    """The CRC of a block download is not checked."""

    def make(good):
        return lambda self, unused, crc: good(self, unused, sdo_server.block_crc(self.sent(unused)))

    def sent(self, unused):
        return bytes(self._data[: len(self._data) - unused])

    patch.setattr(sdo_server.BlockDownload, "sent", sent, raising=False)
    _wrap(patch, sdo_server.BlockDownload, "end", make)


@mutant("GUARD-01")
def toggle_bit_of_guarding_stands(patch):
    """The answers of node guarding have no toggle bit."""
    patch.setattr(error_control, "_TOGGLE", 0)


@mutant("GUARD-01")
def guarding_is_answered_beside_a_heartbeat(patch):
    """Node guarding is answered although the node has a heartbeat."""

    def make(good):
        def receive(self, state, now_ns):
            if not self._od.integer(0x1017, 0, 0):
                return good(self, state, now_ns)
            self._outbox.frames.append(pack(self._answer_id, bytes((state | self._toggle,))))
            self._toggle ^= 0x80
            return False

        return receive

    _wrap(patch, error_control.NodeGuarding, "receive", make)


@mutant("GUARD-02")
def life_time_is_the_guard_time(patch):
    """The master is lost after the guard time, whatever the life time factor."""

    def make(good):
        def configure(self, now_ns):
            good(self, now_ns)
            self._life_ns = self._od.integer(0x100C, 0, 0) * 1_000_000

        return configure

    _wrap(patch, error_control.NodeGuarding, "configure", make)


@mutant("NMT-06")
def all_hosts_have_the_first_ones_time(patch):
    """All entries of 1016h have the time of the first one."""

    def make(good):
        def configure(self, written=None):
            lost = good(self, written)
            watches = [*self._watches.values()]
            for watch in watches:
                watch.period_ns = watches[0].period_ns
            return lost

        return configure

    _wrap(patch, HeartbeatConsumer, "configure", make)


@mutant("EMCY-01")
def emcy_keeps_its_identifier(patch):
    """EMCY has 80h + node-ID, whatever 1014h says."""

    def make(good):
        def configure(self, now_ns):
            good(self, now_ns)
            self._can_id = self._can_id and 0x85

        return configure

    _wrap(patch, EmcyProducer, "configure", make)


@mutant("LSS-01")
def any_serial_number_is_identified(patch):
    """LSS identifies the drive by any serial number."""

    def make(good):
        def identify(self, place, number, now_ns):
            good(self, place, 0 if place == 4 else 0xFFFF_FFFF if place == 5 else number, now_ns)

        return identify

    _wrap(patch, lss.LssSlave, "_identify", make)


@mutant("LSS-02")
def node_id_is_active_at_once(patch):
    """A node-ID of LSS is reported before the reset."""

    def make(good):
        def configure(self, command, frame, node_id, now_ns):
            good(self, command, frame, self.pending_node_id, now_ns)

        return configure

    _wrap(patch, lss.LssSlave, "_configure", make)


@mutant("PDO-08")
def sampled_tpdo_has_present_values(patch):
    """A TPDO of type 252 has the values at the request."""
    patch.setattr(pdo, "SAMPLED_ON_REQUEST", 251)


@mutant("PDO-09")
def mapping_is_changed_while_valid(patch):
    """The mapping of a PDO can be changed while it is valid."""
    _always(patch, PdoParameters, "is_valid", False)


@mutant("PDO-10")
def dummies_take_no_space(patch):
    """A dummy entry of an RPDO is left out."""

    def make(good):
        return lambda entries: good([one for one in entries if one[0] is not None])

    _wrap(patch, pdo_mapping, "PdoMapping", make)


@mutant("FOL-02")
def set_points_put_off_the_following_error(patch):
    """Each command begins the time 6066h anew."""

    def make(good):
        def begin(self, *args):
            good(self, *args)
            state = self._time.state
            self._time.order(self._orders, (*state[:16], 0, *state[17:]))

        return begin

    _wrap(patch, Axis, "_begin", make)


@mutant("PDO-12")
def objects_of_a_pdo_are_reversed(patch):
    """The last entry of a mapping is the first one in the frame."""
    _wrap(patch, pdo_mapping, "PdoMapping", lambda good: lambda entries: good(entries[::-1]))


@mutant("PDO-11")
def missing_rpdo_is_not_told(patch):
    """An RPDO that does not come in time sends no EMCY."""
    _wrap(patch, Rpdo, "receive_watched", lambda good: lambda self, *args: self.receive(*args))


@mutant("SYN-01")
def sync_counter_is_not_required(patch):
    """A SYNC of any length counts."""
    _always(patch, sync.SyncService, "is_right", True)


@mutant("SYN-02")
def own_sync_is_twice_as_slow(patch):
    """The drive sends SYNC each 1006h times two."""

    def make(good):
        def begin(self, now_ns):
            good(self, now_ns)
            self._period_ns *= 2

        return begin

    _wrap(patch, sync.SyncService, "_begin", make)


@mutant("SYN-03")
def sync_window_is_ignored(patch):
    """A synchronous RPDO counts after its window, too."""
    _always(patch, Rpdo, "is_plain", True)


# --- the plant


@mutant("PLANT-01", DRIVES["warm"])
def housing_is_not_warmed(patch):
    """The winding gets warm as if its housing stayed at the temperature of the air."""

    def make(good):
        def warming(plant, slow_s):
            ww, wh, wp, _, hh, _ = good(plant, slow_s)
            return ww, wh, wp, 0.0, hh, 0.0

        return warming

    _wrap(patch, nonlinear_tables, "_warming", make)


@mutant("PLANT-02", DRIVES["i2t"])
def i2t_never_empties(patch):
    """I2t keeps its level at currents below the continuous one."""

    def make(good):
        def reckon(tables, winding, housing, level, losses):
            winding, housing, after = good(tables, winding, housing, level, losses)
            return winding, housing, max(level, after)

        return reckon

    _wrap(patch, nonlinear_servo, "reckon", make)


@mutant("PLANT-03", DRIVES["chopper"])
def chopper_takes_no_current(patch):
    """The brake chopper never conducts."""

    def make(good):
        def init(self, *args, **kwargs):
            good(self, *args, **kwargs)
            self.chopper_1_ohm = 0.0

        return init

    _wrap(patch, nonlinear_tables.ExtrasTables, "__init__", make)


@mutant("PLANT-04", DRIVES["end stops"])
def end_stop_swallows_the_speed(patch):
    """The load does not rebound."""

    def make(good):
        def init(self, *args, **kwargs):
            good(self, *args, **kwargs)
            self.restitution = 0.0

        return init

    _wrap(patch, nonlinear_tables.StepNumbers, "__init__", make)


@mutant("PLANT-05", DRIVES["pendulum"])
def pendulum_stands_on_its_head(patch):
    """Gravity has the other sign."""
    _wrap(patch, nonlinear_servo, "wave", lambda good: lambda turns: -good(turns))


@mutant("PLANT-06", DRIVES["sticky"])
def static_friction_falls_off_slowly(patch):
    """Static friction falls at ten times the Stribeck speed."""

    def make(good):
        def init(self, *args, **kwargs):
            good(self, *args, **kwargs)
            self.stribeck /= 100.0

        return init

    _wrap(patch, nonlinear_tables.StepNumbers, "__init__", make)


@mutant("PLANT-07", DRIVES["cogging"])
def motor_cogs_twice_as_often(patch):
    """The cogging torque has twice as many periods."""

    def make(good):
        def init(self, *args, **kwargs):
            good(self, *args, **kwargs)
            self.cogging_inc *= 2.0

        return init

    _wrap(patch, nonlinear_tables.StepNumbers, "__init__", make)


@mutant("PLANT-08", DRIVES["friction at the output"])
def friction_of_the_output_is_the_motors(patch):
    """The Coulomb friction of the load is taken for that of the motor."""

    def make(good):
        def init(self, plant, *args, **kwargs):
            good(self, plant, *args, **kwargs)
            self.coulomb = plant.coulomb_friction_n_m + plant.extras.output_coulomb_friction_n_m

        return init

    _wrap(patch, nonlinear_tables.StepNumbers, "__init__", make)


@mutant("PLANT-09", DRIVES["late wakes"])
def lateness_is_always_the_same(patch):
    """A drive with jitter is always as late as it can be."""
    patch.setattr(clock, "lateness_ns", lambda seed, due_ns, jitter_ns: jitter_ns)


@mutant("TIME-01")
def identifier_of_time_changes_while_it_listens(patch):
    """1012h takes another identifier while the drive listens to TIME."""
    patch.setattr(sync.TimeConsumer, "check", lambda self, value: 0)


@mutant("OD-08")
def numbers_are_sent_in_bytes_that_suffice(patch):
    """Numbers of the object dictionary are uploaded without their leading zeros."""

    def make(good):
        def uploaded(self):
            return good(self).rstrip(b"\0") or b"\0"

        return uploaded

    _wrap(patch, object_dictionary.Variable, "upload", make)


@mutant("IP-04")
def records_pass_the_position_limits(patch):
    """In ip, records beyond 607Dh are followed."""

    def take(self):
        ip = self.objects.ip
        if ip.is_empty():
            return False
        self.axis.follow(ip.take_inc(), self.over_ns(), has_target=ip.is_empty())
        return True

    patch.setattr(InterpolatedPosition, "_take", take)


@mutant("FAC-02", 'objects = { "6091h:2" = 0 }')
def gear_has_no_divisor(patch):
    """6091h:2 is 0."""


@mutant("TQ-07")
def limit_switch_heeds_the_torque_alone(patch):
    """In tq, a limit switch stops only a torque into it, not a motion."""

    def make(good):
        def bar(self, backward, forward, deceleration_inc_s2):
            if self._mode >= servo.TORQUE:
                backward, forward = backward and self._way < 0.0, forward and self._way > 0.0
            good(self, backward, forward, deceleration_inc_s2)

        return bar

    _wrap(patch, Axis, "bar", make)


@mutant("GAIN-01")
def gains_are_stored_only(patch):
    """Gains can be written, and have no effect."""
    _always(patch, GainWatch, "write", 0)


@mutant("PLANT-10")
def friction_helps_at_full_voltage(patch):
    """At full voltage, the motor has no friction."""
    _wrap(patch, servo, "steps", lambda good: lambda table, *rest: good((*table[:-1], 0.0), *rest))


@mutant("PLANT-11", DRIVES["backlash"])
def load_has_twice_the_play(patch):
    """The backlash is twice as wide as stated."""

    def make(good):
        def init(self, *args, **kwargs):
            good(self, *args, **kwargs)
            self.gap *= 2.0

        return init

    _wrap(patch, nonlinear_tables.StepNumbers, "__init__", make)


@mutant("PLANT-12")
def motor_without_current_runs_too_long(patch):
    """A servo tick without current has the effect of half a tick."""
    patch.setattr(axis, "tables_of", servo_tables.tables_of.__wrapped__)

    def sampled(plant, step_s):
        return sample(plant, min(step_s, 0.0005))

    patch.setattr(servo_tables, "_sampled", sampled)


@mutant("OD-10", 'objects = { "6081h" = 40000 }')
def objects_of_the_rig_are_ignored(patch):
    """The drive powers on with its own values."""
    _always(patch, drive, "_set_objects", None)


@mutant("OD-09")
def object_of_its_file_is_absent(patch):
    """1009h, which the EDS names, does not exist."""

    def make(good):
        return lambda self, index, *rest: None if index == 0x1009 else good(self, index, *rest)

    _wrap(patch, object_dictionary.ObjectDictionary, "get", make)
