"""The verb `analyse`: worst-case response times of CAN messages."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from motorhil.harness.analysis.advice import at_rate
from motorhil.harness.analysis.subject import Findings, Subject, analyse
from motorhil.harness.analysis.text import (
    WORDS,
    as_table,
    head_of,
    notes_of,
    remarks_of,
    rows_of,
    sync_drifts,
)
from motorhil.harness.cli.main import FAILED, NOT_JUDGED, PASSED
from motorhil.harness.cli.options import add_max_memory, identifier, print_table, real, whole
from motorhil.harness.cli.report import add_bit_rates
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi.synchronization.can_response_time import ErrorModel, Message

_TIME_MAX_S = 1e6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `analyse`."""
    parser.add_argument(
        "file", type=Path, metavar="RIG|FILE", help="a rig (.toml); or a recording, of any format"
    )
    parser.add_argument("--bus", action="append", default=[], metavar="NAME", help="only this bus")
    add_bit_rates(parser, "assumed bit rate, also for recordings without one: can0=500k")
    parser.add_argument(
        "--errors", type=whole(0, 4096), metavar="N", help="assume N errors at once"
    )
    parser.add_argument(
        "--error-interval",
        type=real(1e-6, _TIME_MAX_S, "s"),
        metavar="S",
        help="then at most one error every S seconds",
    )
    parser.add_argument(
        "--bit-error-rate",
        type=real(0.0, 0.5),
        metavar="P",
        help="probability of a bit error: adds the probability of late messages",
    )
    _add_assumptions(parser)
    add_max_memory(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--plot", type=Path, metavar="SVG", help="also draw the response times")


def _add_assumptions(parser: argparse.ArgumentParser) -> None:
    """Add options for facts that neither rigs nor recordings contain."""
    parser.add_argument(
        "--queue",
        choices=("fifo", "priority"),
        help="transmit order of the nodes: oldest frame, or most urgent frame first (default: from"
        " the rig, else fifo)",
    )
    parser.add_argument(
        "--deadline",
        action="append",
        type=_deadline,
        default=[],
        metavar="ID=S",
        help="deadline of a message, if it is not its period: 181=0.005",
    )
    parser.add_argument(
        "--sync",
        type=real(1e-4, _TIME_MAX_S, "s"),
        metavar="S",
        help="for a rig: the period of SYNC",
    )
    parser.add_argument(
        "--streamed",
        action="store_true",
        help="for a rig: stream a set-point to every drive at each SYNC",
    )


def run(options: argparse.Namespace) -> int:
    """Analyse the buses; return 0 if every deadline is met, 1 if not, 3 without messages.

    Raises:
        RigError: the rig is wrong, or an option names something that does not exist.
        TraceError: the recording cannot be read, or a bit rate is not known.
    """
    errors = _errors(options)
    subjects = [_with_options(one, options) for one in _subjects(options)]
    _refuse_unknown(subjects, options)
    if options.bus:
        subjects = [one for one in subjects if one.load.name in options.bus]
    subjects_with = [one for one in subjects if one.load.messages]
    found = [analyse(one, errors, len(subjects_with)) for one in subjects_with]
    verdict, status = _sum(found) if subjects else ("no CAN bus", NOT_JUDGED)
    if options.json:
        tables = [as_table(one, options.bit_error_rate) for one in found]
        document = {"file": str(options.file), "verdict": verdict, "buses": tables}
        document["sync_drifts"] = sync_drifts(found)
        print(json.dumps(document, allow_nan=False))
    else:
        for one in subjects:
            if not one.load.messages:
                print(*notes_of(one), sep="\n")
        for each in found:
            print(*head_of(each), sep="\n")
            print_table(*rows_of(each, options.bit_error_rate), words=WORDS)
            for line in remarks_of(each):
                print(line)
        for drift in sync_drifts(found):
            text = f"{drift['drift_ppm']:+.1f} ppm from that of {drift['from']}"
            print(f"{drift['bus']}: SYNC drifts by {text}")
        print(f"{options.file}: {verdict}")
    if options.plot is not None and found:
        _draw(found, options.plot)
    return status


def _subjects(options: argparse.Namespace) -> list[Subject]:
    fifo = None if options.queue is None else options.queue == "fifo"
    if options.file.suffix == ".toml":
        from motorhil.harness.analysis.from_rig import Assumptions, subjects_of_rig

        return subjects_of_rig(options.file, Assumptions(fifo, options.sync, options.streamed))
    from motorhil.harness.analysis.from_recording import subjects_of_recording

    if options.sync is not None or options.streamed:
        raise RigError(options.file, "--sync and --streamed are for rigs", "leave them out")
    rates, data_rates = dict(options.bitrate), dict(options.data_bitrate)
    return subjects_of_recording(options.file, rates, data_rates, fifo, options.max_memory)


def _with_options(subject: Subject, options: argparse.Namespace) -> Subject:
    load = subject.load
    rate = dict(options.bitrate).get(load.name)
    if rate is not None and rate != load.bitrate_bit_s:
        load = at_rate(load, rate)
    data_rate = dict(options.data_bitrate).get(load.name)
    if data_rate is not None:
        if data_rate < load.bitrate_bit_s:
            message = f"--data-bitrate {load.name}={data_rate} is below {load.bitrate_bit_s} bit/s"
            raise RigError(options.file, message, "use a data bit rate that is not lower")
        load = replace(load, data_bitrate_bit_s=data_rate)
    deadlines = dict(options.deadline)

    def with_deadline(one: Message) -> Message:
        deadline_ns = deadlines.get(one.identifier)
        return one if deadline_ns is None else replace(one, deadline_ns=deadline_ns)

    load = replace(load, messages=tuple(with_deadline(one) for one in load.messages))
    return replace(subject, load=load)


def _refuse_unknown(subjects: list[Subject], options: argparse.Namespace) -> None:
    buses = [one.load.name for one in subjects]
    for name in (*dict(options.bitrate), *dict(options.data_bitrate), *options.bus):
        if name not in buses:
            known = ", ".join(buses) or "none"
            raise RigError(options.file, f"there is no CAN bus {name}", f"its buses: {known}")
    sent = {one.identifier for subject in subjects for one in subject.load.messages}
    for number, _ in options.deadline:
        if number not in sent:
            message = f"message {number:03X}h: not in the analysis"
            raise RigError(options.file, message, "see the table without --deadline")


def _errors(options: argparse.Namespace) -> ErrorModel:
    interval = options.error_interval
    burst = options.errors
    if burst is None:
        burst = 0 if interval is None else 1
    return ErrorModel(burst, None if interval is None else round(interval * 1e9))


def _sum(found: list[Findings]) -> tuple[str, int]:
    if not any(one.message.deadline_ns is not None for each in found for one in each.responses):
        return "nothing to analyse: no message with a period or a deadline", NOT_JUDGED
    late = sum(len(one.late) for one in found)
    if late:
        return f"{late} message{'s' * (late > 1)} may be late", FAILED
    return "all messages are in time", PASSED


def _draw(found: list[Findings], target: Path) -> None:
    from motorhil.harness.analysis.plot import svg_of
    from motorhil.traces.files import whole_file

    with whole_file(str(target)) as file:
        file.write(svg_of(found).encode())
    print(f"{target}: response times and deadlines", file=sys.stderr)


def _deadline(text: str) -> tuple[int, int]:
    """Parse a message's identifier and its deadline [ns].

    Raises:
        argparse.ArgumentTypeError: the text does not have the form ID=S.
    """
    name, sign, value = text.partition("=")
    if not sign:
        raise argparse.ArgumentTypeError(f"{text!r} is not ID=S, as 181=0.005")
    return identifier(name), round(real(1e-6, _TIME_MAX_S, "s")(value) * 1e9)
