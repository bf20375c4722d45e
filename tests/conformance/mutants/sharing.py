"""Mistakes with motors that several users, or programs, share."""

from contextlib import contextmanager

from motorhil.motorapi import MotionInterrupted, Motor, MotorBusyError, execution
from motorhil.motorapi.adaptations.canopen.object_access import ObjectAccess
from motorhil.motorapi.adaptations.canopen.sdo import ChannelClient
from motorhil.motorapi.adaptations.canopen.sync import BusSync, SharedBus
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.node_sharing import SharedNode
from motorhil.motorapi.adaptations.host_servo.hardware import AmplifierHwMotor
from motorhil.motorapi.adaptations.ideal.motor import IdealMotor
from motorhil.motorapi.adaptations.mit.hardware import MitHwMotor
from motorhil.motorapi.api import can_drive
from motorhil.motorapi.api.can_hardware import StreamedCanHardware
from motorhil.motorapi.api.line_exchanges import ExchangeLine
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.api.streamed_motor import StreamedMotor
from motorhil.motorapi.group import CommonMotion
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.logical_motor import LogicalMotor
from motorhil.motorapi.ownership.claim import AcquirePolicy, Claim, OwnershipKeepAlive
from motorhil.motorapi.ownership.fencing import BoundFence
from motorhil.motorapi.ownership.ownership import Ownership, WaitQueue
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor, RunStatus
from motorhil.motorapi.ownership.queue import FifoQueue
from motorhil.motorapi.runtime.turn_lock import TurnLock
from tests.conformance.mutants import mutant, replaced
from tests.support.sharing.mutants import a_lock_without_fifo, no_fencing


@mutant("ideal", "SHARE-01")
def a_record_for_each_user():
    """Every logical motor has its own record of the physical motor, and ignores other users."""

    def wrong(make):
        def made(motor, hardware, *args, **kwargs):
            make(motor, hardware, *args, **kwargs)
            physical = PhysicalMotor(hardware.label, id(motor))
            physical.news = hardware.physical.news
            motor._physical = motor.logical.physical = physical

        return made

    with replaced(IdealMotor, "__init__", wrong):
        yield


@mutant("cia402", "SHARE-02")
def prepared_before_it_is_asked_for():
    """A start sends its controlword before it has acquired the motor."""

    def wrong(start):
        def begun(motor, *args, **options):
            can_id = 0x200 + motor._node.node_id
            head = can_id.to_bytes(4, "little") + bytes((2, 0, 0, 0))
            if motor.logical.physical.access is None:
                motor._control._send(head + bytes((0x0F, 0)) + bytes(6), None)
            return start(motor, *args, **options)

        return begun

    with replaced(Cia402Motor, "start", wrong):
        yield


@mutant("leadshine", "SHARE-03")
def a_stop_needs_the_lock():
    """A stop is obeyed only from the owner."""

    def wrong(bring):
        def brought(motor, operation, stop):
            run = motor.physical.run
            if run is None or run.owner is motor or motor.physical.access is not None:
                bring(motor, operation, stop)

        return brought

    with replaced(LogicalMotor, "bring_to_rest", wrong):
        yield


@mutant("oriental_az", "SHARE-01")
def told_to_be_held_by_oneself():
    """A refused user is named as the owner."""

    def wrong(make):
        def made(error, *, motor, holder, **facts):
            make(error, motor=motor, holder=f"start() of {motor}", **facts)

        return made

    with replaced(MotorBusyError, "__init__", wrong):
        yield


@mutant("cia402", "SHARE-04")
def each_believes_what_it_wrote_itself():
    """Values written by one user are assumed valid, though another user has changed them."""

    def wrong(believes):
        def believed(objects, index, subindex, data):
            if index != 0x6081:  # the velocity of a profile
                return believes(objects, index, subindex, data)
            caches = objects.physical.__dict__.setdefault("caches", {})
            mine = caches.setdefault(id(objects.physical._owner), {})
            if mine.get(index) == data:
                return True
            mine[index] = data
            return False

        return believed

    with replaced(ObjectAccess, "_believes", wrong):
        yield


