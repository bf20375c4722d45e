"""LSS slave (CiA 305): golden bytes, and effects of a node-ID."""

import pytest

from motorhil.emulators.canopen.lss import UNCONFIGURED
from motorhil.emulators.canopen.nmt import NmtState
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import NodeTiming
from motorhil.emulators.controller import RigMemory
from tests.support.canopen.node_bench import (
    MS,
    NODE_ID,
    UNSIGNED32,
    Bench,
    Host,
    dictionary,
    put,
    put_pdo,
)

MASTER, SLAVE = 0x7E5, 0x7E4
# 1018h:1 to :4, with different last bytes
ADDRESS = (0x0102_0304, 0x1122_3344, 0x0001_0000, 0x0000_00C5)


def with_address() -> ObjectDictionary:
    od = dictionary()
    for subindex, number in enumerate(ADDRESS, start=1):
        put(od, 0x1018, subindex, UNSIGNED32, number, "ro")
    put_pdo(od, 0x1400, (0x6040_0010,), 255)
    put_pdo(od, 0x1800, (0x6041_0010,), 1)
    od.get(0x1014).follows_node_id = True  # as $NODEID+0x80 in a file
    od.node_id = NODE_ID
    od.supports_lss = True
    return od


class LssBench(Bench):
    def __init__(self, node_id: int = NODE_ID, memory: RigMemory | None = None) -> None:
        super().__init__(with_address())
        self.memory = RigMemory() if memory is None else memory
        self.plug_in(node_id)

    def plug_in(self, node_id: int = NODE_ID) -> None:
        self.host = Host()
        timing = NodeTiming(300 * MS, 1 * MS, 20 * MS)
        self.node = CanopenNode(with_address(), node_id, timing, self.host, self.memory)
        self.od = self.node.od
        self.node.start(self.now_ns)
        self.wait(301 * MS)
        self.frames()

    def lss(self, request: str) -> str:
        """Send one request, padded with zeros, and return the responses in the reply time."""
        self.tell(MASTER, bytes.fromhex(request).ljust(8, b"\0"))
        self.wait(1 * MS)
        answers = [text[4:] for text in self.frames() if text.startswith("7E4 ")]
        assert len(answers) <= 1
        return answers[0].removesuffix(" 00" * 6) if answers else ""

    def configure(self) -> "LssBench":
        self.lss("04 01")
        return self


def number(value: int) -> str:
    return value.to_bytes(4, "little").hex(" ")


def select(bench: LssBench, address: tuple[int, ...]) -> str:
    answers = [bench.lss(f"4{place} {number(part)}") for place, part in enumerate(address)]
    assert answers[:3] == ["", "", ""]
    return answers[3]


def test_slave_is_selected_by_its_whole_address_only():
    for place in range(4):
        bench = LssBench()
        wrong = [part + (at == place) for at, part in enumerate(ADDRESS)]
        assert select(bench, tuple(wrong)) == ""
        assert bench.lss("5E") == ""  # still waiting
    assert select(bench, ADDRESS) == "44 00"
    assert bench.lss("5E") == "5E 02"


def test_address_out_of_order_selects_no_slave():
    bench = LssBench()
    for place in (1, 0, 2, 3):
        assert bench.lss(f"4{place} {number(ADDRESS[place])}") == ""
    assert bench.lss("43 " + number(ADDRESS[3])) == ""


def test_address_is_reported_in_configuration_only():
    bench = LssBench()
    requests = ["5A", "5B", "5C", "5D"]
    assert [bench.lss(request) for request in requests] == [""] * 4
    bench.configure()
    for request, part in zip(requests, ADDRESS, strict=True):
        told = bytes.fromhex(bench.lss(request)).ljust(8, b"\0")
        assert told == bytes.fromhex(request) + part.to_bytes(4, "little") + bytes(3)
    bench.lss("04 00")
    assert bench.lss("5A") == ""


@pytest.mark.parametrize(
    ("node_id", "answer"),
    [("01", "11 00"), ("7F", "11 00"), ("FF", "11 00"), ("00", "11 01"), ("80", "11 01")],
)
def test_node_id_is_1_to_127_or_255(node_id, answer):
    assert LssBench().configure().lss(f"11 {node_id}") == answer


