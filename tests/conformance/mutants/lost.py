"""Mistakes that show only with lost frames, drives or hosts."""

from contextlib import suppress
from unittest.mock import patch

from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.cia402.controlword import StopRepetition
from motorhil.motorapi.adaptations.cia402.csp import CspStream
from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.cia402.motion_status import StreamWatch
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.node import DriveNode
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.oriental_az.hardware import OrientalAzHwMotor
from motorhil.motorapi.api.can_drive import CanDrive
from motorhil.motorapi.api.polled_hardware import PolledHardware
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.commands import Setpoint
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, LinkError
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor
from tests.conformance.mutants import mutant, replaced

PREPARATION = (0x06, 0x07, 0x0F)  # CiA 402-2: to operation enabled
NEW_SET_POINT = 0x3F
RELATIVE = 0x0041


@mutant("cia402", "LOST-01")
def heartbeat_not_watched():
    """The drive sends its heartbeat, but its loss is not noticed."""
    with replaced(DriveNode, "expect_heartbeat", lambda _: lambda node: None):
        yield


@mutant("cia402", "LOST-01")
def done_after_the_cable_was_cut():
    """A drive that is not heard counts as at rest: its motion is done."""

    def wrong(is_done):
        def told(motor):
            try:
                return is_done(motor)
            except LinkError:
                return True

        return told

    with replaced(Cia402Motor, "_is_done", wrong):
        yield


@mutant("oriental_az", "LOST-01")
def last_state_for_ever():
    """Without an answer, the last known state is reported."""

    def wrong(read):
        def told(motor):
            try:
                return motor._poll().state
            except DeadlineExceeded:
                return motor._told_last

        return told

    def noting(poll):
        def polled(motor):
            found = poll(motor)
            motor._told_last = found.state
            return found

        return polled

    with (
        replaced(PolledMotor, "_poll", noting),
        replaced(PolledMotor, "_read_state", wrong),
    ):
        yield


@mutant("cia402", "LOST-02")
def dead_man_never_set_up():
    """The drive's heartbeat consumer is not configured."""
    with _instead(0x1016, lambda value: 0):
        yield


@mutant("cia402", "LOST-03")
def dead_man_watches_the_neighbour():
    """The drive monitors node 2, which is another drive, and not the host."""
    with _instead(0x1016, lambda value: 2 << 16 | value & 0xFFFF):
        yield


@mutant("cia402", "LOST-02")
def dead_man_does_nothing():
    """6007h is 0: the drive notices the loss of its host, and continues."""
    with _instead(0x6007, lambda value: 0):
        yield


def _instead(index, change):
    """Write another value into an object during set-up."""

    def wrong(write):
        def written(node, place, value, *args):
            return write(node, place, change(value) if place[0] == index else value, *args)

        return written

    return replaced(CanopenNode, "write_if_different", wrong)


def _word_frame(can_id, word):
    return (
        can_id.to_bytes(4, "little") + bytes((2, 0, 0, 0)) + word.to_bytes(2, "little") + bytes(6)
    )


def _target_frame(can_id, word, target):
    data = word.to_bytes(2, "little") + target.to_bytes(4, "little", signed=True)
    return can_id.to_bytes(4, "little") + bytes((6, 0, 0, 0)) + data + bytes(2)


@mutant("cia402", "LOST-04")
def goes_on_by_itself_when_it_is_heard_again():
    """A drive that is heard again is enabled and continues to its last target, for convenience."""

    def wrong(start):
        def armed(motor, motion, *, together):
            trigger = start(motor, motion, together=together)
            motor._hardware_facts = motor._hardware.facts
            node, was_lost = motor._node, []

            def look():
                if node.lost_since_ns is not None:
                    was_lost.append(True)
                elif was_lost:
                    was_lost.clear()
                    timer.cancel()
                    node.bus.nmt(0x01, node.node_id)
                    for word in (*PREPARATION, NEW_SET_POINT):
                        frame = _word_frame(motor._hardware_facts.control_id, word)
                        node.link.send_tracked(frame, None)

            timer = motor.runtime.every(0.05, look)
            return trigger

        return armed

    with replaced(Cia402Motor, "_arm", wrong):
        yield


@mutant("cia402", "LOST-05")
def state_of_before_the_loss():
    """A drive that stopped by itself sends no status, and is reported as before."""

    def wrong(_):
        return DriveReader.state

    with replaced(DriveReader, "fresh_state", wrong):
        yield


@mutant("oriental_az", "LOST-05")
def a_loss_is_taken_for_a_restart():
    """After a loss, a drive that kept its power is reported as disabled."""
    with replaced(OrientalAzHwMotor, "_remembers", lambda _: lambda hardware, inputs: False):
        yield