@mutant("ideal", "SHARE-05")
def a_lease_outlives_its_block():
    """The lease of a reservation inside another one stays after its block."""

    def wrong(set_lease):
        def kept(self, lease_s):
            if lease_s is not None:
                set_lease(self, lease_s)

        return kept

    with replaced(Claim, "set_lease", wrong):
        yield


@mutant("ideal", "SHARE-05")
def not_given_back_after_an_error():
    """A reservation that is left by an error is not released."""
    kept = []

    def wrong(reserve):
        @contextmanager
        def reserved(motor, *args, **kwargs):
            block = reserve(motor, *args, **kwargs)
            held = block.__enter__()
            try:
                yield held
            except ZeroDivisionError:
                kept.append(block)
                raise
            block.__exit__(None, None, None)

        return reserved

    with replaced(Motor, "reserve", wrong):
        yield


@mutant("cia402", "SHARE-06")
def let_go_while_it_slows_down():
    """A stopped motor is released at once, at rest or not."""

    def wrong(take):
        def taken(physical, owner, motor, status, taken_over_ns=None):
            if physical.run is not None and physical.run.motion is None:
                status = RunStatus.DONE
            take(physical, owner, motor, status, taken_over_ns)

        return taken

    def over(goes_on):
        return lambda motor, run: run.motion is not None and goes_on(motor, run)

    with replaced(PhysicalMotor, "take", wrong), replaced(LogicalMotor, "goes_on", over):
        yield


@mutant("software", "SHARE-07")
def who_comes_last_is_served_first():
    """Waiting users are served last in, first out."""
    with a_lock_without_fifo():
        yield


@mutant("cia402", "SHARE-08")
def an_orphan_goes_on():
    """A takeover does not bring the motor to rest."""
    with replaced(LogicalMotor, "adopt", lambda _: lambda motor, timeout_s, asked_ns: None):
        yield


@mutant("ideal", "SHARE-08")
def who_has_lost_it_goes_on():
    """A user that has lost a motor can still command it."""
    with no_fencing():
        yield


@mutant("software", "SHARE-09")
def a_servo_that_goes_on_under_low_level_access():
    """The servo loop continues during low-level access."""
    with replaced(AmplifierHwMotor, "fall_silent", lambda _: lambda hardware: None):
        yield


@mutant("oriental_az", "SHARE-10")
def the_last_one_shuts_the_door_every_time():
    """Every close() closes the shared hardware object."""

    def wrong(close):
        def closed(motor):
            close(motor)
            motor.hardware.close()

        return closed

    with replaced(PolledMotor, "close", wrong):
        yield


@mutant("ideal", "SHARE-03")
def a_halt_of_another_is_told_to_nobody():
    """A halt of another user ends a motion as if it were done."""

    def wrong(bring):
        def brought(motor, operation, stop):
            run = motor.physical.run
            if operation == "halt" and run is not None and run.owner is not motor:
                stop()
                return
            bring(motor, operation, stop)

        return brought

    with replaced(LogicalMotor, "bring_to_rest", wrong):
        yield


@mutant("oriental_az", "SHARE-08")
def only_starts_need_the_motor():
    """A user who has lost a motor cannot start it, but can switch it off."""

    def wrong(operation):
        @contextmanager
        def made(motor, name, timeout_s=None):
            if name == "disable":
                yield
                return
            with operation(motor, name, timeout_s):
                yield

        return made

    with replaced(LogicalMotor, "operation", wrong):
        yield


@mutant("cia402", "SHARE-12")
def a_reservation_keeps_readers_away():
    """Only the owner of a motor may read it."""

    def wrong(read):
        def told(motor):
            held = motor.ownership.held
            if held is not None and held.owner is not motor.logical:
                raise MotorBusyError(motor=motor.name, holder=held.who, since_ns=held.since_ns)
            return read(motor)

        return told

    with replaced(Cia402Motor, "_read_position", wrong):
        yield


@mutant("cia402", "SHARE-13")
def requests_of_threads_are_mixed():
    """Two threads use the SDO channel of a drive at once."""
    with (
        replaced(TurnLock, "take", lambda _: lambda *_args: None),
        replaced(TurnLock, "give_back", lambda _: lambda *_args: None),
    ):
        yield


