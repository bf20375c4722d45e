"""A real machine's traffic, decoded by us and by another decoder, with equal results.

The other decoder's output is the CSV next to the recording (see INDEX.md there). The comparison of
each row covers the service, the node, the object, and the content (NMT command and state, abort
text, data, and the toggle and the end of segments).
"""

import csv
import re
import struct
from collections import Counter

import pytest

from motorhil.traces.decoding.canopen import CanopenDecoder
from motorhil.traces.decoding.events import Kind
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import open_source

pytestmark = pytest.mark.data

SERVICES = {
    "NMT": {Kind.NMT},
    "ERR_CTRL": {Kind.HEARTBEAT, Kind.BOOT},
    "SDO_R": {Kind.SDO_REQUEST},
    "SDO_T": {Kind.SDO_RESPONSE},
    "TIME": {Kind.TIME},
    "NONE": {Kind.OTHER},
}
DISAGREEMENTS = {
    # 05000000h is not standardised: they print the number, we print that it is not in CiA 301.
    "abort:  abort code:0x5000000": 1,
}
STEPS = (  # words in the CSV, and in our sentence
    ("client: initiate upload request", ": read "),
    ("client: upload segment request", "requests the next segment of"),
    ("client: download request", ": write "),
    ("client: initiate download request", "begins to write"),
    ("client: download segment request", "writes a segment of"),
    ("server: upload response", " = "),
    ("server: initiate upload response", "begins upload of"),
    ("server: upload segment response", "uploads a segment of"),
    ("server: initiate download response", ": takes "),
    ("server: download segment response", "confirms a segment of"),
    ("server: abort", ": abort of "),
    ("client: abort", ": abort of "),
)


def rows(path):
    with open(path, newline="", encoding="latin-1") as file:
        yield from list(csv.reader(file, delimiter=";", quotechar="\x00"))[1:]


def joined(path):
    """Return the CSV's rows; text with a line end spans several lines."""
    out = []
    for row in rows(path):
        if len(row) >= 10 and row[0].lstrip("'").isdigit():
            out.append(row)
        elif out:
            out[-1][-1] += "\n" + ";".join(row)
    return out


def frame_of(row):
    data = bytes(int(byte, 16) for byte in row[4].strip("[]").split())
    return struct.pack("<IB3x8s", int(row[2], 16), len(data), data)


def disagreement(row, said):
    """Return the difference between the row and our decoding; empty if none."""
    service, node, index, sub, text = row[5], row[6], row[7], row[8], row[9]
    pdo = re.fullmatch(r"PDO(\d)_([TR])", service)
    kinds = {Kind.TPDO if pdo[2] == "T" else Kind.RPDO} if pdo else SERVICES[service]
    if said.kind not in kinds:
        return f"service {service} is {said.kind.value}"
    if pdo and f"PDO {pdo[1]}" not in said.text:
        return f"number of {service}"
    if service not in ("NONE", "TIME") and node not in ("-", str(said.node or 0)):
        return f"node of {service}"
    if index != "-" and (int(index, 16), int(sub, 0)) != (said.index, said.subindex):
        return f"object of {service}: {text.split('=')[0].split('(')[0].strip()}"
    return content(service, text, said)


def content(service, text, said):
    text = text.lstrip("'\"")
    if service == "NMT":
        want = {"NMT Start": "start", "NMT Stop": "stop"}.get(text, "reset|enter")
        return "" if re.search(want, said.text) else f"NMT {text}"
    if service == "ERR_CTRL":
        state = re.match(r"Heartbeat: ([\w-]+)", text)[1].lower().replace("-", "")
        ours = said.facts[0].text.replace("-", "")
        return "" if state == ours else f"state {state}"
    if not service.startswith("SDO"):
        return ""
    step = next((ours for theirs, ours in STEPS if text.startswith(theirs)), None)
    if step is None or step not in said.text:
        return f"step {text.split('=')[0].strip()}"
    if "abort" in text:
        reason = re.search(r'"(.*?)\.?"', text)[1].lower()
        return "" if reason in said.text.lower() else f"abort: {reason}"
    return segments(text, said)


def test_frames_of_real_file_match_other_reader(shared):
    """Number, time, identifier, length and data of all rows."""
    source = open_source(shared / "data/traffic/canopen_machine_pcan1.trc")
    frames = list(source.frames(Findings()))
    found = joined(shared / "data/traffic/canopen_machine_pcan1.trc.csv")
    assert len(frames) == len(found) == 11283
    start_ns = frames[0].time_ns - 144_500_000  # their times count from $STARTTIME
    assert start_ns == 1675777465161000000  # "Start time: 07.02.2023 13:44:25.161.0", as UTC
    for number, (frame, row) in enumerate(zip(frames, found, strict=True), 1):
        milliseconds, _, rest = row[1].partition(",")
        time_ns = int(milliseconds) * 1_000_000 + int(rest.ljust(6, "0"))
        assert (number, frame.time_ns - start_ns) == (int(row[0].lstrip("'")), time_ns)
        assert frame.frame == frame_of(row)
        assert frame.frame[4] == int(row[3])


def bytes_of(value, size):
    if isinstance(value, int):
        return (value % 256**size).to_bytes(size, "little")
    return value.encode("latin-1").ljust(size, b"\0") if isinstance(value, str) else value


def segments(text, said):
    data = re.search(r"= \[((?:0x[0-9a-f]{2} ?)+)\]", text)
    if data and "segment" in text:
        want = bytes(int(byte, 16) for byte in data[1].split()).hex(" ").upper()
        if f": {want}" not in said.text:
            return "data of a segment"
    if data and text.startswith("server: upload response"):
        want = bytes(int(byte, 16) for byte in data[1].split())
        if bytes_of(said.facts[0].value, len(want)) != want:
            return "data of an object"
    size = re.search(r"length=(\d+) bytes", text)
    if size and not said.text.endswith(f", {size[1]} bytes"):
        return "size"
    return ""


def test_decoding_of_real_machine_matches_other_decoder(shared):
    decoder = CanopenDecoder()
    differs = Counter()
    compared = Counter()
    for row in joined(shared / "data/traffic/canopen_machine_pcan1.trc.csv"):
        said = decoder.decode(frame_of(row))
        compared[row[5].split("_")[0]] += 1
        problem = disagreement(row, said)
        if problem:
            differs[problem] += 1
    assert sum(compared.values()) == 11283
    assert differs == DISAGREEMENTS
