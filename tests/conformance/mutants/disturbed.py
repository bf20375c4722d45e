"""Mistakes that show only with bus errors, other programs on the bus, or large loads."""

from motorhil.motorapi.adaptations.canopen.emcy import error_text
from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.canopen.sdo import ChannelClient
from motorhil.motorapi.adaptations.canopen.sync import BusSync
from motorhil.motorapi.adaptations.cia402.measurements import DriveReader
from motorhil.motorapi.adaptations.host_servo.servo import Servo
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.runtime.can_link import CanLink, Transmissions
from motorhil.motorapi.runtime.can_sources import BusCondition, BusStatus
from motorhil.motorapi.state import Fault, MotorState
from tests.conformance.mutants import mutant, replaced


@mutant("cia402", "BUS-01")
def error_messages_are_of_no_interest():
    """Error messages of the CAN controller are ignored: a wait continues for the drive."""
    with replaced(BusStatus, "hear", lambda _: lambda status, message, time_ns: None):
        yield


@mutant("cia402", "BUS-01")
def once_off_always_off():
    """Bus-off is recorded, but its end is not."""

    def wrong(hear):
        def heard(status, message, time_ns):
            if not status.is_off:
                hear(status, message, time_ns)

        return heard

    with replaced(BusStatus, "hear", wrong):
        yield


@mutant("cia402", "BUS-04")
def what_was_lost_with_the_bus_is_still_awaited():
    """An own frame confirms the oldest equal one, though bus-off has discarded that one."""
    with replaced(Transmissions, "forget", lambda _: lambda transmissions: None):
        yield


@mutant("software", "BUS-01")
def a_failure_is_for_ever():
    """A failure of the bus is reported again after a later stop."""
    from motorhil.motorapi.adaptations.host_servo.motor import SoftwareMotor

    def wrong(slow_down):
        def slowed(motor, deceleration, *, quickly=False):
            axis = motor._hardware.axis
            failure = axis.failure
            slow_down(motor, deceleration, quickly=quickly)
            if not axis.is_powered:
                axis.failure = failure

        return slowed

    with replaced(SoftwareMotor, "_slow_down", wrong):
        yield


@mutant("cia402", "BUS-02")
def whatever_comes_is_the_answer():
    """An SDO response counts as the answer to the next request, even if it came twice."""

    def believing(_heard):
        return lambda client, frame, time_ns: client._answers.append(frame[8:16])

    def keeping(send_request):
        def sent(client, request):
            kept = list(client._answers)
            send_request(client, request)
            client._answers.extendleft(reversed(kept))

        return sent

    with (
        replaced(ChannelClient, "heard", believing),
        replaced(ChannelClient, "send_request", keeping),
    ):
        yield


@mutant("cia402", "BUS-03")
def passive_is_off():
    """An error passive CAN controller counts as bus-off."""

    def wrong(hear):
        def heard(status, message, time_ns):
            hear(status, message, time_ns)
            status.is_off = status.condition in (BusCondition.PASSIVE, BusCondition.OFF)

        return heard

    with replaced(BusStatus, "hear", wrong):
        yield


@mutant("cia402", "BUS-03")
def every_emcy_is_a_fault():
    """A drive that has sent an EMCY is reported with a fault, whatever its statusword."""

    def wrong(fault):
        def told(reader):
            error = reader._node.error
            if error is None:
                return fault(reader)
            return Fault(error.code, error_text(error.code), error.time_ns)

        return told

    with replaced(DriveReader, "fault", wrong):
        yield


@mutant("cia402", "BUS-03")
def any_error_message_is_the_end():
    """After any error message of the CAN controller, the motor counts as lost until set up."""

    def wrong(on_error):
        def heard(link, message, time_ns):
            on_error(link, message, time_ns)
            link.had_errors = True

        return heard

    def offline(state):
        def told(reader):
            is_lost = getattr(reader._node.link, "had_errors", False)
            return MotorState.OFFLINE if is_lost else state(reader)

        return told

    with (
        replaced(CanLink, "_on_error", wrong),
        replaced(DriveReader, "fresh_state", offline),
    ):
        yield


@mutant("cia402", "CLOCK-01")
def nobody_else_sends_sync():
    """SYNC is produced without looking for another producer."""
    with replaced(BusSync, "find_cyclic", lambda _: lambda sync: None):
        yield


@mutant("cia402", "CLOCK-02")
def two_clocks_are_as_good_as_one():
    """A SYNC of another producer beside our own is ignored."""
    with replaced(BusSync, "_stray", lambda _: lambda sync, time_ns: None):
        yield


@mutant("software", "CLOCK-02")
def a_clock_that_ends_will_come_back():
    """The end of the SYNC of another program is not noticed."""
    with replaced(BusSync, "_overdue", lambda _: lambda sync: None):
        yield


@mutant("leadshine", "OTHER-01")
def a_stopped_drive_will_go_on():
    """A drive that rests short of its target is awaited for ever."""
    with replaced(PolledMotor, "_refuse_interrupted", lambda _: lambda motor, poll: None):
        yield


@mutant("software", "OVER-01")
def the_following_error_is_only_told():
    """A following error never ends a motion, however large it is."""
    with replaced(Servo, "_judge_following", lambda _: lambda servo, course, error: None):
        yield


@mutant("cia402", "BUS-05")
def an_answer_may_come_through_a_dead_bus():
    """In bus-off, the answer to a request is awaited up to the usual timeout."""

    def wrong(_is_over):
        return lambda client: bool(client._answers) or client.booted

    with replaced(ChannelClient, "_is_over", wrong):
        yield


@mutant("software", "BUS-06")
def node_that_was_never_seen_operational_is_up():
    """A node that leaves OPERATIONAL before its first heartbeat there counts as started."""

    def wrong(hear):
        def heard(node, frame, time_ns):
            node._has_shown_state = False
            hear(node, frame, time_ns)

        return heard

    with replaced(CanopenNode, "_on_heartbeat", wrong):
        yield
