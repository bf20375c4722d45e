"""Oracle of ownership: only the owner commands a motor.

All handovers must be known before frames can be judged (see `judge_frames`). The oracle therefore
reads the recording by itself, and only if handovers are recorded.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from motorhil.harness.oracles.base import Finding, Verdict, Violation
from motorhil.harness.sharing_tests.bus_evidence import BusFrame, commanded_node, judge_frames
from motorhil.traces.can_frame import fields
from motorhil.traces.mcap.reader import Trace
from motorhil.traces.schema import CAN_FRAME, FrameDecoder
from motorhil.traces.semantics.ownership import motor_of, read_ownership

ID: Final = "owner-commands"
PROMISE: Final = "While a motor has an owner, no other process sends a frame that commands it"
SOURCE: Final = "the paper, requirement 4 and 3.5: a motor has one owner from start to end"
NEEDS: Final = "no motor ownership (/motor/NAME/lock) or no senders of frames are recorded"
_ID_TAG: Final = b"\x0d"  # the first byte of a recorded CanFrame; its identifier follows
_ANY: Final = b"\x0f\0"  # a command in each identifier that can command
_NOT_DATA: Final = 0xE000_0000


def judge_ownership(
    trace: Trace | None,
    places: Mapping[str, tuple[str, int]],
    from_ns: int | None,
    to_ns: int | None,
) -> Finding:
    """Return the finding of `owner-commands`.

    Args:
        trace: the recording; None: a format without handovers.
        places: (bus, node) of each motor.
        from_ns: frames from this time on are judged [ns].
        to_ns: frames before this time are judged [ns].

    Raises:
        TraceError: the recording is damaged.
    """
    head = (ID, PROMISE, SOURCE)
    if trace is None or not any(motor_of(one.topic) for one in trace.channels.values()):
        return Finding(*head, Verdict.NOT_JUDGED, reason=NEEDS)
    ownership = read_ownership(trace)
    known = {motor: place for motor, place in places.items() if motor in ownership.tenures}
    if not known:
        reason = "the places of the owned motors are not known; give --rig RIG"
        return Finding(*head, Verdict.NOT_JUDGED, reason=reason)
    evidence = judge_frames(_commanding(trace, from_ns, to_ns), ownership, known)
    looked = sum(evidence.counts.values())
    broken = [
        _violation(frame, tenure.motor, known, str(tenure)) for frame, tenure in evidence.foreign
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
    """Yield the commanding frames with known senders."""
    decoders: dict[int, FrameDecoder] = {}
    for channel, time_ns, payload in trace.messages(None, from_ns, to_ns):
        if channel.schema is None or channel.schema.name != CAN_FRAME.name:
            continue
        if payload[:1] == _ID_TAG and commanded_node(payload[1] | payload[2] << 8, _ANY) is None:
            continue  # most frames: they command nothing, whatever their data
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
