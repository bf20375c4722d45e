"""Drives with one mistake each, and the clause that must find it.

A mistake breaks a class of the emulator for one test (pytest's monkeypatch), or is a quirk or an
object of the rig. Its docstring describes it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from motorhil.emulators.canopen import sdo_server
from motorhil.emulators.canopen.codes import AbortCode
from motorhil.emulators.canopen.emcy import EmcyProducer
from motorhil.emulators.canopen.error_control import HeartbeatConsumer, HeartbeatProducer
from motorhil.emulators.canopen.files import parameter_storage
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.pdo import Rpdo
from motorhil.emulators.canopen.pdo_parameters import PdoParameters
from motorhil.emulators.cia402 import power_drive, state_machine
from motorhil.emulators.cia402.modes import cyclic
from motorhil.emulators.cia402.modes.profile_position import ProfilePosition
from motorhil.emulators.cia402.modes.profile_velocity_torque import ProfileVelocity
from motorhil.emulators.cia402.objects import mode_objects, units
from motorhil.emulators.cia402.objects.mode_objects import HomingObjects
from motorhil.emulators.cia402.objects.motion import MotionObjects, OptionCodes, WindowObjects
from motorhil.emulators.cia402.power_drive import PowerDrive
from motorhil.emulators.cia402.state_machine import Command, PdsState
from motorhil.emulators.firmware import flags

_S, _C = PdsState, Command


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
        assert plant.__doc__
        assert plant.__name__ not in MUTANTS
        MUTANTS[plant.__name__] = Mutant(plant.__name__, killer, plant, keys)
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
