"""Options and tables that several verbs share.

Errors of numbers name the limits and the unit.
"""

import argparse
import math
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Final, final

from motorhil.frozen import frozen
from motorhil.harness.cli.printable import coloured, print_as_is, printable
from motorhil.harness.rig.config.toml import SEED_MAX, one_line
from motorhil.traces.files import MEMORY_MAX

if TYPE_CHECKING:
    from motorhil.harness.recording.decoders import GivenDecoder
    from motorhil.traces.mcap.records import Attachment

NODE_MAX: Final = 255
_NS: Final = 1_000_000_000
_EDS_BYTES_MAX: Final = 16_000_000
_NS_MAX: Final = 2**64 - 1  # MCAP's log time


def real(low: float, high: float, unit: str = "") -> Callable[[str], float]:
    """Return a reader of finite numbers from `low` to `high` [unit], for argparse's `type`."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise _wrong(text, "a number", low, high, unit)
        return value

    return read


def whole(low: int, high: int, unit: str = "") -> Callable[[str], int]:
    """Return a reader of whole numbers from `low` to `high` [unit], for argparse's `type`."""

    def read(text: str) -> int:
        value = int(text) if text.isdecimal() and text.isascii() else -1
        if not low <= value <= high:
            raise _wrong(text, "a whole number", low, high, unit)
        return value

    return read


def identifier(text: str) -> int:
    """Read a CAN identifier in hexadecimal, with or without a final h, for argparse's `type`."""
    digits = text.lower().removesuffix("h")
    try:
        value = int(digits, 16) if digits.isalnum() else -1
    except ValueError:
        value = -1
    if not 0 <= value <= 0x1FFFFFFF:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not an identifier; say 0 to 1FFFFFFF, such as 181"
        )
    return value


def time_ns(text: str) -> int:
    """Read seconds, exactly as written, and return nanoseconds, for argparse's `type`."""
    whole_s, _, part = text.partition(".")
    digits = (whole_s or "0") + (part or "0")
    if text in ("", ".") or not (digits.isascii() and digits.isdecimal()) or len(part) > 9:
        raise _no_time(text)
    value = int(whole_s or "0") * _NS + int(part.ljust(9, "0"))
    if value > _NS_MAX:
        raise _no_time(text)
    return value


def _no_time(text: str) -> argparse.ArgumentTypeError:
    limit = f"0 to {_NS_MAX / _NS:.0f} s, with at most 9 decimal places"
    return argparse.ArgumentTypeError(f"{text!r} is not a time; say {limit}")


def _wrong(text: str, what: str, low: float, high: float, unit: str) -> argparse.ArgumentTypeError:
    limits = " to ".join(str(one) if isinstance(one, int) else f"{one:g}" for one in (low, high))
    words = f"{text!r} is not {what} from {limits} {unit}".rstrip()
    return argparse.ArgumentTypeError(words)


def add_color(parser: argparse.ArgumentParser) -> None:
    """Add `--color WHEN`."""
    parser.add_argument(
        "--color",
        choices=("auto", "always", "never"),
        default="auto",
        help="colour verdicts; auto: on a terminal, unless NO_COLOR or FORCE_COLOR says otherwise",
    )


def add_max_memory(parser: argparse.ArgumentParser) -> None:
    """Add `--max-memory MIB`; the value is in bytes."""
    parser.add_argument(
        "--max-memory",
        type=_mebibytes,
        default=MEMORY_MAX,
        metavar="MIB",
        help="most memory for one compressed piece of a file, or content of a .gz (default"
        f" {MEMORY_MAX >> 20} MiB); a hostile file would take any",
    )


def _mebibytes(text: str) -> int:
    return whole(1, 1 << 20, "MiB")(text) << 20


@final
@frozen
class GivenEds:
    """An EDS for a node of a recording: bus ("" for every bus), node-ID, file."""

    bus: str
    node: int
    path: str

    def stands_for(self, bus: str, node: int) -> bool:
        """Return True if the EDS is for this node."""
        return node == self.node and self.bus in ("", bus)

    def __str__(self) -> str:
        place = f"{self.bus}:{self.node}" if self.bus else f"{self.node}"
        return f"{place}={self.path}"


