"""Mistakes that show only with other programs on the bus, large loads, or a bus that is off."""

from motorhil.motorapi.adaptations.canopen.sdo import ChannelClient
from motorhil.motorapi.adaptations.canopen.sync import BusSync
from motorhil.motorapi.adaptations.host_servo.servo import Servo
from motorhil.motorapi.adaptations.modbus.polled_motor import PolledMotor
from tests.conformance.mutants import mutant, replaced


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
