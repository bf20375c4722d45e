"""Response times of periodic messages: recorded, by theory, and allowed.

The delay of a frame is not recorded, but later frames prove a part of it (see `measured`). The
recorded response time is that part plus the duration of the shortest frame. The theory's bound uses
the recorded periods and jitter, without errors. All times extend to the end of the intermission, as
in the theory.
"""

from typing import Final

from motorhil.harness.analysis.measured import Measured
from motorhil.harness.report.collect import Findings
from motorhil.motorapi.synchronization.can_response_time import Arrival, Response, response_times

Json = dict[str, object]
MESSAGES_MAX: Final = 500
"""Limit of analysed messages on one bus; more would take minutes."""


def responses_of(found: Findings) -> list[Json]:
    """Return the response times of every CAN bus with periodic messages, or a reason for none."""
    if found.in_order:
        return []
    return [told for name in sorted(found.buses) if (told := _bus(found, name)) is not None]


def _bus(found: Findings, name: str) -> Json | None:
    bus = found.buses[name]
    subject = bus.subject(found.rig.by_priority.get(name, frozenset()))
    if subject is None:
        return _told(name, why=bus.traffic.why_no_capacity)
    load = subject.load
    periodic = {
        one.message.rank: one for one in subject.recorded if one.message.arrival is Arrival.PERIODIC
    }
    if not periodic:
        return None
    if len(load.messages) > MESSAGES_MAX:
        return _told(
            name, why=f"it has {len(load.messages)} messages; at most {MESSAGES_MAX} are analysed"
        )
    rates = load.bitrate_bit_s, load.data_bitrate_bit_s
    messages = [
        _message(one, periodic[one.message.rank], rates)
        for one in response_times(load)
        if one.message.rank in periodic
    ]
    sporadic = len(load.messages) - len(periodic)
    used = f"utilisation at most {load.utilisation():.1%}"
    others = f"; including {sporadic} sporadic messages" if sporadic else ""
    about = f"{_rate(*rates)}, {used}{others}"
    return _told(name, about=about, messages=messages, notes=list(subject.notes))


def _told(
    name: str,
    about: str = "",
    why: str = "",
    messages: list[Json] | None = None,
    notes: list[str] | None = None,
) -> Json:
    return {
        "bus": name,
        "about": about,
        "why": why,
        "messages": messages or [],
        "notes": notes or [],
    }


def _message(one: Response, seen: Measured, rates: tuple[int, int | None]) -> Json:
    message = one.message
    frame_ns = (seen.shortest or message.shortest).time_ns(*rates)
    return {
        "label": message.label,
        "name": message.name,
        "sender": message.sender,
        "bytes": f"{message.length} FD" if message.fd else str(message.length),
        "frames": seen.frames,
        "period_s": message.period_ns / 1e9,
        "least_s": frame_ns / 1e9,
        "usual_s": (frame_ns + seen.usual_late_ns) / 1e9,
        "most_s": (frame_ns + message.jitter_ns) / 1e9,
        "bound_s": None if one.response_ns is None else one.response_ns / 1e9,
        "deadline_s": None if message.deadline_ns is None else message.deadline_ns / 1e9,
    }


def _rate(rate: int, data_rate: int | None) -> str:
    return f"{rate} bit/s" if data_rate is None else f"{rate} bit/s, data {data_rate} bit/s"
