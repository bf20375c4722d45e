"""Mistakes in homing, low-level access and closing."""

from functools import partial
from unittest.mock import patch

from motorhil.emulators.cia402.drive import Cia402Drive
from motorhil.motorapi.adaptations.canopen import node
from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.cia402 import hardware, motion
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.objects import Mode
from motorhil.motorapi.adaptations.cia402.parameters import ParameterStore
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.ideal import hardware as ideal_hardware
from motorhil.motorapi.adaptations.ideal.hardware import IdealHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.motor import Motor
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
from tests.conformance.mutants import mutant, replaced


@mutant("ideal", "HOME-01")
def homed_and_not_renamed():
    """Homing on the spot is recorded, but the position is not changed."""

    def wrong(call_here):
        def called(self, position):
            call_here(self, self.reading().position)

        return called

    with replaced(IdealHwMotor, "call_here", wrong):
        yield


@mutant("ideal", "HOME-02")
def any_homing_will_do():
    """An unknown homing method is replaced by the usual one."""
    with replaced(IdealMotor, "_home", lambda home: lambda self, method: home(self, None)):
        yield


@mutant("leadshine", "LOW-01")
def low_level_access_closes():
    """The end of low-level access closes the hardware."""

    def wrong(close_low_level):
        def closed(self):
            close_low_level(self)
            self.hardware.close()

        return closed

    with replaced(PolledMotor, "_close_low_level", wrong):
        yield


@mutant("ideal", "LOW-02")
def low_level_access_in_mid_motion():
    """A reached velocity counts as done, so low-level access is granted while the motor moves."""
    with replaced(LogicalMotor, "_is_at_rest", lambda at_rest: lambda motor, *, patient: True):
        yield


@mutant("cia402", "LOW-06")
def settings_that_were_written_once():
    """After low-level access, the drive is taken to have the settings that it had before."""

    def wrong(_):
        def believes(self, index, subindex, data):
            return self._kept.get((index, subindex)) == data

        return believes

    def kept(push):
        def pushed(self, index, subindex, data):
            found = push(self, index, subindex, data)
            self._kept[index, subindex] = data
            return found

        return pushed

    changed = patch.object(ObjectAccess, "_kept", {}, create=True)
    pushed = replaced(ObjectAccess, "push_bytes", kept)
    with changed, pushed, replaced(ObjectAccess, "_believes", wrong):
        yield


@mutant("ideal", "SHARE-10")
def each_close_counts():
    """Closing twice counts as two users: the hardware is closed while others use it."""

    def wrong(close):
        def closed(self):
            on_close = self._on_close
            close(self)
            self._on_close = on_close

        return closed

    with replaced(IdealMotor, "close", wrong):
        yield


@mutant("cia402", "HOME-03")
def once_homed_is_homed_for_good():
    """A drive that was homed once is referenced for good, but forgets its position at a restart."""

    def wrong(reset):
        def made(drive, whole, now_ns):
            reset(drive, whole, now_ns)
            drive.axis.set_position(0, drive.axis.count())

        return made

    known = property(lambda self: self._homed_at_boot is not None)
    with patch.object(Cia402HwMotor, "is_homed", known), replaced(Cia402Drive, "on_reset", wrong):
        yield


@mutant("cia402", "LOW-03")
def low_level_access_leaves_all_as_it_was():
    """After low-level access all settings are believed; restarts meanwhile are not noticed."""

    def wrong(heard):
        def told(node, frame, time_ns):
            if node.sdo.physical is None or node.sdo.physical.access is None:
                heard(node, frame, time_ns)

        return told

    with (
        replaced(CanopenNode, "_on_heartbeat", wrong),
        replaced(CanopenNode, "look_for_restart", lambda _: lambda node: None),
        replaced(Cia402Motor, "_close_low_level", lambda _: lambda motor: None),
    ):
        yield


@mutant("cia402", "LOW-04")
def switching_off_by_hand_is_not_done():
    """disable() of the hardware object returns without a command."""
    with replaced(Cia402HwMotor, "disable", lambda _: lambda hardware: None):
        yield


