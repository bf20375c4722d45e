"""Storing and restoring (CiA 301, 1010h and 1011h): signatures, ranges, timing."""

import zlib

import canopen
import pytest
from canopen.sdo.exceptions import SdoAbortedError

from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import NodeTiming
from motorhil.emulators.controller import RigMemory
from tests.support.canopen.client_loop import Loop
from tests.support.canopen.node_bench import (
    INTEGER32,
    MS,
    NODE_ID,
    UNSIGNED8,
    UNSIGNED16,
    UNSIGNED32,
    Bench,
    dictionary,
    put,
)

# The signatures as bytes on the wire: ISO 8859-1 "save" and "load" (CiA 301, 7.5.2.13, 7.5.2.14).
SAVE = "73 61 76 65"
LOAD = "6C 6F 61 64"
ACCEPTED, NOT_STORED, HARDWARE = "", "0800 0020", "0606 0000"


def whole() -> ObjectDictionary:
    """Return 1010h and 1011h with four sub-indices, and a parameter of each range."""
    od = dictionary()
    for index in (0x1010, 0x1011):
        put(od, index, 0, UNSIGNED8, 4, "ro")
        for subindex in (1, 2, 3, 4):
            put(od, index, subindex, UNSIGNED32, 1)
    put(od, 0x2100, 0, UNSIGNED16, 10)
    put(od, 0x6083, 0, UNSIGNED32, 20)
    put(od, 0x60FF, 0, INTEGER32, 0)
    return od


class Powered(Bench):
    """A bench whose node can lose its power; stored values stay."""

    def __init__(self, memory: RigMemory | None = None, od: ObjectDictionary | None = None) -> None:
        self.memory = RigMemory() if memory is None else memory
        super().__init__(whole() if od is None else od)
        self.plug_in()

    def plug_in(self) -> None:
        timing = NodeTiming(300 * MS, 1 * MS, 20 * MS)
        self.node = CanopenNode(self.od, NODE_ID, timing, self.host, self.memory)
        self.node.start(self.now_ns)
        self.wait(301 * MS)
        self.frames()

    def command(self, index: int, subindex: int, signature: str) -> str:
        return self.download(index, subindex, int.from_bytes(bytes.fromhex(signature), "little"), 4)

    def nmt(self, specifier: int) -> None:
        self.tell(0x000, bytes((specifier, NODE_ID)))
        self.wait(400 * MS)

    def change(self) -> None:
        assert self.download(0x1017, 0, 500, 2) == ""
        assert self.download(0x2100, 0, 11, 2) == ""
        assert self.download(0x6083, 0, 21, 4) == ""

    def values(self) -> list[int]:
        return [self.od.integer(index, 0, -1) for index in (0x1017, 0x2100, 0x6083)]


BEFORE, CHANGED = [0, 10, 20], [500, 11, 21]


@pytest.mark.parametrize(
    ("subindex", "kept"),
    [
        (1, CHANGED),
        (2, [500, 10, 20]),  # communication
        (3, [0, 10, 21]),  # application
        (4, [0, 11, 20]),  # manufacturer
    ],
)
def test_saved_values_are_power_on_values(subindex, kept):
    bench = Powered()
    bench.change()
    assert bench.command(0x1010, subindex, SAVE) == ACCEPTED
    bench.nmt(129)
    assert bench.values() == kept
    bench.plug_in()
    assert bench.values() == kept


def test_unsaved_values_are_lost_at_reset():
    bench = Powered()
    bench.change()
    bench.nmt(129)
    assert bench.values() == BEFORE


def test_reset_communication_restores_saved_communication_only():
    bench = Powered()
    bench.change()
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    assert bench.download(0x1017, 0, 700, 2) == ""
    assert bench.download(0x6083, 0, 99, 4) == ""
    bench.nmt(130)
    assert bench.values() == [500, 11, 99]


