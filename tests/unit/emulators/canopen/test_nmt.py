"""NMT (CiA 301, 7.3.2): boot-up, the four states, and their services."""

import pytest

from motorhil.emulators.canopen.nmt import NmtState
from motorhil.emulators.canopen.node import CanopenNode
from motorhil.emulators.canopen.object_dictionary import ObjectDictionary
from motorhil.emulators.canopen.outbox import NodeTiming
from tests.support.canopen.node_bench import MS, NODE_ID, Bench, Host, dictionary, put_pdo

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
GUARD = 0x4000_0700 + NODE_ID  # the remote frame that guards the node
ERROR = 0x2000_0000  # error messages
UPLOAD = "40 18 10 01 00 00 00 00"


def command(bench: Bench, specifier: int, node_id: int = NODE_ID) -> None:
    bench.tell(0x000, bytes((specifier, node_id)))


def test_boot_up_comes_after_boot_time_into_pre_operational():
    bench = Bench()
    assert bench.node.next_deadline_ns() == 300 * MS
    bench.run(300 * MS - 1)
    assert bench.heard() == []
    assert bench.node.state == NmtState.INITIALISING
    bench.run(300 * MS)
    assert bench.heard() == [(300 * MS, "702 00")]  # CiA 301: 700h + node-ID, one byte 0
    assert bench.node.state == NmtState.PRE_OPERATIONAL
    assert bench.node.next_deadline_ns() is None
    assert bench.host.calls == [("reset", True, 0), ("nmt", 0x7F, 300 * MS)]


def test_frames_before_boot_up_are_ignored():
    bench = Bench()
    bench.run(100 * MS)
    command(bench, START)
    bench.tell(0x602, UPLOAD)
    bench.run(299 * MS)
    assert bench.heard() == []
    assert bench.node.state == NmtState.INITIALISING


@pytest.mark.parametrize(
    ("path", "state"),
    [
        ([START], NmtState.OPERATIONAL),
        ([STOP], NmtState.STOPPED),
        ([START, PRE_OPERATIONAL], NmtState.PRE_OPERATIONAL),
        ([START, STOP], NmtState.STOPPED),
        ([STOP, START], NmtState.OPERATIONAL),
        ([STOP, PRE_OPERATIONAL], NmtState.PRE_OPERATIONAL),
        ([RESET_NODE], NmtState.INITIALISING),
        ([START, RESET_NODE], NmtState.INITIALISING),
        ([STOP, RESET_COMMUNICATION], NmtState.INITIALISING),
        ([START, RESET_COMMUNICATION], NmtState.INITIALISING),
        ([3], NmtState.PRE_OPERATIONAL),  # unknown command
        ([START, START], NmtState.OPERATIONAL),
    ],
)
def test_command_leads_to_standard_state(path, state):
    bench = Bench().boot()
    for specifier in path:
        command(bench, specifier)
    assert bench.node.state == state
    changes = [call for call in bench.host.calls if call[0] == "nmt"]
    assert len(changes) == len([s for i, s in enumerate(path) if s != 3 and s not in path[:i]])


def test_command_for_other_node_or_length_is_ignored():
    bench = Bench().boot()
    command(bench, START, NODE_ID + 1)
    bench.tell(0x000, bytes((START,)))
    bench.tell(0x000, bytes((START, NODE_ID, 0)))
    assert bench.node.state == NmtState.PRE_OPERATIONAL
    command(bench, START, 0)  # all nodes
    assert bench.node.state == NmtState.OPERATIONAL


@pytest.mark.parametrize(
    ("path", "sdo", "pdo", "emcy"),
    [
        ([], True, False, True),
        ([START], True, True, True),
        ([STOP], False, False, False),
        ([RESET_NODE], False, False, False),
    ],
)
def test_service_works_in_standard_states(path, sdo, pdo, emcy):  # CiA 301, table 38
    od = dictionary()
    put_pdo(od, 0x1400, (0x6040_0010,), 255)
    put_pdo(od, 0x1800, (0x6041_0010,), 1)
    bench = Bench(od).boot()
    for specifier in path:
        command(bench, specifier)
    assert (bench.ask(UPLOAD) != "") == sdo
    bench.frames()
    bench.tell(0x202, "0F 00")
    assert (od.integer(0x6040, 0, 0) == 0x0F) == pdo
    bench.tell(0x080)
    assert ("sync" in bench.host.names()) == pdo
    assert ("182 40 02" in bench.frames()) == pdo
    bench.node.emergency(0x8611, 0x20, b"", bench.now_ns)
    bench.drain()
    assert (bench.frames() == ["082 11 86 21 00 00 00 00 00"]) == emcy