@mutant("ideal", "SHARE-14")
def a_first_waiter_without_a_name():
    """The error for a motor that others wait for names the one who asks."""

    def wrong(busy):
        def named(row, owner, policy):
            error = busy(row, owner, policy)
            return error and MotorBusyError(motor=error.motor, holder=owner.name, since_ns=0)

        return named

    with replaced(WaitQueue, "_busy", wrong):
        yield


@mutant("ideal", "PROC-01")
def released_at_the_first_reason():
    """A motor is free for other programs when the first of several reasons has ended."""

    def wrong(give):
        def given(ownership, claim):
            claim.reasons = min(claim.reasons, 1)
            give(ownership, claim)

        return given

    with replaced(Ownership, "give", wrong):
        yield


@mutant("ideal", "PROC-02")
def a_loss_that_ends_no_motion():
    """After a takeover by another program, the motion of the former owner goes on."""
    with replaced(Ownership, "note_loss", lambda _: lambda ownership, claim: None):
        yield


@mutant("ideal", "PROC-03")
def an_inner_lease_that_stays():
    """The lease of an inner reservation replaces that of the outer one for good."""

    def wrong(set_lease):
        def once(claim, lease_s):
            if claim.lease_s is None or lease_s < claim.lease_s:
                set_lease(claim, lease_s)

        return once

    with replaced(Claim, "set_lease", wrong):
        yield


@mutant("ideal", "PROC-04")
def a_stream_that_outlives_its_ownership():
    """Frames of a stream pass under a later ownership of the same program, too."""

    def wrong(_):
        def send(bound, frame):
            bound._fence.send(frame)

        return send

    with replaced(BoundFence, "send", wrong):
        yield


@mutant("ideal", "PROC-05")
def a_motion_that_is_not_looked_at():
    """A motor that is kept for a motion stays so when the motion has ended."""
    with replaced(OwnershipKeepAlive, "look", lambda _: lambda keeper: None):
        yield


@mutant("ideal", "PROC-06")
def turns_within_one_program():
    """A turn that is taken at once does not ask other programs."""

    def wrong(_):
        @contextmanager
        def at_once(queue, runtime, who):
            yield not queue._queue

        return at_once

    with replaced(FifoQueue, "at_once", wrong):
        yield


@mutant("ideal", "PROC-07")
def a_wait_without_an_end():
    """A request that waits ends its wait twice as late as it was told to."""

    def wrong(until):
        def patient(policy, runtime, done, timeout_s, *further, **named):
            return until(policy, runtime, done, 2.0 * timeout_s, *further, **named)

        return patient

    with replaced(AcquirePolicy, "until", wrong):
        yield


@mutant("cia402", "SHARE-15")
def operations_do_not_wait():
    """An operation is refused while another one is active, however short that is."""

    def refuse(queue, _runtime, _ticket, _timeout_s):
        raise queue._queue[0].busy(queue.label)

    with replaced(FifoQueue, "_wait", lambda _: refuse):
        yield


@mutant("rmd", "PROC-15")
def a_stop_believes_the_last_measurement():
    """A stop does nothing if the motor was at rest when it was measured last."""

    def wrong(stop):
        def stopped(motor):
            if motor.hardware.motions.variable is not None or not motor._rests():
                stop(motor)

        return stopped

    with replaced(StreamedMotor, "_stop", wrong):
        yield


@mutant("cia402", "PROC-08")
def settings_of_other_programs_are_not_noticed():
    """Values written to a drive are believed, although another program has had it since."""

    def wrong(take):
        def taken(physical, *args, **options):
            physical._absences = physical.ownership.absences
            take(physical, *args, **options)

        return taken

    left = replaced(SharedNode, "is_as_we_left_it", lambda _: True)
    with left, replaced(PhysicalMotor, "take", wrong):
        yield


@mutant("robstride", "PROC-09")
def a_set_point_that_is_repeated_after_a_takeover():
    """A program that has lost its motor goes on with the set-point that it repeats."""
    with (
        replaced(StreamedCanHardware, "_see_ownership", lambda _: lambda hardware, event: None),
        replaced(MitHwMotor, "_is_taken", lambda _: lambda hardware: False),
    ):
        yield