@pytest.mark.parametrize(
    ("table", "answer"),
    [
        *(("00 00", "13 00"), ("00 08", "13 00")),
        *(("00 05", "13 01"), ("00 09", "13 01"), ("01 00", "13 01")),
    ],
)
def test_bit_timing_is_index_of_table_0(table, answer):
    assert LssBench().configure().lss(f"13 {table}") == answer


def test_bit_timing_is_reported_and_stored():
    bench = LssBench().configure()
    assert bench.lss("13 00 03") == "13 00"
    bench.node.take_events()
    assert bench.lss("15") == ""
    ((_, text),) = bench.node.take_events()
    assert "bit timing 3 (250 kbit/s)" in text  # CiA 305, table 0
    assert bench.lss("17") == "17 00"
    assert b"bit_timing 3\n" in bench.memory.load()


def test_new_node_id_is_active_after_reset_communication():
    bench = LssBench().configure()
    assert bench.lss("11 21") == "11 00"
    assert bench.lss("5E") == "5E 02"
    bench.lss("04 00")
    assert bench.node.node_id == 2
    bench.tell(0x000, b"\x82\x02")
    bench.wait(20 * MS)
    assert bench.frames() == ["721 00"]
    bench.tell(0x000, b"\x01\x21")
    bench.tell(0x080)
    assert bench.frames() == ["1A1 40 02"]
    bench.tell(0x221, "0F 00")
    assert bench.od.integer(0x6040, 0, 0) == 0x0F
    bench.tell(0x621, "40 14 10 00 00 00 00 00")
    bench.wait(1 * MS)
    assert bench.frames() == ["5A1 43 14 10 00 A1 00 00 00"]
    bench.node.emergency(0x8611, 0x20, b"", bench.now_ns)
    bench.drain()
    assert bench.frames() == ["0A1 11 86 21 00 00 00 00 00"]
    bench.tell(0x4000_0721)  # guarded by its new node-ID
    assert bench.frames() == ["721 05"]
    bench.tell(0x602, "40 14 10 00 00 00 00 00")
    bench.tell(0x000, b"\x02\x02")
    bench.wait(5 * MS)
    assert bench.frames() == []
    assert bench.node.state == NmtState.OPERATIONAL
    assert list(bench.node.identifiers()) == [
        *(0x000, 0x080, 0x221, 0x621, 0x7E5),
        0x2000_0000,  # error messages
        *(0x4000_01A1, 0x4000_0721),  # remote frames
    ]


def test_stored_cob_id_does_not_follow_node_id():
    memory = RigMemory()
    bench = LssBench(memory=memory)
    bench.node._store.stored.values[0x1400_01] = bytes.fromhex("33 03 00 00")
    bench.configure().lss("11 21")
    assert bench.lss("17") == "17 00"
    bench.plug_in()
    bench.tell(0x000, b"\x01\x21")
    bench.tell(0x333, "0F 00")
    assert bench.od.integer(0x6040, 0, 0) == 0x0F


def test_stored_node_id_is_active_after_power_on():
    bench = LssBench().configure()
    bench.lss("11 21")
    bench.lss("13 00 04")
    bench.plug_in()
    assert bench.node.node_id == 2  # it was not stored
    bench.configure().lss("11 21")
    assert bench.lss("17") == "17 00"
    bench.plug_in()
    assert bench.node.node_id == 0x21


def test_failing_memory_is_reported():
    class Failing:
        def load(self) -> bytes:
            return b""

        def save(self, data: bytes) -> bool:
            return False

        def where(self) -> str:
            return "nowhere"

    assert LssBench(memory=Failing()).configure().lss("17") == "17 02"


def test_slave_identifies_within_revision_and_serial_ranges():
    bench = LssBench()
    vendor, product, revision, serial = ADDRESS

    def identify(*parts: int) -> str:
        answers = [bench.lss(f"{0x46 + at:02X} {number(part)}") for at, part in enumerate(parts)]
        return answers[-1]

    assert identify(vendor, product, revision, revision, serial, serial) == "4F 00"
    assert identify(vendor, product, 0, 0xFFFF_FFFF, 0, 0xFFFF_FFFF) == "4F 00"
    assert identify(vendor, product + 1, 0, 0xFFFF_FFFF, 0, 0xFFFF_FFFF) == ""
    assert identify(vendor, product, 0, revision - 1, 0, 0xFFFF_FFFF) == ""
    assert identify(vendor, product, revision + 1, revision + 1, 0, 0xFFFF_FFFF) == ""
    assert identify(vendor, product, 0, 0xFFFF_FFFF, 0, serial - 1) == ""
    assert identify(vendor, product, 0, 0xFFFF_FFFF, serial + 1, 0xFFFF_FFFF) == ""