def test_pending_response_is_dropped_when_sdo_ends():
    bench = Bench().boot()
    bench.tell(0x602, UPLOAD)
    command(bench, STOP)
    bench.wait(10 * MS)
    assert bench.frames() == []
    assert bench.node.next_deadline_ns() is None


def test_reset_communication_restores_1000h_to_1fffh_only():
    bench = Bench().boot()
    assert bench.download(0x607A, 0, 1234, 4) == ""
    assert bench.download(0x1017, 0, 50, 2) == ""
    bench.wait(1)
    bench.host.calls.clear()
    bench.frames()
    reset_at = bench.now_ns
    command(bench, RESET_COMMUNICATION)
    assert bench.host.calls == [("nmt", 0, reset_at), ("reset", False, reset_at)]
    bench.wait(100 * MS)
    assert bench.heard() == [(reset_at + 20 * MS, "702 00")]  # and no heartbeat
    assert bench.od.integer(0x607A, 0, 0) == 1234
    assert bench.od.integer(0x1017, 0, 1) == 0


def test_reset_node_restores_all_without_writers():
    bench = Bench().boot()
    assert bench.download(0x607A, 0, 1234, 4) == ""
    bench.od.get(0x607A).writer = lambda value: pytest.fail("a reset asks no writer")
    reset_at = bench.now_ns
    command(bench, RESET_NODE, 0)
    assert bench.od.integer(0x607A, 0, 1) == 0
    bench.run(reset_at + 300 * MS)
    assert bench.heard() == [(reset_at + 300 * MS, "702 00")]


def test_remote_and_extended_frames_are_ignored():
    bench = Bench().boot()
    for flag in (0x4000_0000, 0x8000_0000):
        bench.tell(0x000 | flag, bytes((START, 0)))
        bench.tell(0x602 | flag, UPLOAD)
    bench.wait(5 * MS)
    assert bench.frames() == []
    assert bench.node.state == NmtState.PRE_OPERATIONAL


def test_identifiers_change_increments_revision():
    od = dictionary()
    put_pdo(od, 0x1400, (0x6040_0010,))
    bench = Bench(od)
    assert list(bench.node.identifiers()) == [0x000, 0x080, 0x202, 0x602, ERROR, GUARD]
    revision = bench.node.identifiers_revision()
    bench.operate()
    assert bench.node.identifiers_revision() == revision
    assert bench.download(0x1400, 1, 0x8000_0202, 4) == ""
    assert bench.download(0x1400, 1, 0x0000_0333, 4) == ""
    assert bench.download(0x1016, 1, 0x0005_0064, 4) == ""
    assert bench.download(0x1005, 0, 0x0000_0081, 4) == ""
    assert list(bench.node.identifiers()) == [0x000, 0x081, 0x333, 0x602, 0x705, ERROR, GUARD]
    assert bench.node.identifiers_revision() > revision


@pytest.mark.parametrize("node_id", [0, 128])
def test_node_id_outside_1_to_127_is_refused(node_id):
    with pytest.raises(ValueError, match=r"1\.\.127"):
        CanopenNode(dictionary(), node_id, NodeTiming(), Host())


def test_empty_dictionary_gives_node_with_standard_defaults():
    bench = Bench(ObjectDictionary()).operate()
    bench.tell(0x080)
    assert ("sync", bench.now_ns) in bench.host.calls
    bench.node.emergency(0x8611, 0x20, b"", bench.now_ns)
    bench.drain()
    assert bench.frames() == ["082 11 86 21 00 00 00 00 00"]
    assert bench.ask("40 05 10 00 00 00 00 00") == "80 05 10 00 00 00 02 06"  # but invisible
    assert bench.ask("40 14 10 00 00 00 00 00") == "80 14 10 00 00 00 02 06"