@mutant("mit", "PROC-10")
def a_repeated_command_renews_the_lease():
    """A motor that is held by repeated commands keeps its lease, which nobody uses."""

    def wrong(ask):
        def asked(hardware):
            hardware.drive.physical.ownership.use(
                getattr(hardware.drive.physical.ownership.held, "owner", None)
            )
            ask(hardware)

        return asked

    with replaced(MitHwMotor, "_ask", wrong):
        yield


@mutant("cia402", "PROC-11")
def a_reader_that_does_not_wait_for_the_owner():
    """Reading fails at once if the owner, another program, has not yet set the drive up."""

    def wrong(set_up):
        return lambda shared, sdo, _timeout_s, bring_up: set_up(shared, sdo, 0.0, bring_up)

    with replaced(SharedNode, "set_up", wrong):
        yield


@mutant("leadshine", "PROC-12")
def another_program_is_asked_for_too_long():
    """A request waits for a motor of another program ten times as long as it was told to."""

    def wrong(acquire):
        def patient(lock, runtime, purpose, timeout_s=0.0, owner=None, **how):
            wait = how.pop("wait", None)

            def longer(runtime, done, time_s):
                return wait(runtime, done, 10.0 * time_s)

            how["wait"] = None if wait is None else longer
            return acquire(lock, runtime, purpose, timeout_s, owner, **how)

        return patient

    with replaced(ProcessLock, "acquire", wrong):
        yield


@mutant("moteus", "PROC-13")
def owners_are_told_to_nobody():
    """A program does not announce on the bus that it owns a motor."""
    with replaced(can_drive, "announce", lambda _: lambda ownership, bus, resource: None):
        yield


@mutant("cia402", "SYNC-20")
def each_program_has_its_own_clock():
    """Each program produces its cyclic SYNC, whether or not another one does."""

    def wrong(make):
        return lambda shared, name, where: make(shared, name, None)

    with replaced(SharedBus, "__init__", wrong):
        yield


@mutant("dryve", "PROC-14")
def a_stop_needs_the_lock_between_programs():
    """A stop is obeyed only if no other program has the motor."""

    def wrong(bring):
        def brought(motor, operation, stop):
            with motor.physical.ownership.owned(motor, f"{operation}() of {motor.name}"):
                bring(motor, operation, stop)

        return lambda motor, *how: (bring if motor.physical.ownership.lock is None else brought)(
            motor, *how
        )

    with replaced(LogicalMotor, "bring_to_rest", wrong):
        yield


@mutant("leadshine", "SYNC-22")
def a_member_that_was_taken_over_is_no_failure():
    """The others of a group go on when another program has taken one member over."""

    def wrong(fail):
        def failed(motion, motor, error):
            return error if isinstance(error, MotionInterrupted) else fail(motion, motor, error)

        return failed

    with replaced(CommonMotion, "failed", wrong), replaced(CommonMotion, "_fail", wrong):
        yield


@mutant("cia402", "SYNC-23")
def set_points_of_the_dead_are_left():
    """Set-points that a program has armed before its death wait for the SYNC of another one."""
    with replaced(BusSync, "_clear", lambda _: lambda sync, own: None):
        yield


@mutant("cia402", "PROC-16")
def downloads_are_not_fenced():
    """Settings are written although another program has taken the motor over."""
    with replaced(ChannelClient, "_commands", lambda _: lambda client, service: False):
        yield


@mutant("leadshine", "PROC-17")
def a_line_is_free_at_once_after_a_death():
    """A request is sent on a line where the answer to a program that has died is to come."""

    def wrong(take):
        def taken(line):
            is_ours = take(line)
            line._left_ns = 0
            return is_ours

        return taken

    with replaced(ExchangeLine, "_take_lock", wrong):
        yield


@mutant("cia402", "SHARE-16")
def a_stop_that_a_start_does_not_notice():
    """A start goes on although another user has stopped the motor since it began."""
    with replaced(execution, "_check_not_interrupted", lambda _: lambda motors, seen: None):
        yield
