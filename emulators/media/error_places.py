"""Placement of an injected error in a frame."""

from typing import Final

from emulators.media.can_bits import INTERMISSION_BITS
from emulators.media.can_episode import ALL_PORTS, Disturbance, Effect
from emulators.media.can_wire import DOMINANT, WireFrame, wire_frame
from emulators.media.error_message import ACK_SLOT, CRC_DELIMITER, DATA, DLC
from emulators.media.fault_rule import FaultRule, FrameError

STUFF_RUN: Final = 5


def has_bit(frame: bytes, bit: int) -> bool:
    """Return whether the frame, or the intermission behind it, has a bit of this number."""
    return bit < len(wire_frame(frame).levels) + INTERMISSION_BITS


def struck(rule: FaultRule, frame: bytes, sender: int, ports: int) -> Disturbance | None:
    """Return the disturbance for an ERROR rule, or None if the frame has no place for it.

    Args:
        rule: the ERROR rule.
        frame: as it is sent.
        sender: its port.
        ports: mask of the ports that see it; ALL_PORTS: all that can detect it.
    """
    if rule.bit is not None:
        return Disturbance(rule.bit, ports=ports)
    wire = wire_frame(frame)
    receivers = ports if ports != ALL_PORTS else ~(1 << sender)
    match rule.error:
        case FrameError.BIT:
            return Disturbance(wire.places.index(DLC), ports=ports)
        case FrameError.STUFF:
            first = wire.places.index(DLC)
            return Disturbance(first, Effect.DOMINANT, STUFF_RUN + 1, receivers)
        case FrameError.FORM:
            return Disturbance(wire.places.index(CRC_DELIMITER), Effect.DOMINANT, 1, ports)
        case FrameError.ACK:
            return Disturbance(wire.places.index(ACK_SLOT), Effect.RECESSIVE, 1, 1 << sender)
        case FrameError.LAST:
            last = len(wire.levels) - 1
            if ports == ALL_PORTS:
                return Disturbance(last, Effect.DOMINANT, 1, 1 << sender)
            return Disturbance(last - 1, Effect.DOMINANT, 1, ports & ~(1 << sender))
        case _:
            place = _unnoticed_until_crc(wire)
            return None if place is None else Disturbance(place, ports=receivers)


def _unnoticed_until_crc(wire: WireFrame) -> int | None:
    """Return the last bit up to the CRC whose inversion leaves all stuff bits in place.

    In CAN FD the stuff bits of the CRC are fixed, and none is behind its last bit (ISO
    11898-1:2015).
    """
    end = wire.places.index(CRC_DELIMITER)
    if wire.is_fd:
        return end - 1
    data = [place for place, where in enumerate(wire.places) if where == DATA]
    for place in range(end - 1, data[0] if data else wire.places.index(DLC) + 4, -1):
        levels = bytearray(wire.levels[:end])
        levels[place] ^= 1
        if not wire.stuffed[place] and _stuff_bits(bytes(levels)) == list(wire.stuffed[:end]):
            return place
    return None


def _stuff_bits(levels: bytes) -> list[int]:
    """Return 1 for each level that a receiver takes for a stuff bit; empty after a stuff error."""
    stuffed: list[int] = []
    run, last, due = 0, 1 - DOMINANT, False
    for level in levels:
        if due and level == last:
            return []
        stuffed.append(1 if due else 0)
        run = 1 if due or level != last else run + 1
        last = level
        due = run == STUFF_RUN
    return stuffed
