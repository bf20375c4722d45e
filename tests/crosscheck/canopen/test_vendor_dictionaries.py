"""Vendors' files as canopen reads them, against the dictionaries that emulated nodes serve.

canopen's client uploads every sub-index and compares value, length and access with the file. The
only differences are listed in docs/how-to/use-a-vendor-eds.md, and a note of the node names each
value that the node supplies itself.
"""

import io
import re
from collections.abc import Iterator
from pathlib import Path

import canopen
import pytest
from canopen.objectdictionary import ODVariable, import_od

from tests.support.canopen.pumped_client import PumpedNode402
from tests.support.cia402.bench import NODE, Bench
from tests.support.cia402.bench_client import BenchNetwork

pytestmark = pytest.mark.data

DRIVES = (
    *("maxon_epos2_50_5.eds", "nanotec_C5-E-2-09.eds", "technosoft_ipos.eds", "roboteq_v80.eds"),
    *("elmo_gold_cob.dcf", "schunk_prl_erb_0_63.dcf", "BAD_faulhaber_mcbl_51V.eds"),
)
# Live values: what the drive does or measures, not what the file says.
LIVE = {(0x6041, 0), (0x6061, 0), (0x6079, 0), (0x60C4, 4)}
HISTORY, IDENTITY, SUPPORTED_MODES = 0x1003, 0x1018, 0x6502
STORAGE = (0x1010, 0x1011)
NO_DATA, WRITE_ONLY, READ_ONLY = 0x0800_0024, 0x0601_0001, 0x0601_0002
VL = 1 << 1  # 6502h: the only mode that is not emulated, told by a note of its own


def read(path: Path) -> canopen.ObjectDictionary:
    text = path.read_bytes()
    file = io.StringIO(text.decode("cp1252" if path.name.startswith("BAD_") else "utf-8"))
    file.name = str(path)
    return import_od(file, NODE)


def variables(od: canopen.ObjectDictionary) -> Iterator[ODVariable]:
    for one in od.values():
        if one.index >= 0x1000:  # below: data types, which are no objects
            yield from (one,) if isinstance(one, ODVariable) else one.values()


def stated(variable: ODVariable) -> bytes | None:
    """Return the file's power-on value on the wire; a DCF's ParameterValue comes first."""
    value = variable.default if variable.value is None else variable.value
    if isinstance(value, int):  # canopen reads hexadecimals of signed types as unsigned
        return (value & (1 << len(variable)) - 1).to_bytes((len(variable) + 7) // 8, "little")
    return value.encode("latin-1") if isinstance(value, str) else value


def differences(bench: Bench, path: Path, supplied: dict[tuple[int, int], int]) -> list[str]:
    """Return the sub-indices that the node serves otherwise than the file, one line each."""
    network = BenchNetwork(bench)
    node = PumpedNode402(NODE, read(path))
    network.add_node(node)
    network.pump_until(lambda: node.nmt.state == "PRE-OPERATIONAL", 1.0)
    found = []
    for variable in variables(node.object_dictionary):
        place = (variable.index, variable.subindex)
        name = f"{place[0]:04X}h:{place[1]} {variable.access_type}"
        expected = stated(variable)
        try:
            served = node.sdo.upload(*place)
        except canopen.SdoAbortedError as error:
            is_due = (variable.access_type, error.code) == ("wo", WRITE_ONLY)
            is_due |= (place[0], error.code) == (HISTORY, NO_DATA)
            found += [] if is_due else [f"{name}: {error}"]
            continue
        if variable.access_type == "wo":
            found.append(f"{name}: readable")
        if variable.access_type in ("ro", "const"):
            found += [] if is_refused(node, place) else [f"{name}: writable"]
        if expected is None and len(served) in (0, len(variable) // 8):
            number = int.from_bytes(served, "little", signed=supplied.get(place, 0) < 0)
            expected = supplied.get(place, 0).to_bytes(len(served), "little", signed=number < 0)
            if place[0] in STORAGE and place[1]:
                expected = b"\1\0\0\0"  # CiA 301: on command
            if place[0] == IDENTITY:
                expected = served  # [DeviceInfo], which canopen leaves out
        if place == (SUPPORTED_MODES, 0) and expected is not None:
            expected = bytes((expected[0] & ~VL, *expected[1:]))
        if served != expected and place not in LIVE:
            found.append(f"{name}: {served.hex()}, not {expected and expected.hex()}")
    return found


def is_refused(node: PumpedNode402, place: tuple[int, int]) -> bool:
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo.download(*place, bytes(4))  # expedited: canopen ends a refused segmented one late
    return refused.value.code == READ_ONLY


def told(bench: Bench, file: str) -> dict[tuple[int, int], int]:
    """Return the values that the node's note says it supplies."""
    head = f"{file} states no power-on value of these objects; used: "
    notes = [text for level, text in bench.events if level == "info" and text.startswith(head)]
    pattern = r"([0-9A-F]{4})h(?::(\d+))? = (-?\d+)"
    return {
        (int(index, 16), int(subindex or 0)): int(value)
        for note in notes
        for index, subindex, value in re.findall(pattern, note)
    }


@pytest.mark.parametrize("file", DRIVES)
def test_drive_serves_the_dictionary_of_the_file(shared: Path, file: str):
    folder = shared / "data" / "eds"
    bench = Bench(folder=folder, eds=file)
    assert differences(bench, folder / file, told(bench, file)) == []