def add_eds(parser: argparse.ArgumentParser) -> None:
    """Add `--eds [BUS:]NODE=FILE`, which may be repeated; `attachments_of` reads the files."""
    parser.add_argument(
        "--eds",
        action="append",
        type=_given_eds,
        default=[],
        metavar="[BUS:]NODE=FILE",
        help="EDS or DCF of a node, if the recording lacks it; may be repeated",
    )


def _given_eds(text: str) -> GivenEds:
    place, _, path = text.partition("=")
    bus, _, node = place.rpartition(":")
    if not path or not (node.isascii() and node.isdecimal()) or not 1 <= int(node) <= 127:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not [BUS:]NODE=FILE with a node-ID of 1 to 127, such as can0:5=drive.eds"
        )
    return GivenEds(bus, int(node), path)


def attachments_of(given: "Sequence[GivenEds]") -> "list[Attachment]":
    """Return the attachments for the EDS files of `--eds`.

    Raises:
        TraceError: a file cannot be read, or is not an EDS.
    """
    from motorhil.traces.decoding.attached_rig import eds_attachments, objects_in
    from motorhil.traces.errors import TraceError
    from motorhil.traces.files import unreadable

    found: list[tuple[str, int, bytes]] = []
    for one in given:
        try:
            with open(one.path, "rb") as file:
                data = file.read(_EDS_BYTES_MAX + 1)
        except OSError as error:
            raise unreadable(one.path, error) from error
        if len(data) > _EDS_BYTES_MAX or not objects_in(data).count:
            remedy = "give the EDS or DCF of the drive's vendor"
            raise TraceError(one.path, "holds no objects of an EDS", remedy=remedy)
        found.append((one.bus, one.node, data))
    return eds_attachments(found)


def add_descriptions(parser: argparse.ArgumentParser) -> None:
    """Add `--dbc FILE`, and `--decoder [BUS:]NODE=NAME`, which may be repeated."""
    parser.add_argument(
        "--dbc", metavar="FILE", help="DBC with the messages and signals of frames; needs cantools"
    )
    parser.add_argument(
        "--decoder",
        action="append",
        type=_given_decoder,
        default=[],
        metavar="[BUS:]NODE=NAME",
        help="decoder of a node's frames, of an installed package; may be repeated",
    )


def _given_decoder(text: str) -> "GivenDecoder":
    from motorhil.harness.recording.decoders import GivenDecoder

    place, _, name = text.partition("=")
    bus, _, node = place.rpartition(":")
    if not name or not (node.isascii() and node.isdecimal()) or int(node) > NODE_MAX:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not [BUS:]NODE=NAME with a node-ID of 0 to {NODE_MAX}, such as "
            "can0:1=odrive"
        )
    return GivenDecoder(bus, int(node), name)


def add_seed(parser: argparse.ArgumentParser) -> None:
    """Add `--seed N`, a seed that a rig may have; None by default."""
    parser.add_argument("--seed", type=seed, metavar="N", help="overrides the rig's own seed")


def add_only(parser: argparse.ArgumentParser) -> None:
    """Add `--only ID`, oracles by their ids; an empty list by default."""
    from motorhil.harness.oracles.judge import IDS

    parser.add_argument(
        "--only",
        action="append",
        choices=IDS,
        default=[],
        metavar="ID",
        help="only this oracle; may be repeated",
    )


def seed(text: str) -> int:
    """Read a seed, for argparse's `type`.

    Raises:
        ValueError: the text is not a seed.
    """
    value = int(text, 0)
    if not 0 <= value <= SEED_MAX:
        raise ValueError
    return value


seed.__name__ = f"seed (0 to {SEED_MAX})"  # argparse uses it in the error for an invalid value


def print_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    words: Collection[int] = (0,),
    has_colours: bool = False,
) -> None:
    """Print the head and rows in columns: words left-aligned, numbers right-aligned.

    With colours, cells that are a verdict have its colour.
    """
    widths = [max(len(row[column]) for row in [head, *rows]) for column in range(len(head))]
    for row in [head, *rows]:
        cells = [
            cell.ljust(width) if column in words else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        if has_colours and row is not head:
            tinted = [coloured(*pair) for pair in zip(row, map(printable, cells), strict=True)]
            print_as_is("  ".join(tinted).rstrip())
            continue
        text = "  ".join(cells).rstrip()
        print(text if text.isprintable() else one_line(text))