@pytest.mark.parametrize(
    ("subindex", "left"),
    [(1, BEFORE), (2, [0, 11, 21]), (3, [500, 11, 20]), (4, [500, 10, 21])],
)
def test_restore_takes_effect_at_next_reset(subindex, left):
    bench = Powered()
    bench.change()
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    assert bench.command(0x1011, subindex, LOAD) == ACCEPTED
    assert bench.values() == CHANGED
    bench.nmt(129)
    assert bench.values() == left
    bench.plug_in()
    assert bench.values() == left


@pytest.mark.parametrize("index", [0x1010, 0x1011])
@pytest.mark.parametrize("signature", ["73 61 76 66", "65 76 61 73", "00 00 00 00", "01 00 00 00"])
def test_wrong_signature_is_refused_without_effect(index, signature):
    bench = Powered()
    bench.change()
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    kept = bench.memory.load()
    assert bench.command(index, 1, signature) == NOT_STORED
    assert bench.memory.load() == kept


def test_signatures_of_save_and_load_are_not_exchangeable():
    bench = Powered()
    assert bench.command(0x1010, 1, LOAD) == NOT_STORED
    assert bench.command(0x1011, 1, SAVE) == NOT_STORED


@pytest.mark.parametrize("index", [0x1010, 0x1011])
def test_read_returns_on_command(index):
    bench = Powered()
    assert bench.command(index, 1, SAVE if index == 0x1010 else LOAD) == ACCEPTED
    mux = f"{index & 0xFF:02X} 10 01"
    assert bench.ask(f"40 {mux} 00 00 00 00") == f"43 {mux} 01 00 00 00"  # bit 0: on command


def test_failing_memory_is_hardware_error():
    bench = Powered()
    bench.memory = Failing()
    bench.plug_in()
    bench.change()
    assert bench.command(0x1010, 1, SAVE) == HARDWARE
    bench.nmt(129)
    assert bench.values() == BEFORE


def test_set_points_commands_and_errors_are_not_stored():
    bench = Powered()
    for index, value, size in ((0x6040, 0x0F, 2), (0x607A, 5, 4), (0x60FF, 6, 4)):
        assert bench.download(index, 0, value, size) == ""
    bench.node.emergency(0x8611, 0x20, b"", bench.now_ns)
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    bench.plug_in()
    assert [bench.od.integer(index, 0, -1) for index in (0x6040, 0x607A, 0x60FF)] == [0, 0, 0]
    assert bench.od.integer(0x1003, 0, -1) == 0


def test_canopen_client_stores_and_restores():
    """The client uses its own signatures (`BaseNode402`, `RemoteNode.store`, `.restore`)."""
    bench = Powered()
    remote = Loop(bench).remote
    remote.sdo[0x6083].raw = 21
    remote.store()
    bench.plug_in()
    assert remote.sdo[0x6083].raw == 21
    remote.restore()
    bench.plug_in()
    assert remote.sdo[0x6083].raw == 20
    with pytest.raises(SdoAbortedError) as refused:
        remote.sdo[0x1010][1].raw = 0x1234
    assert refused.value.code == 0x08000020
    assert isinstance(remote, canopen.RemoteNode)


# --- values stored by another rig


def stored() -> bytes:
    bench = Powered()
    bench.change()
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    return bench.memory.load()


def with_memory(data: bytes, od: ObjectDictionary | None = None) -> Powered:
    memory = RigMemory()
    memory.save(data)
    return Powered(memory, od)


def test_loaded_values_are_reported_with_checksum():
    bench = with_memory(stored())
    assert bench.values() == CHANGED
    ((level, text),) = bench.node.take_events()
    assert level == "info"
    assert text.startswith("3 stored values, of the rig's own memory (CRC ")
    assert with_memory(stored()).node.take_events() == [(level, text)]  # and always the same


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda data: data[:-20], "it ends early"),
        (lambda data: data[:-1], "it ends early"),
        (lambda data: data.replace(b"6083:00 15", b"6083:00 16"), "its CRC is wrong"),
        (lambda data: b"\x00" * 100, "it does not begin with"),
        (lambda data: b"motorhil parameters 1\n", "it ends early"),
        (lambda data: resigned(data, b"1017:00", b"101x:00"), "is no stored value"),
        (lambda data: resigned(data, b"1017:00", b"node_id 300\n1017:00"), "is no stored value"),
        (lambda data: resigned(data, b"1017:00", b"bit_timing 9\n1017:00"), "is no stored value"),
    ],
)
def test_damaged_text_is_reported_and_left_out(spoil, reason):
    bench = with_memory(spoil(stored()))
    assert bench.values() == BEFORE
    ((level, text),) = bench.node.take_events()
    assert level == "warning"
    assert reason in text
    assert text.endswith("; save again (1010h)")


