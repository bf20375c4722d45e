"""Nobody commands a motor that is another's: `harness.sharing.evidence`, as an oracle.

It needs to know all handovers before it can say whose a motor was, so it goes over the recording by
itself, and only where handovers were told.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from harness.oracles.finding import Finding, Verdict, Violation
from harness.ownership_record import motor_of, read_ownership
from harness.sharing.evidence import BusFrame, commanded_node, judge_frames
from traces.frame_decoder import FrameDecoder
from traces.reader import Trace
from traces.schema import CAN_FRAME
from traces.traffic import fields

ID: Final = "owner-commands"
PROMISE: Final = "While a motor is somebody's, nobody else sends a frame that commands it"
SOURCE: Final = "the paper, requirement 4 and 3.5: a motor is one owner's from start to end"
NEEDS: Final = "nothing is told of who had which motor (/motor/NAME/lock), or of who sent frames"
_ID_TAG: Final = b"\x0d"  # what a CanFrame of ours begins with; its identifier is next
_ANY: Final = b"\x0f\0"  # commands something in each identifier that can command
_NOT_DATA: Final = 0xE000_0000


def judge_ownership(
    trace: Trace | None,
    places: Mapping[str, tuple[str, int]],
    from_ns: int | None,
    to_ns: int | None,
) -> Finding:
    """The finding of `owner-commands`.

    Args:
        trace: the recording; None: of a format that tells no handovers.
        places: (bus, node) of each motor.
        from_ns: frames from then on are judged.
        to_ns: frames before that.

    Raises:
        TraceError: the recording is damaged.
    """
    head = (ID, PROMISE, SOURCE)
    if trace is None or not any(motor_of(one.topic) for one in trace.channels.values()):
        return Finding(*head, Verdict.NOT_JUDGED, reason=NEEDS)
    ownership = read_ownership(trace)
    told = {motor: place for motor, place in places.items() if motor in ownership.tenures}
    if not told:
        reason = "where the motors are whose owners are told is not: give --rig RIG"
        return Finding(*head, Verdict.NOT_JUDGED, reason=reason)
    evidence = judge_frames(_commanding(trace, from_ns, to_ns), ownership, told)
    looked = sum(evidence.counts.values())
    broken = [
        _violation(frame, tenure.motor, told, str(tenure)) for frame, tenure in evidence.foreign
    ]
    if ownership.contradictions:
        text = ownership.contradictions[0]
        broken.append(Violation(ownership.events[0].time_ns, text))
        broken += broken[-1:] * (len(ownership.contradictions) - 1)
    if broken:
        return Finding(*head, Verdict.BROKEN, looked, broken[0], len(broken) - 1)
    if not looked:
        return Finding(
            *head, Verdict.NOT_JUDGED, reason=f"no commanding frame has a sender; {NEEDS}"
        )
    return Finding(*head, Verdict.HELD, looked)


def _violation(
    frame: BusFrame, motor: str, places: Mapping[str, tuple[str, int]], tenure: str
) -> Violation:
    bus, node = places[motor]
    text = f"{frame.sender} sends {frame.can_id:03X}h {frame.data.hex(' ')} while {tenure}"
    return Violation(frame.time_ns, text, bus, node, 1, motor)


def _commanding(trace: Trace, from_ns: int | None, to_ns: int | None) -> Iterator[BusFrame]:
    """Frames that command something and of which it is known who sent them."""
    decoders: dict[int, FrameDecoder] = {}
    for channel, time_ns, payload in trace.messages(None, from_ns, to_ns):
        if channel.schema is None or channel.schema.name != CAN_FRAME.name:
            continue
        if payload[:1] == _ID_TAG and commanded_node(payload[1] | payload[2] << 8, _ANY) is None:
            continue  # most are: whatever they say, it commands nothing
        decoder = decoders.get(channel.number)
        if decoder is None:
            decoder = decoders[channel.number] = FrameDecoder()
        try:
            frame, _, sender = decoder.decode(payload)
        except ValueError:
            continue
        can_id, _, _, data, is_fd = fields(frame)
        if not sender or is_fd or can_id & _NOT_DATA or commanded_node(can_id, data) is None:
            continue
        yield BusFrame(channel.topic.removeprefix("/can/"), time_ns, sender, can_id, data)