@mutant("oriental_az", "LOST-05")
def only_a_motion_proves_the_power():
    """After a loss, a drive that was enabled, but never moved, is reported as disabled."""

    def wrong(remembers):
        return lambda hardware, inputs: (
            hardware.progress.started_ns is not None and remembers(hardware, inputs)
        )

    with replaced(OrientalAzHwMotor, "_remembers", wrong):
        yield


@mutant("cia402", "LOST-09")
def a_start_that_failed_is_tried_again_in_the_background():
    """A start that failed because of a lost drive is repeated when the drive is heard again."""

    def wrong(read):
        def told(motor):
            try:
                return read(motor)
            except (DeadlineExceeded, LinkError):
                command = motor.logical.command
                if not isinstance(command, Setpoint):
                    raise
                node, facts = motor._node, motor._hardware.facts
                way = motor._reader._units.increments(command.value)
                target = node.position_inc + round(way)

                def again():
                    if node.lost_since_ns is not None:
                        return
                    node.bus.nmt(0x01, node.node_id)
                    for word in (*PREPARATION, PREPARATION[-1]):
                        node.link.send_tracked(_word_frame(facts.control_id, word), None)
                    latched = facts.latched_ids[0x607A]
                    node.link.send_tracked(_target_frame(latched, NEW_SET_POINT, target), None)
                    node.bus.sync.send()

                motor.runtime.every(0.2, again)
                raise

        return told

    with replaced(Cia402Motor, "_read_reference", wrong):
        yield


@mutant("cia402", "LOST-07")
def believes_what_it_wrote_before_a_restart():
    """Values written to a drive are assumed to be there after it has booted."""

    def wrong(doubt):
        return lambda objects, index=None, subindex=0: (
            index is not None and doubt(objects, index, subindex)
        )

    with replaced(ObjectAccess, "doubt", wrong):
        yield


@mutant("cia402", "LOST-08")
def stream_into_the_void():
    """Set-points are streamed to the end, even if the drive does not follow."""
    with replaced(CspStream, "_is_followed", lambda _: lambda stream, now_ns: True):
        yield


@mutant("cia402", "LOST-11")
def what_was_heard_never_grows_old():
    """The last status is told as the present one, although its message stays away."""
    with patch.object(DriveNode, "is_old", False):
        yield


@mutant("cia402", "LOST-09")
def a_stop_is_sent_once():
    """A stop is sent once, and not again if the drive does not obey."""
    with replaced(StopRepetition, "_again", lambda _: StopRepetition.cancel):
        yield


@mutant("leadshine", "LOST-09")
def a_stop_without_answer_is_given_up():
    """A stop that was not answered is not sent again, although the motor moves."""
    with replaced(PolledHardware, "_stop_again", lambda _: lambda self, is_moving: None):
        yield


@mutant("leadshine", "LOST-09")
def a_retry_moves_twice():
    """Distances are sent as such, and a request without an answer is repeated."""

    def wrong(trigger):
        def told(hardware):
            path = hardware._prepared
            if path[0] & 1:
                here = hardware.registers.read_i32(0x602C)
                way = (path[1] << 16 | path[2] & 0xFFFF) - here
                path = (path[0] | RELATIVE, way >> 16, way & 0xFFFF, *path[3:])
            try:
                hardware.registers.write(0x6200, *path)
            except DeadlineExceeded:
                hardware.registers.write(0x6200, *path)

        return told

    with replaced(LeadshineHwMotor, "trigger", wrong):
        yield


@mutant("cia402", "FAULT-05")
def faults_of_streams_swallowed():
    """A streamed motion that a fault has ended counts as done."""

    def wrong(is_done):
        def told(motor):
            if isinstance(motor._node.watch, StreamWatch):
                with suppress(DeviceFault):
                    return is_done(motor)
                return True
            return is_done(motor)

        return told

    with replaced(Cia402Motor, "_is_done", wrong):
        yield


@mutant("cia402", "LOST-11")
def a_status_that_stays_away_is_awaited():
    """A drive with a heartbeat is waited for, although its status does not come any more."""

    def wrong(refresh):
        return lambda motor: None if motor.hardware.node.status_is_cyclic else refresh(motor)

    told = property(lambda node: node.status_is_cyclic)
    with patch.object(DriveNode, "is_told", told), replaced(Cia402Motor, "_refresh", wrong):
        yield


@mutant("software", "LOST-12")
def unnoticed_failure_is_forgotten():
    """A motion that failed while no caller waited goes on after the drive was set up again."""
    with (
        replaced(LogicalMotor, "_bury_failed_run", lambda _: lambda self: None),
        replaced(PhysicalMotor, "fail", lambda _: lambda self, error, now_ns: None),
    ):
        yield


@mutant("rmd", "LOST-13")
def any_silence_is_a_loss():
    """A drive counts as lost after a quarter of the time that its option states."""

    def wrong(expect):
        def sooner(self, what, within_s, on_loss):
            return expect(self, what, 0.25 * within_s, on_loss)

        return sooner

    with replaced(CanDrive, "expect", wrong):
        yield
