"""Abort codes of wrong accesses, over our and vendors' files (CiA 301).

The expected code is derived here from the standard. The description of an object is canopen's
reading of the file, not ours. Only for a value within its range a device may have reasons of its
own.
"""

import functools
from pathlib import Path

import canopen
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from motorhil import emulators
from motorhil.emulators.canopen.files.eds import read_eds
from tests.support.canopen.node_bench import NODE_ID, Bench

EDS = Path(emulators.__file__).parent / "eds"
OWN = ("motorhil_cia401.eds", "motorhil_cia402.eds")
VENDORS = ("maxon_epos2_50_5.eds", "technosoft_ipos.eds", "roboteq_v80.eds")

NO_OBJECT, NO_SUBINDEX = 0x0602_0000, 0x0609_0011
WRITE_ONLY, READ_ONLY = 0x0601_0001, 0x0601_0002
TOO_LONG, TOO_SHORT = 0x0607_0012, 0x0607_0013
TOO_HIGH, TOO_LOW = 0x0609_0031, 0x0609_0032
NO_DATA = 0x0800_0024
# Reasons to refuse a value in its range: invalid, not mappable, PDO too long, incompatible, PDO
# procedure violated, signature, device state.
OWN_REASONS = {
    *(0x0609_0030, 0x0604_0041, 0x0604_0042, 0x0604_0043, 0x0601_0000, 0x0800_0020),
    *(0x0800_0022, NO_OBJECT, NO_SUBINDEX, TOO_HIGH, TOO_LOW),
}


@functools.cache
def described(path: Path) -> tuple[Bench, canopen.ObjectDictionary, list[tuple[int, int]]]:
    bench = Bench(read_eds(path, NODE_ID).dictionary()).boot()
    theirs = canopen.import_od(str(path), NODE_ID)
    places = [
        (entry.index, subindex)
        for entry in theirs.values()
        if entry.index >= 0x1000
        for subindex in (entry.subindices if hasattr(entry, "subindices") else (0,))
    ]
    return bench, theirs, places


def variable_at(theirs: canopen.ObjectDictionary, index: int, subindex: int):
    """Return canopen's variable, or (None, None) without the object, or (has_object, None)."""
    entry = theirs.get(index)
    if entry is None or index < 0x1000:  # canopen lists the dummies too
        return False, None
    if isinstance(entry, canopen.objectdictionary.ODVariable):
        return True, entry if subindex == 0 else None
    return True, entry.subindices.get(subindex)


def answer(bench: Bench, request: bytes) -> int:
    """Return the abort code of the response, or 0."""
    raw = bytes.fromhex(bench.ask(request.hex(" ")))
    return int.from_bytes(raw[4:8], "little") if raw[0] == 0x80 else 0


def expected(variable, is_upload: bool, size: int, value: int) -> set[int]:
    """Return the standard's result of an access to an existing object."""
    if is_upload:
        return {WRITE_ONLY} if variable.access_type == "wo" else {0, NO_DATA}
    if variable.access_type in ("ro", "const"):
        return {READ_ONLY}
    bits = len(variable)
    if variable.data_type in canopen.objectdictionary.DATA_TYPES or bits == 0:
        return {0, *OWN_REASONS}
    if size != (bits + 7) // 8:
        return {TOO_LONG if size > (bits + 7) // 8 else TOO_SHORT}
    return {0, *OWN_REASONS}


ACCESS = st.tuples(
    st.booleans(), st.integers(1, 4), st.integers(0, 0xFFFF_FFFF) | st.sampled_from([0, 1, 255])
)
PLACE = st.tuples(st.integers(0, 0xFFFF), st.integers(0, 255))


def check(path: Path, pick: int, place: tuple[int, int] | None, access) -> None:
    bench, theirs, places = described(path)
    index, subindex = places[pick % len(places)] if place is None else place
    is_upload, size, value = access
    head = 0x40 if is_upload else 0x23 | (4 - size) << 2
    data = bytes(4) if is_upload else (value & ((1 << 8 * size) - 1)).to_bytes(4, "little")
    code = answer(bench, bytes((head, index & 0xFF, index >> 8, subindex)) + data)
    has_object, variable = variable_at(theirs, index, subindex)
    if not has_object:
        wanted = {NO_OBJECT}
    elif variable is None:
        wanted = {NO_SUBINDEX}
    else:
        wanted = expected(variable, is_upload, size, value)
    event(f"{code:08X}")
    assert code in wanted, f"{path.name} {index:04X}h:{subindex:02X}h: {code:08X}h"


PICK = st.integers(0, 10_000)
WHERE = st.none() | st.none() | PLACE


@pytest.mark.parametrize("name", OWN)
@given(pick=PICK, place=WHERE, access=ACCESS)
def test_access_to_own_objects_gets_standard_abort_code(name, pick, place, access):
    check(EDS / name, pick, place, access)


@pytest.mark.parametrize("name", VENDORS)
@given(pick=PICK, place=WHERE, access=ACCESS)
def test_access_to_vendor_objects_gets_standard_abort_code(name, shared, pick, place, access):
    check(shared / "data" / "eds" / name, pick, place, access)


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("40 00 20 00", NO_OBJECT),
        ("40 18 10 05", NO_SUBINDEX),
        ("2B 41 60 00", READ_ONLY),
        ("2F 40 60 00", TOO_SHORT),
        ("23 40 60 00", TOO_LONG),
        ("40 03 10 01", NO_DATA),
        ("E0 00 10 00", 0x0504_0001),  # unknown command
    ],
)
def test_abort_code_occurs(request_, code):
    bench = Bench(read_eds(EDS / OWN[1], NODE_ID).dictionary()).boot()
    assert answer(bench, bytes.fromhex(request_).ljust(8, b"\0")) == code