def resigned(data: bytes, old: bytes, new: bytes) -> bytes:
    """Return the text with a valid checksum, as a deliberate edit would produce it."""
    assert old in data
    text = data[: data.rfind(b"end ")].replace(old, new)
    return text + b"end 3 %08X\n" % zlib.crc32(text)


@pytest.mark.parametrize("theirs", [b"from motorhil import motorapi\n", bytes(range(256)), None])
def test_foreign_text_is_never_overwritten(theirs):
    od = whole()
    if theirs is None:
        theirs = stored()
        od.get(0x1018, 1).default = 5
    bench = with_memory(theirs, od)
    ((_, text),) = bench.node.take_events()
    assert text.endswith("; it stays as it is, name another")
    assert bench.command(0x1010, 1, SAVE) == HARDWARE
    assert bench.command(0x1011, 1, LOAD) == HARDWARE
    assert bench.memory.load() == theirs
    told = ("warning", "nothing is stored, the rig's own memory is not this device's")
    assert bench.node.take_events() == [told, told]


def test_prefix_of_text_is_refused():
    data = stored()
    for length in range(1, len(data)):
        assert with_memory(data[:length]).values() == BEFORE


def test_parameters_of_other_device_are_left_out():
    od = whole()
    od.get(0x1018, 1).default = 5
    bench = with_memory(stored(), od)
    assert bench.values() == BEFORE
    ((level, text),) = bench.node.take_events()
    assert (level, "another device's" in text) == ("warning", True)


def test_value_at_its_limit_fits():
    od = whole()
    od.get(0x6083).low = od.get(0x6083).high = 21
    bench = with_memory(stored(), od)
    assert bench.values() == CHANGED
    assert [level for level, _ in bench.node.take_events()] == ["info"]


def test_store_and_restore_commands_are_not_stored():
    bench = Powered()
    bench.change()
    assert bench.command(0x1011, 1, LOAD) == ACCEPTED
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    places = [line[:4] for line in bench.memory.load().decode().splitlines() if line[4:5] == ":"]
    assert places == ["1017", "2100", "6083"]


def test_unfitting_value_is_reported_and_others_are_used():
    od = whole()
    od.get(0x6083).high = 20
    put(od, 0x2100, 0, UNSIGNED8, 10)
    bench = with_memory(stored(), od)
    assert bench.values() == [500, 10, 20]
    warnings = [text for level, text in bench.node.take_events() if level == "warning"]
    assert [text.split(": ")[1][:10] for text in warnings] == ["2100h:00h ", "6083h:00h "]


class Failing:
    """A memory that cannot be written."""

    def load(self) -> bytes:
        return b""

    def save(self, data: bytes) -> bool:
        return False

    def where(self) -> str:
        return "a broken memory"


def test_storage_modes_of_the_file_are_served():
    """1010h and 1011h show how the device stores: 3 is on command and by itself (CiA 301)."""
    od = whole()
    put(od, 0x1010, 1, UNSIGNED32, 3)
    put(od, 0x1011, 4, UNSIGNED32, 0)
    bench = Powered(od=od)
    assert bench.ask("40 10 10 01 00 00 00 00") == "43 10 10 01 03 00 00 00"
    assert bench.ask("40 11 10 04 00 00 00 00") == "43 11 10 04 00 00 00 00"
    assert bench.command(0x1010, 1, SAVE) == ACCEPTED
    assert bench.ask("40 10 10 01 00 00 00 00") == "43 10 10 01 03 00 00 00"
