"""Recorded hosts with our drive instead: differences and reasons.

Recordings: ../shared/data/traffic/INDEX.md. The host of a transcript is played as by `replay --as
host`. The messages of our drive are compared with those of the recorded drive, object by object
(`motorhil.traces.semantics.diff`). A difference without a reason in this table fails a test; so
does a reason without a difference. docs/reference/emulated-drive.md has this table.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, final

from motorhil.harness.recording.conversion import convert
from motorhil.harness.replay.host import DrivenRig, compared, drive
from motorhil.harness.rig.rig import Rig
from motorhil.traces.semantics.diff import Tolerance
from tests.support.canopen.drive_wire import frame

ROW: Final = re.compile(
    r"(?:can0\s+|[RT]x\s+0)([0-9A-F]{3})\s+(?:\[\d\]|\d)((?:[^\S\n]+[0-9A-F]{2}\b)*)"
)
STAMPED: Final = re.compile(r"\((\d+\.\d+)\) \w+ ([0-9A-F]{3}#[0-9A-F]*)")
BOOTED_S: Final = 0.8
PITCH_S: Final = 0.01
"""The time between frames of a recording without time stamps: no faster than drives respond."""


@final
@dataclass(frozen=True, slots=True)
class Transcript:
    """One recording, or a part of one, and the drive that replaces its drive.

    Attributes:
        title, file: the name of the recording, and its file.
        part: cuts the file's text; None: all of it.
        node: the drive's node-ID.
        eds: the vendor's file; "": ours, with that drive's identity in `objects`.
        objects: settings of the recorded drive before the recording.
        first: required host messages before it.
        stimuli: lines of a rig file: physical stimuli of the recorded drive.
        differences: by subject: the first difference, "theirs, but ours", and its reason.
        agrees: equal results, for that page.
    """

    title: str
    file: str
    node: int
    agrees: str
    part: Callable[[str], str] | None = None
    eds: str = ""
    objects: Mapping[str, int | str] = field(default_factory=dict)
    first: tuple[str, ...] = ()
    stimuli: str = ""
    differences: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def frames_of(text: str) -> list[tuple[float, str]]:
    """Return (time [s], "601#40...") of each frame."""
    stamped = STAMPED.findall(text)
    if stamped:
        return [(float(at), row) for at, row in stamped]
    rows = ROW.findall(text)
    return [
        (place * PITCH_S, f"{can_id}#{data.replace(' ', '')}")
        for place, (can_id, data) in enumerate(rows)
    ]


def played(transcript: Transcript, shared: Path, folder: Path) -> tuple[dict[str, str], int]:
    """Return the differences by subject, and the total number of agreements.

    Messages that a host awaited in vain count as "waited in vain: ...".
    """
    text = (shared / "data/traffic" / transcript.file).read_text()
    frames = frames_of(transcript.part(text) if transcript.part else text)
    source = folder / "theirs.log"
    source.write_text("".join(f"({at + 1:.6f}) can0 {row}\n" for at, row in frames))
    theirs, ours = folder / "theirs.mcap", folder / "ours.mcap"
    convert(str(source), str(theirs), "mcap")
    rig = folder / "rig.toml"
    rig.write_text(_rig(transcript, shared))
    with Rig.open(rig, record=ours) as world:
        world.runtime.run_for(BOOTED_S / 2)
        stranger = world.world.add_host("can0", "before", lambda *_: None)
        for told in transcript.first:
            stranger.send(frame(told))
        world.runtime.run_for(BOOTED_S / 2)
        player = drive(DrivenRig(world), theirs).player
    plain = _without_rig(ours, folder)
    fidelities, differences = compared(theirs, plain, player.pairs, Tolerance())
    found = {
        one.label.partition(", ")[2].partition(", ")[2]: _untimed(str(one)) for one in differences
    }
    for missed in player.missed:
        found.setdefault(f"in vain: {missed.awaited.text}", missed.instead)
    return found, sum(one.agreeing for one in fidelities)


def _untimed(text: str) -> str:
    """Remove the label and the times: "what they told, but what we told"."""
    return re.sub(r" at \d+\.\d+ s", "", text.partition(": ")[2])


def _without_rig(ours: Path, folder: Path) -> Path:
    """Return the same frames with as little context as recorded ones.

    Frames before the host's first one are left out: recorded drives booted long before.
    """
    source, target = folder / "ours.log", folder / "plain.mcap"
    convert(str(ours), str(source), "candump")
    rows = source.read_text().splitlines(keepends=True)
    source.write_text("".join(row for row in rows if float(row[1 : row.index(")")]) >= BOOTED_S))
    convert(str(source), str(target), "mcap")
    return target


def _rig(transcript: Transcript, shared: Path) -> str:
    lines = [
        "[bus.can0]",
        "bitrate_bit_s = 1_000_000",
        "[controller.drive]",
        'kind = "cia402"',
        'bus = "can0"',
        f"node_id = {transcript.node}",
    ]
    if transcript.eds:
        lines.append(f'eds = "{shared / "data/eds" / transcript.eds}"')
    if transcript.objects:
        lines.append("[controller.drive.objects]")
        lines += [f'"{key}" = {json.dumps(value)}' for key, value in transcript.objects.items()]
    return "\n".join(lines) + "\n" + transcript.stimuli


def _between(begin: str, end: str = "") -> Callable[[str], str]:
    """Return the lines from the first that has `begin` to the first behind it that has `end`."""

    def part(text: str) -> str:
        rest = text[text.index(begin) :] if begin else text
        return rest[: rest.index(end)] if end else rest

    return part


def _pdos(*mappings: tuple[int, int, tuple[int, ...]]) -> dict[str, int]:
    """Return (mapping object, transmission type, entries) as power-on values of their objects."""
    objects: dict[str, int] = {}
    for index, kind, entries in mappings:
        objects[f"{index - 0x200:04X}h:2"] = kind
        objects[f"{index:04X}h:0"] = len(entries)
        objects |= {f"{index:04X}h:{place}": entry for place, entry in enumerate(entries, 1)}
    return objects


_SERVO: Final = {"1018h:1": 0x331, "1018h:2": 0x4A, "1018h:3": 0x100, "1018h:4": 1}
_WORD, _MODE, _SHOWN = 0x6040_0010, 0x6060_0008, 0x6061_0008
_STATUS, _PLACE, _SPEED = 0x6041_0010, 0x6064_0020, 0x606C_0020
_TOGGLE: Final = "toggle bit not alternated, but nothing"
_NO_TRANSFER: Final = (
    "after an abort, or with no transfer going on, theirs still finds the toggle bit wrong; by CiA "
    "301 there is no transfer any more: command specifier not valid (0504 0001h), of no object"
)
_LENGTH: Final = "8220h PDO length exceeded, error register 11h"

TRANSCRIPTS: Final = (
    Transcript(
        title="Roboteq MBL1660, 596 frames: SYNC, four RPDOs, two TPDOs",
        file="roboteq_mbl1660_node12_candump.txt",
        node=12,
        eds="roboteq_v80.eds",
        agrees="TPDOs, heartbeat, the EMCY 8220h on 081h",
        objects={
            "1014h": 0x81,  # absent from the file
            "1017h": 1000,
            **{f"{0x1600 + number:04X}h:0": entries for number, entries in enumerate((1, 1, 2, 2))},
            **{f"{0x1802 + number:04X}h:1": 0xC000_0000 for number in range(2)},
            **{f"{0x1400 + number:04X}h:2": 255 for number in range(4)},
        },
        first=("000#010C",),
        differences={
            "emergency": (
                f"emergency = {_LENGTH}, but emergency = {_LENGTH}",
                "theirs repeats the EMCY as long as RPDOs that are too long come; ours tells each "
                "RPDO once, with its number and the two lengths",
            ),
            f"in vain: node 1 emergency {_LENGTH}": (
                f"last told: node 1 emergency {_LENGTH}, manufacturer's 02 08 04 00 00",
                "the same: the host met the EMCY again",
            ),
        },
    ),
    Transcript(
        title="a servo of vendor 331h at boot, 21 frames: reset, scan, three downloads",
        file="ros2canopen_issue298_fault_recovery.candump.txt",
        part=_between("can0  000", "# ---- excerpt"),
        node=1,
        agrees="boot-up, device type, identity, downloads",
        objects=_SERVO,
        differences={
            "NMT state": (
                "nothing, but NMT state = pre-operational",
                "the host sets 1017h: ours sends its heartbeat from then on, the excerpt ends "
                "before theirs does",
            ),
        },
    ),
    Transcript(
        title="the same servo, 38 frames: a fault when enabled, its reset, the way back",
        file="ros2canopen_issue298_fault_recovery.candump.txt",
        part=_between("# ---- excerpt"),
        node=1,
        agrees="all states, the EMCYs of fault and reset",
        objects={
            **_SERVO,
            **_pdos(
                (0x1600, 255, (_WORD, 0x607A_0020, _MODE)),
                (0x1602, 255, (_WORD, 0x60FF_0020, 0x0005_0008)),
                (0x1A00, 255, (_STATUS,)),
                (0x1A01, 255, (_STATUS, _PLACE, _SHOWN)),
                (0x1A03, 255, (_PLACE, _SPEED)),
            ),
            "1802h:1": 0xC000_0381,
        },
        first=("000#0101", "201#06010000000000", "201#07010000000000"),
        stimuli=(
            '[[stimulus]]\ncontroller = "drive"\nname = "fault"\nvalue = 0x5201\nat_s = 0.95\n'
        ),
        differences={
            "TPDO 1": (
                "TPDO 1 = 37 06, but TPDO 1 = 37 02",
                "statusword bit 10: theirs shows target reached without a mode (6060h is 0), and "
                "bit 5 in FAULT and SWITCH ON DISABLED, where CiA 402 leaves it open",
            ),
            "TPDO 2": (
                "TPDO 2 = 37 06 52 1A 00 00 00, but TPDO 2 = 37 02 00 00 00 00 00",
                "the same, and where their motor stood",
            ),
            "TPDO 4": (
                "TPDO 4 = 52 1A 00 00 00 00 00 03, but nothing",
                "where their motor stood, and a vendor's object in the last byte",
            ),
            "emergency": (
                "emergency = 5201h device hardware, error register 80h, "
                "but emergency = 5201h device hardware, error register 01h",
                "1001h: theirs sets the vendor's bit alone, without the generic one of CiA 301",
            ),
            "in vain: node 1 emergency 5201h device hardware, error register 80h, "
            "manufacturer's 00 00 00 70 08": (
                "last told: node 1 emergency 5201h device hardware, error register 01h",
                "the same, and the vendor's five bytes",
            ),
        },
    ),
    Transcript(
        title="Nanotec N5, 16 frames: reset, identity, start",
        file="ros2canopen_issue356_nanotec_n5_boot.candump.txt",
        part=_between("can0  000"),
        node=1,
        eds="nanotec_C5-E-2-09.eds",
        agrees="boot-up, identity, three of the four TPDOs that come at the start",
        objects={"1000h": 0x0006_0192, "1018h:1": 0x26C, "1018h:2": 0x0A},
        differences={
            "TPDO 1": (
                "TPDO 1 = 40 06 02, but TPDO 1 = 50 02 00",
                "statusword: theirs has no supply yet (bit 4) and shows bit 10 without a mode; the "
                "third byte is of the N5, the file of its sibling, a C5-E",
            ),
            "NMT state": (
                "NMT state = operational, but nothing",
                "theirs tells the new state at once though 1017h is 0 in the file and nobody has "
                "set it: without a heartbeat time CiA 301 has a boot-up and no more",
            ),
            "in vain: node 1 is operational": ("last told: node 1 has booted", "the same"),
            "emergency": (
                f"nothing, but emergency = {_LENGTH}",
                "the host sends 7 bytes to RPDO 1; the sibling's file maps fewer",
            ),
        },
    ),
    Transcript(
        title="Technosoft iPOS, 48 frames: segmented uploads, toggle bits right and wrong",
        file="technosoft_ipos_segmented_sdo_and_pdo_mapping.pcan.txt",
        part=_between("", "//====== Testing Mapping"),
        node=1,
        eds="technosoft_ipos.eds",
        agrees="identity, strings in segments, the abort of a toggle bit that is wrong",
        objects={
            **{"1008h": "iPOS".ljust(15), "100Ah": "F508M".ljust(15)},
            **{"1018h:2": 0x01AB_46D1, "1018h:4": 0x4747_7222},
        },
        differences={
            "read of 0000h aborted": (
                "nothing, but read of 0000h aborted = "
                "client/server command specifier not valid or unknown",
                _NO_TRANSFER,
            ),
            **{
                f"read of {place} aborted": (
                    f"read of {place} aborted = {_TOGGLE}",
                    _NO_TRANSFER,
                )
                for place in ("100Ah", "1018h:1", "1018h:2", "1018h:4", "1008h")
            },
        },
    ),
    Transcript(
        title="Technosoft iPOS, 24 frames: a TPDO mapped anew",
        file="technosoft_ipos_segmented_sdo_and_pdo_mapping.pcan.txt",
        part=_between("//====== Testing Mapping"),
        node=4,
        eds="technosoft_ipos.eds",
        agrees="every download of the remapping; 6061h, 6064h",
        objects={"6060h": 0},
        differences={
            "1002h manufacturer status register": (
                "1002h manufacturer status register = 021F0250h, "
                "but 1002h manufacturer status register = 00000000h",
                "that vendor's status bits: no behaviour of ours stands behind 1002h",
            ),
        },
    ),
)


def table() -> str:
    """Return agreements, differences and reasons: the table of docs/reference/emulated-drive.md."""
    rows = ["| recorded | alike | different, and why |", "| --- | --- | --- |"]
    for one in TRANSCRIPTS:
        reasons: dict[str, list[str]] = {}
        for about, (_, reason) in one.differences.items():
            if not reason.startswith("the same") and not about.startswith("in vain"):
                reasons.setdefault(reason, []).append(about)
        told = "; ".join(f"{', '.join(about)}: {reason}" for reason, about in reasons.items())
        rows.append(f"| {one.title} | {one.agrees} | {told} |")
    return "\n".join(rows)