def test_number_out_of_limits_is_too_high_or_too_low():
    od = read_eds(EDS / OWN[1], NODE_ID).dictionary()
    bench = Bench(od).boot()
    limited = 0
    for variable in od:
        if variable.access != "rw" or variable.writer is not None or variable.bits not in (8, 16):
            continue
        size = variable.bits // 8
        mask = (1 << variable.bits) - 1
        for limit, step, code in ((variable.high, 1, "0609 0031"), (variable.low, -1, "0609 0032")):
            if limit is not None and variable.can_hold(limit + step):
                limited += 1
                found = bench.download(
                    variable.index, variable.subindex, (limit + step) & mask, size
                )
                assert found == code, f"{variable.index:04X}h:{variable.subindex}"
    assert limited >= 2


# --- client that abandons a transfer (0504 0000h)


def parted() -> Bench:
    bench = Bench().boot()
    bench.od.get(0x2000).value = b"a text that needs segments"
    return bench


SECOND = 1_000_000_000
LEAVING = {
    "upload": ["40 00 20 00 00 00 00 00"],
    "upload, after a segment": ["40 00 20 00 00 00 00 00", "60 00 00 00 00 00 00 00"],
    "download": ["21 00 20 00 14 00 00 00"],
    "download, after a segment": ["21 00 20 00 14 00 00 00", "00 61 62 63 64 65 66 67"],
    "block upload": ["A4 00 20 00 10 00 00 00"],
    "block upload, after a block": ["A4 00 20 00 01 00 00 00", "A3 00 00 00 00 00 00 00"],
    "block download": ["C6 00 20 00 14 00 00 00"],
    "block download, in a block": ["C6 00 20 00 14 00 00 00", "01 61 62 63 64 65 66 67"],
}


@pytest.mark.parametrize("requests", LEAVING.values(), ids=LEAVING)
def test_abandoned_transfer_times_out_after_one_second(requests):
    bench = parted()
    for request in requests:
        bench.ask_all(request)
    bench.frames()
    asked_at = bench.now_ns - 1_000_000  # `ask_all` has waited for the response
    bench.wait(3 * SECOND)
    (told,) = bench.heard()
    assert told == (asked_at + SECOND + 2_000_000, "582 80 00 20 00 00 00 04 05")
    assert bench.node.next_deadline_ns() is None
    assert bench.ask("60 00 00 00 00 00 00 00")[-11:] == "01 00 04 05"  # the transfer is over


@pytest.mark.parametrize("size", [1, 4])
def test_expedited_transfer_leaves_no_timeout(size):
    bench = parted()
    bench.download(0x2002 if size == 1 else 0x607A, 0, 1, size)
    bench.ask("40 18 10 01 00 00 00 00")
    assert bench.node.next_deadline_ns() is None


def test_complete_segmented_transfer_leaves_no_timeout():
    bench = parted()
    bench.ask("40 00 20 00 00 00 00 00")
    for toggle in ("60", "70", "60", "70"):
        bench.ask(f"{toggle} 00 00 00 00 00 00 00")
    assert bench.node.next_deadline_ns() is None
    bench.wait(3 * SECOND)
    assert bench.frames() == []
