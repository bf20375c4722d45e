"""Exchange log of a recorded drive with a protocol of its own, on a CAN bus or a serial line.

A request that only reads is a poll, any other frame to the drive a command. An answer belongs to
the newest request of its kind. Other frames of the drive, such as the status frames of a VESC,
belong to the command before them, and may be periodic. On a serial line a frame is a packet.

Source: as of `motorhil.traces.exchange.drive_kinds`.
"""

from typing import Final, final

from motorhil.traces.can_frame import EFF, ERR
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.exchange.drive_kinds import Decode, Read, Told
from motorhil.traces.exchange.steps import (
    START,
    ExchangeLog,
    Key,
    Role,
    Sent,
    Step,
    Turn,
    goes_on,
    period_ns,
)

_OPEN_MAX: Final = 64


def drive_key(frame: bytes, told: Told, any_set_point: bool) -> Key:
    """Return the key of a frame to a drive: its identifier and content.

    Args:
        frame: a can_frame or canfd_frame.
        told: what it means.
        any_set_point: True to ignore the content of motions.
    """
    identifier = int.from_bytes(frame[:4], "little")
    data = b"" if any_set_point and told.moves else frame[8 : 8 + frame[4]]
    if any_set_point and told.moves and identifier & EFF:
        identifier &= ~0xFFFF00  # RobStride has the torque there
    return ("drive", identifier, data)


def packet_key(message: BusMessage, told: Told, any_set_point: bool) -> Key:
    """Return the key of a packet to a drive on a serial line: instruction, items, their values.

    A packet to several drives is thus compared in what concerns this one.

    Args:
        message: the packet's content.
        told: what it means.
        any_set_point: True to ignore the values of motions.
    """
    items = ", ".join(one.name for one in message.signals)
    is_any = any_set_point and told.moves
    values = b"" if is_any else repr([one.value for one in message.signals]).encode()
    return (f"{message.name}: {items}", 0, values)


def role_of(told: Told) -> Role:
    """Return POLL for a request that only reads, else COMMAND."""
    return Role.POLL if told.reads else Role.COMMAND


@final
class DriveExchanges:
    """The exchange log of one drive, from the frames of its bus or the packets of its line.

    Attributes:
        log: the log so far.
        name: the drive's, which is that of a sender.
        has_sent: True if the drive has sent anything.
    """

    def __init__(
        self,
        place: tuple[str, int],
        name: str,
        readers: tuple[Decode, Read],
        begin_ns: int,
        any_set_point: bool = False,
    ) -> None:
        """Start before the first frame.

        Args:
            place: bus and node.
            name: as the attribute.
            readers: as of `readers_of`.
            begin_ns: when the recording begins [ns].
            any_set_point: True to ignore the content of motions.
        """
        bus, node = place
        self.name: Final = name
        self._decode, self._read = readers
        self._any_set_point = any_set_point
        self.log: Final = ExchangeLog(bus, node)
        self._command = Step(Role.COMMAND, START, begin_ns, "the recording begins")
        self.log.steps.append(self._command)
        self.has_sent: bool = False
        self._open: dict[str, list[Step]] = {}
        self._times_ns: dict[int, list[int]] = {}

    def take(self, time_ns: int, frame: bytes, sender: str) -> bool:
        """Take a frame that was complete at `time_ns`; return True if it concerns the drive."""
        if int.from_bytes(frame[:4], "little") & ERR:
            return False
        message = self._decode(frame)
        if message is None:
            return self._part(time_ns, frame, sender)
        told = self._read(frame, message)
        if told.is_own:
            self._answered(time_ns, frame, message, told)
        else:
            key = drive_key(frame, told, self._any_set_point)
            self._asked(time_ns, frame, key, message, told)
        return True

    def take_packet(self, start_ns: int, end_ns: int, packet: bytes, sender: str) -> None:
        """Take a packet of a serial line, or what the drive has sent without a pause."""
        message = self._decode(packet)
        if message is None:
            self._part(end_ns, packet, sender, end_ns - start_ns)
            return
        told = self._read(packet, message)
        if told.is_own:
            self._answered(end_ns, packet, message, told, end_ns - start_ns)
        elif not message.problem:  # a broken packet has no effect
            key = packet_key(message, told, self._any_set_point)
            self._asked(end_ns, packet, key, message, told)

    def finished(self) -> ExchangeLog:
        """Return the log, with the periods of frames that the drive sends by itself."""
        for identifier, times in self._times_ns.items():
            found = period_ns(times)
            if found is not None:
                self.log.periods_ns[identifier] = found
        for step in self.log.steps:
            step.reactions = [self._marked(step, one) for one in step.reactions]
        return self.log

    def _asked(self, time_ns: int, frame: bytes, key: Key, message: BusMessage, told: Told) -> None:
        step = Step(role_of(told), key, time_ns, str(message), [Turn(frame)])
        self.log.steps.append(step)
        if step.role is Role.COMMAND:
            self._command = step
        asked = told.asks or told.may_ask
        if asked:
            waiting = self._open.setdefault(asked, [])
            waiting.append(step)
            del waiting[:-_OPEN_MAX]

    def _answered(
        self, time_ns: int, frame: bytes, message: BusMessage, told: Told, duration_ns: int = 0
    ) -> None:
        waiting = self._open.get(told.answers) if told.answers else None
        step = waiting.pop() if waiting else None
        if step is not None:
            step.answer_text = str(message)
        self._sent(time_ns, frame, step, duration_ns)

    def _part(self, time_ns: int, frame: bytes, sender: str, duration_ns: int = 0) -> bool:
        """Add a frame of the drive without a meaning of its own to the newest open request.

        Return True if it is the drive's.
        """
        if not sender or sender != self.name:
            return False
        waiting = [steps[-1] for steps in self._open.values() if steps]
        self._sent(time_ns, frame, max(waiting, key=_time_of, default=None), duration_ns)
        return True

    def _sent(self, time_ns: int, frame: bytes, step: Step | None, duration_ns: int) -> None:
        """Add a frame of the drive to the request that it answers, else to the last command."""
        self.has_sent = True
        if step is not None:
            sent = Sent(time_ns - step.time_ns, frame, duration_ns)
            step.turns[0].answers.append(sent)
            return
        self._command.reactions.append(Sent(time_ns - self._command.time_ns, frame, duration_ns))
        if not duration_ns:  # a frame of a bus, where some are periodic
            identifier = int.from_bytes(frame[:4], "little")
            self._times_ns.setdefault(identifier, []).append(time_ns)

    def _marked(self, step: Step, one: Sent) -> Sent:
        """Return a frame, marked if the next of its kind followed a period later."""
        identifier = int.from_bytes(one.data[:4], "little")
        period = self.log.periods_ns.get(identifier)
        if period is None:
            return one
        times, now_ns = self._times_ns[identifier], step.time_ns + one.delay_ns
        return one._replace(goes_on=goes_on(times, now_ns, period))


def _time_of(step: Step) -> int:
    return step.time_ns
