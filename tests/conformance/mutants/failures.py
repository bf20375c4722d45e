"""Mistakes with faults, lost answers and silent drives."""

from unittest.mock import patch

from motorhil.motorapi.adaptations.canopen.node import CanopenNode
from motorhil.motorapi.adaptations.leadshine import hardware as leadshine_hardware
from motorhil.motorapi.adaptations.leadshine.hardware import LeadshineHwMotor
from motorhil.motorapi.adaptations.modbus.client import ModbusLine
from motorhil.motorapi.adaptations.modbus.unit import ModbusUnit
from motorhil.motorapi.api.polled_motor import PolledMotor
from motorhil.motorapi.errors import DeadlineExceeded, DeviceFault, LinkError, MotorError
from motorhil.motorapi.ownership.physical_motor import PhysicalMotor, RunStatus
from tests.conformance.mutants import mutant, replaced


@mutant("leadshine", "FAULT-01")
def a_fault_ends_a_motion_as_any_other_end():
    """A drive with a fault does not move, so its motion counts as done."""

    def wrong(is_done):
        def done(self):
            poll = self.hardware.progress.poll
            return True if poll is not None and poll.fault is not None else is_done(self)

        return done

    with replaced(PolledMotor, "_is_done", wrong):
        yield


@mutant("leadshine", "FAULT-01")
def a_fault_without_its_code():
    """A wait reports a fault without its code."""

    def blind(raise_fault):
        def told(self, poll):
            if poll.fault is not None:
                raise DeviceFault(motor=self.name, code=0, text="a fault", since_ns=poll.time_ns)

        return told

    with replaced(PolledMotor, "_raise_fault", blind):
        yield


@mutant("leadshine", "FAULT-02")
def bringing_up_resets_faults():
    """Every command resets a fault without reporting it."""

    def eager(connect):
        def connected(self):
            connect(self)
            if self._poll().fault is not None:
                self.hardware.reset_fault()

        return connected

    with replaced(PolledMotor, "_connect", eager):
        yield


@mutant("leadshine", "FAULT-03")
def a_reset_switches_on():
    """reset_fault() restores the state before the fault: enabled."""

    def eager(reset):
        def done(self):
            reset(self)
            self.runtime.wait_until(lambda: False, 0.05)
            self.enable()

        return done

    with replaced(LeadshineHwMotor, "reset_fault", eager):
        yield


@mutant("leadshine", "FAULT-04")
def a_fault_is_told_from_memory():
    """The reported fault is that of the last wait."""

    def forgetful(read_fault):
        def told(self):
            return None if self.hardware.progress.ended_ns is not None else read_fault(self)

        return told

    with replaced(PolledMotor, "_read_fault", forgetful):
        yield


@mutant("leadshine", "FAULT-08")
def who_resets_a_fault_is_to_blame():
    """A motion whose fault is reset before a wait hears of it counts as interrupted."""

    def interrupted(_):
        return lambda self, error, now_ns: self.end(f"{error}", now_ns, RunStatus.FAILED)

    with replaced(PhysicalMotor, "fail", interrupted):
        yield


@mutant("leadshine", "HEAR-01")
def a_lost_start_is_made_again():
    """A start without an answer is repeated, relative to the position at that time."""

    def again(trigger):
        def triggered(self):
            path = self._prepared
            try:
                trigger(self)
            except MotorError:
                self.runtime.wait_until(lambda: False, 0.8)
                target = self.registers.read_i32(leadshine_hardware._DEMAND) + self.way
                words = path[0], target >> 16 & 0xFFFF, target & 0xFFFF, *path[3:]
                self.registers.write(leadshine_hardware._PATH_0, *words)

        return triggered

    def noted(prepare):
        def prepared(self, motion, model):
            prepare(self, motion, model)
            self.way = round(motion.distance * self._per_unit(model))

        return prepared

    with (
        replaced(LeadshineHwMotor, "trigger", again),
        replaced(LeadshineHwMotor, "prepare", noted),
    ):
        yield


@mutant("leadshine", "HEAR-02")
def silence_is_no_error():
    """A missing answer is replaced by the last one."""
    known = {}

    def deaf(ask):
        def asked(self, *args):
            try:
                known[(self, *args)] = ask(self, *args)
            except MotorError:
                if (self, *args) not in known:
                    raise
            return known[(self, *args)]

        return asked

    with replaced(ModbusUnit, "read", deaf), replaced(ModbusUnit, "write", deaf):
        yield


@mutant("leadshine", "HEAR-03")
def once_lost_is_lost_for_good():
    """A drive that once did not answer is not asked again."""
    heard, lost = set(), set()

    def given_up(read):
        def asked(self, *args):
            if self in lost:
                self.runtime.wait_until(lambda: False, 0.2)
                raise LinkError(link=self.label, reason="it is lost")
            try:
                found = read(self, *args)
            except MotorError:
                lost.update({self} & heard)
                raise
            heard.add(self)
            return found

        return asked

    with replaced(ModbusUnit, "read", given_up):
        yield


@mutant("leadshine", "FAULT-06")
def an_alarm_is_that_of_the_line():
    """The last alarm on a line is reported by all drives on it."""
    alarms = {}

    def wrong(fault):
        def found(self, is_set, names):
            own = fault(self, is_set, names)
            line = alarms.setdefault(id(self.runtime), {})
            line[self] = own
            return own or next((one for one in line.values() if one is not None), None)

        return found

    with replaced(LeadshineHwMotor, "_fault", wrong):
        yield


@mutant("leadshine", "HEAR-04")
def reads_are_repeated_for_long():
    """A read without an answer is repeated twenty times, whatever the deadline of the caller."""

    def wrong(read):
        def asked(self, *args):
            for _ in range(19):
                try:
                    return read(self, *args)
                except DeadlineExceeded:
                    continue
            return read(self, *args)

        return asked

    with replaced(ModbusUnit, "read", wrong):
        yield


@mutant("leadshine", "HEAR-05")
def the_next_answer_is_the_answer():
    """The next request is sent right after a timeout; the next answer of that length is its own."""
    with patch.object(ModbusLine, "QUARANTINE_NS", 0):
        yield


@mutant("cia402", "FAULT-07")
def a_fault_without_message_has_any_code():
    """A fault of which no EMCY came gets a generic code, and the drive is not asked."""
    code = property(lambda node: 0x1000 if node.error is None else node.error.code)
    with patch.object(CanopenNode, "error_code", code):
        yield