def test_identify_unconfigured_needs_missing_node_id():
    assert LssBench().lss("4C") == ""
    assert LssBench().lss("51 00 00 00 00 80") == ""
    assert LssBench(UNCONFIGURED).lss("4C") == "50 00"
    assert LssBench(UNCONFIGURED).lss("51 00 00 00 00 80") == "4F 00"


def test_node_without_node_id_supports_lss_only():
    bench = LssBench(UNCONFIGURED)
    bench.wait(1000 * MS)
    bench.tell(0x000, b"\x01\x00")
    for node_id in (1, 0x7F):
        bench.tell(0x600 + node_id, "40 00 10 00 00 00 00 00")
    bench.wait(10 * MS)
    assert bench.frames() == []
    assert bench.host.calls == [("reset", True, bench.host.calls[0][2])]
    assert bench.configure().lss("5E") == "5E FF"
    assert bench.lss("11 05") == "11 00"
    assert bench.lss("4C") == ""  # it has a pending node-ID
    assert bench.lss("04 00") == ""
    bench.wait(20 * MS)
    assert bench.frames() == ["705 00"]
    bench.tell(0x605, "40 14 10 00 00 00 00 00")
    bench.wait(1 * MS)
    assert bench.frames() == ["585 43 14 10 00 85 00 00 00"]


def test_slave_with_different_bit_is_silent_in_fastscan():
    bench = LssBench(UNCONFIGURED)
    bench.lss("51 00 00 00 00 80")
    vendor = ADDRESS[0]
    for bit in range(31, -1, -1):
        asked = vendor >> bit << bit
        assert bench.lss(f"51 {number(asked)} {bit:02X} 00 00") == "4F 00"
        assert bench.lss(f"51 {number(asked ^ 1 << bit)} {bit:02X} 00 00") == ""
    assert bench.lss(f"51 {number(ADDRESS[1])} 00 01 02") == ""  # too early: another number is due
    for wrong in ("20 00 00", "00 04 00", "00 00 04"):
        assert bench.lss(f"51 {number(vendor)} {wrong}") == ""


@pytest.mark.parametrize("specifier", [1, 2, 128])
def test_lss_works_in_any_nmt_state(specifier):
    bench = LssBench()
    bench.tell(0x000, bytes((specifier, NODE_ID)))
    bench.frames()
    assert bench.configure().lss("5E") == "5E 02"


def test_lss_frame_needs_8_bytes():
    bench = LssBench()
    bench.tell(MASTER, "04 01")
    assert bench.lss("5E") == ""


def test_device_without_lss_in_file_ignores_it():
    bench = Bench().boot()
    assert MASTER not in bench.node.identifiers()
    bench.tell(MASTER, "04 01 00 00 00 00 00 00")
    bench.tell(MASTER, "5E 00 00 00 00 00 00 00")
    bench.wait(10 * MS)
    assert bench.frames() == []


@pytest.mark.parametrize("command", [0x81, 0x82])
def test_slave_waits_after_any_reset(command):
    """CiA 305: the LSS state machine restarts in LSS waiting, as in CANopenNode's slave."""
    bench = LssBench().configure()
    assert bench.lss("5E") == "5E 02"
    assert bench.lss("11 21") == "11 00"
    bench.tell(0x000, bytes((command, 0)))
    bench.wait(400 * MS)
    assert bench.frames() == (["721 00"] if command == 0x82 else ["702 00"])
    assert bench.lss("5E") == ""
    assert bench.lss("5A") == ""


def test_incomplete_selection_ends_at_reset():
    bench = LssBench()
    for command, number in zip((0x40, 0x41, 0x42), ADDRESS, strict=False):
        assert bench.lss((bytes((command,)) + number.to_bytes(4, "little")).hex()) == ""
    bench.tell(0x000, b"\x82\x00")
    bench.wait(400 * MS)
    bench.frames()
    assert bench.lss((b"\x43" + ADDRESS[3].to_bytes(4, "little")).hex()) == ""
    assert bench.lss("5E") == ""