@mutant("cia402", "LOW-05")
def every_object_is_its_first():
    """upload() of the hardware object ignores the sub-index."""

    def wrong(upload):
        return lambda hardware, index, subindex=0: upload(hardware, index)

    with replaced(Cia402HwMotor, "upload", wrong):
        yield


@mutant("cia402", "LOW-05")
def the_hardware_object_is_always_free():
    """The hardware object obeys everybody while its motor moves."""
    with replaced(PhysicalMotor, "require_free", lambda _: lambda physical: None):
        yield


@mutant("cia402", "LOW-07")
def stopped_nodes_are_waited_for():
    """A node in NMT state stopped is asked until the time is over, and not started."""
    with patch.object(node, "STOPPED", None):
        yield


@mutant("cia402", "LOW-08")
def streams_wait_for_a_beginning():
    """A stream of the hardware object sends nothing until somebody begins it."""
    with patch.object(hardware, "CspStream", partial(CspStream, at_once=False)):
        yield


@mutant("ideal", "CLOSE-01")
def closed_and_still_at_work():
    """close() returns without closing anything."""
    with replaced(IdealMotor, "close", lambda _: lambda motor: None):
        yield


@mutant("ideal", "CLOSE-02")
def closed_for_ever():
    """A closed motor keeps its place, so that it cannot be opened again."""
    with patch.object(ideal_hardware, "release_physical_motor", lambda *_: None):
        yield


@mutant("cia402", "CLOSE-03")
def closed_with_its_hardware_alone():
    """A closed motor obeys as long as another user keeps the hardware open."""
    with replaced(LogicalMotor, "close", lambda _: lambda logical: None):
        yield


@mutant("software", "HOME-04")
def zero_is_lost_with_the_cable():
    """Whenever the node is found again, its counter is taken for new; the reference stays."""

    def wrong(take_place):
        def taken(self, facts):
            self._boot = -1
            take_place(self, facts)

        return taken

    with replaced(AmplifierHwMotor, "_take_place", wrong):
        yield


@mutant("cia402", "PAR-01")
def parameters_stay_for_all_users():
    """The parameters of one logical motor stay in the drive for the others."""

    def wrong(apply):
        def applied(self, motor, wanted):
            self._own = {place: data for place, data in self._own.items() if place in wanted}
            apply(self, motor, wanted)

        return applied

    with replaced(ParameterStore, "apply", wrong):
        yield


@mutant("cia402", "PAR-01")
def parameters_stay_after_disable():
    """The drive does not get its own parameters back when it is disabled."""
    with replaced(Cia402Motor, "_restore_parameters", lambda _: lambda self: None):
        yield


@mutant("cia402", "PAR-01")
def a_ramp_ends_within_the_window():
    """A velocity trajectory is done within the window of velocity, not at the end of its ramp."""

    def wrong(watch):
        return lambda expected_s, duration_s: watch(expected_s, None)

    with replaced(motion, "_live_watch", wrong):
        yield


@mutant("cia402", "LOW-09")
def a_short_frame_hides_a_fault():
    """The last error of any kind is taken for the fault of the drive."""

    def last(standing):
        def heard(before, emergency):
            return emergency if emergency.code & 0xFF00 else standing(before, emergency)

        return heard

    with replaced(node, "standing_error", last):
        yield


@mutant("cia402", "LOW-09")
def hardware_object_sets_no_mode():
    """set_mode() of the hardware object checks the mode, and does not set it."""

    def wrong(set_mode):
        def checked(self, mode):
            if mode not in tuple(Mode):
                set_mode(self, mode)

        return checked

    with replaced(Cia402HwMotor, "set_mode", wrong):
        yield


@mutant("cia402", "HOME-02")
def a_search_goes_on_beyond_its_time():
    """A homing whose time is over fails, and the motor searches on."""

    def wrong(home):
        def homed(self, method=None, *, wait=True, timeout_s=60.0):
            home(self, method, wait=False)
            if wait:
                self.wait_until_done(timeout_s)

        return homed

    with replaced(Motor, "home", wrong):
        yield
