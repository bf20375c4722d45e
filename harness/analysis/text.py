"""Findings of a bus analysis in words and as JSON."""

from collections.abc import Sequence
from typing import Final

from motorhil.harness.analysis.advice import ERRORS_MAX, Tolerance
from motorhil.harness.analysis.subject import Findings, Subject, Sync
from motorhil.motorapi.synchronization.can_response_time import Arrival, Message, Response

WORDS: Final = (0, 1, 2, 8)
_MS: Final = 1e-6  # ms per ns
_ALONE: Final = "its jitter and its own frame take longer than its deadline, whatever else is sent"


def rows_of(found: Findings, bit_error_rate: float | None) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of the table of one bus; `WORDS` are its columns of words."""
    stands = {one.message.rank: one for one in found.tolerances}
    head = ["message", "what", "sender", "bytes", "period ms", "jitter ms", "deadline ms"]
    head += ["response ms", "in time", "errors stood"]
    if bit_error_rate is not None:
        head.append(f"late, bit errors {bit_error_rate:g}")
    rows = []
    for one in found.responses:
        message = one.message
        stood = stands.get(message.rank)
        row = [message.label, _what(message), message.sender, _bytes(message), _period(message)]
        row += [_jitter(message), _ms(message.deadline_ns), _ms(one.response_ns)]
        row += [_verdict(one), _stood(stood)]
        if bit_error_rate is not None:
            row.append("-" if stood is None else f"{stood.late_probability(bit_error_rate):.1e}")
        rows.append(row)
    return head, rows


def remarks_of(found: Findings) -> list[str]:
    """Return the lines below the table: advice, the clock of SYNC, and notes."""
    lines = _advice(found)
    sync = found.subject.sync
    if sync is not None:
        lines.append(f"{found.subject.load.name}: {_sync(sync)}")
    return lines + notes_of(found.subject)


def notes_of(subject: Subject) -> list[str]:
    """Return the notes that readers of the results must know."""
    name = subject.load.name
    lines = [] if subject.load.messages else [f"{name}: no known messages"]
    return lines + [f"{name}: {note}" for note in subject.notes]


def head_of(found: Findings) -> list[str]:
    """Return the lines above the table: bit rate, utilisation, assumed errors."""
    load, subject = found.subject.load, found.subject
    rate = f"{load.bitrate_bit_s} bit/s"
    if load.data_bitrate_bit_s is not None:
        rate += f", data {load.data_bitrate_bit_s} bit/s"
    used = f"{load.utilisation():.1%} of it used at most, {load.utilisation_unstuffed():.1%}"
    measured = "" if subject.measured is None else f", {subject.measured:.1%} when recorded"
    lines = [f"{load.name}: {rate}, {used} without stuff bits{measured}"]
    errors = found.errors
    if errors.burst or errors.interval_ns is not None:
        every = "" if errors.interval_ns is None else f", then every {_ms(errors.interval_ns)} ms"
        lines.append(f"{load.name}: errors: {errors.burst} at once{every}")
    return lines


def _advice(found: Findings) -> list[str]:
    name = found.subject.load.name
    lines = []
    remedy = found.remedy
    if found.late:
        lines.append(f"{name}: may be late: {', '.join(one.message.label for one in found.late)}")
        lines += [f"{name}: {one.message.label}: {_ALONE}" for one in found.late if _is_alone(one)]
    if remedy is not None:
        proposal = remedy.proposal
        if proposal.changes:
            moves = ", ".join(f"{one.message.label} to {one.label}" for one in proposal.changes)
            lines.append(f"{name}: all are in time with other identifiers: {moves}")
        else:
            lines.append(f"{name}: {proposal.reason}")
        if remedy.queues is not None:
            lines.append(
                f"{name}: all are in time if the most urgent frame goes first in the queue of"
                f" {', '.join(remedy.queues)}"
            )
        rate = remedy.rate_bit_s
        helps = "no usual bit rate helps" if rate is None else f"all are in time at {rate} bit/s"
        lines.append(f"{name}: {helps}")
    if found.tolerances and all(one.errors is not None for one in found.tolerances):
        burst = max(1, found.errors.burst)
        if found.interval_ns is None:
            at_once = "an error" if burst == 1 else f"{burst} errors at once"
            lines.append(f"{name}: {at_once} can make a message late")
        else:
            first = "" if burst == 1 else f"after {burst} errors at once, "
            apart = f"errors {_ms(found.interval_ns)} ms apart or more make no message late"
            lines.append(f"{name}: {first}{apart}")
    return lines


def _is_alone(one: Response) -> bool:
    jitter_ns = one.message.jitter_ns if one.message.arrival is Arrival.PERIODIC else 0
    return one.takes_ns + jitter_ns > (one.message.deadline_ns or 0)


def _sync(sync: Sync) -> str:
    clock = sync.clock
    moved = "" if sync.label == "080h" else f" {sync.label}"
    text = f"SYNC{moved} every {clock.period_ns * _MS:.6f} ms"
    nominal_ns, error_ppm = clock.nominal_ns, clock.error_ppm
    if nominal_ns is not None and error_ppm is not None:
        whence = "from 1006h" if clock.is_told else "the nearest round period"
        off_ppm = round(error_ppm, 1) + 0.0  # avoids -0.0
        text += f", its clock {off_ppm:+.1f} ppm off {nominal_ns * _MS:g} ms ({whence})"
    jitter = f"jitter {clock.peak_to_peak_ns / 1e3:.3f} us peak to peak"
    return f"{text}; {jitter}, {clock.deviation_ns / 1e3:.3f} us standard deviation"


def sync_drifts(found: Sequence[Findings]) -> list[dict[str, object]]:
    """Return the clock drift of each bus's SYNC against the first bus's SYNC, for JSON."""
    timed = [(one.subject.load.name, one.subject.sync) for one in found]
    known = [(name, sync.clock) for name, sync in timed if sync is not None]
    return [
        {"bus": name, "from": known[0][0], "drift_ppm": drift_ppm}
        for name, sync in known[1:]
        if (drift_ppm := sync.drift_ppm(known[0][1])) is not None
    ]


def _stood(stood: Tolerance | None) -> str:
    if stood is None or stood.errors is None:
        return "-"
    return f"{stood.errors}+" if stood.errors == ERRORS_MAX else str(stood.errors)


def _what(message: Message) -> str:
    return message.name or message.source


def _bytes(message: Message) -> str:
    return f"{message.length} FD" if message.fd else str(message.length)


def _period(message: Message) -> str:
    if message.arrival is Arrival.PERIODIC:
        return _ms(message.period_ns)
    return f"> {_ms(message.distance_ns or message.period_ns)}"


def _jitter(message: Message) -> str:
    """Return the jitter as text; "-" for a burst, which its minimum distance describes."""
    is_burst = message.arrival is Arrival.SPORADIC and message.distance_ns
    return "-" if is_burst else _ms(message.jitter_ns)


def _verdict(one: Response) -> str:
    return {None: "-", True: "yes", False: "NO"}[one.is_in_time]


def _ms(time_ns: int | None) -> str:
    return "-" if time_ns is None else f"{time_ns * _MS:.3f}"


def as_table(found: Findings, bit_error_rate: float | None) -> dict[str, object]:
    """Return the findings of one bus for JSON; analyse.schema.json describes every key."""
    load, subject, remedy = found.subject.load, found.subject, found.remedy
    stands = {one.message.rank: one for one in found.tolerances}
    counted = {one.message.rank: one.frames for one in subject.recorded}
    messages: list[dict[str, object]] = []
    for one in found.responses:
        stood = stands.get(one.message.rank)
        row = _message(one)
        row["frames"] = counted.get(one.message.rank)
        row["errors_stood"] = None if stood is None else stood.errors
        if bit_error_rate is not None:
            row["late_probability"] = (
                None if stood is None else stood.late_probability(bit_error_rate)
            )
        messages.append(row)
    table: dict[str, object] = {
        "name": load.name,
        "bitrate_bit_s": load.bitrate_bit_s,
        "data_bitrate_bit_s": load.data_bitrate_bit_s,
        "utilisation": load.utilisation(),
        "utilisation_unstuffed": load.utilisation_unstuffed(),
        "utilisation_recorded": subject.measured,
        "fifo": sorted(load.fifo),
        "errors": {"burst": found.errors.burst, "interval_s": _s(found.errors.interval_ns)},
        "messages": messages,
        "late": [one.message.label for one in found.late],
        "shortest_error_interval_s": _s(found.interval_ns),
        "remedy": None,
        "sync": None if subject.sync is None else _clock(subject.sync),
        "notes": list(subject.notes),
    }
    if remedy is not None:
        changes = remedy.proposal.changes
        table["remedy"] = {
            "identifiers": None
            if changes is None
            else [{"from": one.message.label, "to": one.label} for one in changes],
            "is_impossible": remedy.proposal.is_impossible,
            "reason": remedy.proposal.reason,
            "queues": None if remedy.queues is None else list(remedy.queues),
            "bitrate_bit_s": remedy.rate_bit_s,
        }
    return table


def _clock(sync: Sync) -> dict[str, object]:
    clock = sync.clock
    nominal_ns = clock.nominal_ns
    return {
        "label": sync.label,
        "period_s": clock.period_ns / 1e9,
        "peak_to_peak_s": clock.peak_to_peak_ns / 1e9,
        "deviation_s": clock.deviation_ns / 1e9,
        "nominal_s": None if nominal_ns is None else nominal_ns / 1e9,
        "nominal_is_told": clock.is_told,
        "error_ppm": clock.error_ppm,
    }


def _message(one: Response) -> dict[str, object]:
    message = one.message
    return {
        "identifier": message.identifier,
        "extended": message.extended,
        "label": message.label,
        "name": message.name,
        "source": message.source,
        "sender": message.sender,
        "length": message.length,
        "fd": message.fd,
        "bit_rate_switch": message.switched,
        "arrival": message.arrival.value,
        "period_s": _s(message.period_ns),
        "jitter_s": _s(message.jitter_ns),
        "irregular_s": _s(message.irregular_ns),
        "distance_s": _s(message.distance_ns),
        "deadline_s": _s(message.deadline_ns),
        "takes_s": _s(one.takes_ns),
        "response_s": _s(one.response_ns),
        "received_s": _s(one.received_ns),
        "blocking_s": _s(one.blocking_ns),
        "busy_s": _s(one.busy_ns),
        "instance": one.instance,
        "in_time": one.is_in_time,
    }


def _s(time_ns: int | None) -> float | None:
    return None if time_ns is None else time_ns / 1e9
