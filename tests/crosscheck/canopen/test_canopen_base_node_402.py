"""canopen's BaseNode402 brings up and operates the drive: an independent reading of CiA 402.

The test writes what BaseNode402 cannot do itself (bits 4, 5 and 6 of the pp handshake).
"""

import canopen
import pytest
from canopen.profiles.p402 import OperationMode, State402

from motorhil.emulators.cia402.settings import EMULATED_MODES, OWN_EDS
from tests.support.canopen.pumped_client import set_up_402
from tests.support.cia402.bench import MS, Bench
from tests.support.cia402.bench_client import connect
from tests.support.cia402.homing_bench import Track


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def client(bench, monkeypatch):
    network, node = connect(bench, str(OWN_EDS), monkeypatch)
    set_up_402(network, node)
    return network, node


def test_client_enables_and_disables_step_by_step(client):
    _, node = client
    assert node.state == "SWITCH ON DISABLED"
    for state in (
        "READY TO SWITCH ON",
        "SWITCHED ON",
        "OPERATION ENABLED",
        "SWITCHED ON",
        "READY TO SWITCH ON",
        "SWITCH ON DISABLED",
    ):
        node.state = state
        assert node.state == state


def test_client_enables_in_one_step(client, bench):
    _, node = client
    node.state = "OPERATION ENABLED"
    assert node.state == "OPERATION ENABLED"
    assert bench.truth("state") == 4


def test_client_completes_pp_moves(client, bench):
    network, node = client
    node.op_mode = "PROFILED POSITION"
    assert node.op_mode == "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    for target, extra in ((20_000, 0x00), (-5_000, 0x20), (1_000, 0x40)):
        node.sdo[0x607A].raw = target
        node.controlword = State402.CW_OPERATION_ENABLED | 0x10 | extra
        assert network.pump_until(lambda: node.statusword & 0x1000, 0.1)
        assert not node.statusword & 0x0400
        node.controlword = State402.CW_OPERATION_ENABLED
        assert network.pump_until(lambda: not node.statusword & 0x1000, 0.1)
        assert network.pump_until(lambda: node.statusword & 0x0400, 3.0)
    assert node.sdo[0x6062].raw == -4_000  # relative to the previous set-point
    assert abs(node.sdo[0x6064].raw + 4_000) <= 10


def test_client_runs_at_a_velocity(client):
    network, node = client
    node.op_mode = "PROFILED VELOCITY"
    node.state = "OPERATION ENABLED"
    node.sdo[0x60FF].raw = -25_000
    assert network.pump_until(lambda: node.check_statusword() & 0x0400, 1.0)
    assert node.sdo[0x606C].raw == pytest.approx(-25_000, abs=2_000)
    node.sdo[0x60FF].raw = 0
    assert network.pump_until(lambda: node.check_statusword() & 0x1000, 1.0)


def test_client_sets_torque_and_changes_mode_in_motion(client, bench):
    network, node = client
    node.op_mode = "PROFILED TORQUE"
    assert node.op_mode == "PROFILED TORQUE"
    node.state = "OPERATION ENABLED"
    node.sdo[0x6087].raw = 20_000
    node.sdo[0x6071].raw = -80
    assert network.pump_until(lambda: node.check_statusword() & 0x0400, 1.0)
    assert node.sdo[0x6074].raw == -80
    assert node.sdo[0x6077].raw == pytest.approx(-80, abs=50)  # tolerance of bit 10: 5 % of 8 A
    network.pump(50 * MS)
    assert bench.truth("velocity_rad_s") < 0
    node.sdo[0x6060].raw = 3  # BaseNode402's setter sends RPDO 2, with a controlword of 0
    assert node.op_mode == "PROFILED VELOCITY"
    assert network.pump_until(lambda: node.check_statusword() & 0x1000, 2.0)  # 60FFh is 0


@pytest.mark.parametrize(
    ("index", "subindex"),
    [(0x60F6, 1), (0x60F6, 2), (0x60F9, 1), (0x60F9, 2), (0x60FB, 1), (0x60FB, 2), (0x60FB, 3)],
)
def test_client_reads_and_writes_the_gains(client, index, subindex):
    _, node = client
    gain = node.sdo[index][subindex]
    before = gain.raw
    assert before > 0
    gain.raw = before // 2
    assert gain.raw == before // 2


@pytest.mark.parametrize(
    "mode",
    [
        "PROFILED POSITION",
        "PROFILED VELOCITY",
        "PROFILED TORQUE",
        "INTERPOLATED POSITION",
        "CYCLIC SYNCHRONOUS POSITION",
        "CYCLIC SYNCHRONOUS VELOCITY",
        "CYCLIC SYNCHRONOUS TORQUE",
    ],
)
def test_each_client_mode_moves_the_motor(client, bench, mode):
    network, node = client
    assert node.is_op_mode_supported(mode)
    node.op_mode = mode
    assert node.op_mode == mode
    node.state = "OPERATION ENABLED"
    node.sdo[0x607A].raw = 2_000
    node.sdo[0x60FF].raw = 8_000
    node.sdo[0x6071].raw = 60
    node.sdo[0x60C2][1].raw = 100
    node.sdo[0x60C1][1].raw = 2_000
    node.controlword = State402.CW_OPERATION_ENABLED | 0x10
    network.pump(300 * MS)
    assert node.sdo[0x6064].raw > 1_000
    bits = node.check_statusword()  # bit 12: the drive follows the command, or ip is active
    assert bits & 0x1000 or mode.startswith("PROFILED")
    if "POSITION" in mode:
        assert node.sdo[0x6064].raw == pytest.approx(2_000, abs=10)
    elif "VELOCITY" in mode:
        assert node.sdo[0x606C].raw == pytest.approx(8_000, rel=0.1)
    else:
        assert node.sdo[0x6077].raw > 10


def test_client_homes_the_drive(client, bench):
    network, node = client
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    node.sdo[0x607A].raw = 3_000
    node.controlword = 0x1F
    network.pump(1000 * MS)
    node.controlword = 0x0F
    node.sdo[0x6098].raw = 37
    assert node.homing() is True
    assert node.op_mode == "HOMING"
    assert node.sdo[0x6064].raw == 0
    assert node.is_homed()


def test_client_homes_over_switches_and_detects_failure(monkeypatch):
    bench = Bench(switches=Track().table())
    network, node = connect(bench, str(OWN_EDS), monkeypatch)
    set_up_402(network, node)
    node.sdo[0x6099][1].raw, node.sdo[0x6099][2].raw = 40_000, 4_000
    for method, where in ((1, -5_300), (26, 400), (18, 6_000), (14, -1_300)):
        node.sdo[0x6098].raw = method
        node.controlword = 0x0F
        assert node.homing() is True
        network.pump(500 * MS)
        assert bench.drive.axis.count() - node.sdo[0x6064].raw == where
        assert node.is_homed()
    bench.drive.stimulate("home", 0, bench.now)
    node.sdo[0x6098].raw = 22
    node.controlword = 0x0F
    assert node.homing() is False
    assert not node.is_homed()


def test_client_resets_a_fault(client, bench):
    network, node = client
    node.state = "OPERATION ENABLED"
    bench.drive.stimulate("fault", 0x2310, bench.now)
    bench._drain()
    assert network.pump_until(lambda: node.state == "FAULT", 1.0)
    assert node.emcy.active[0].code == 0x2310
    assert node.emcy.active[0].register == 0x03
    node.reset_from_fault()
    assert node.state == "OPERATION ENABLED"
    assert node.emcy.active == []


def test_client_mode_not_supported_is_rejected(client):
    _, node = client
    assert not node.is_op_mode_supported("VELOCITY")
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo[0x6060].raw = 2
    assert refused.value.code == 0x0609_0030


def test_client_quick_stop_from_operation_enabled(client):
    _, node = client
    node.sdo[0x605A].raw = 6
    node.state = "OPERATION ENABLED"
    node.state = "QUICK STOP ACTIVE"
    assert node.state == "QUICK STOP ACTIVE"
    node.state = "OPERATION ENABLED"  # transition 16
    assert node.state == "OPERATION ENABLED"


def test_client_sees_boot_up_and_every_nmt_state_change(client, bench):
    network, node = client
    heard = []
    node.nmt.add_heartbeat_callback(heard.append)
    node.sdo[0x1017].raw = 10
    for command, state in (
        ("STOPPED", 4),
        ("PRE-OPERATIONAL", 127),
        ("OPERATIONAL", 5),
        ("RESET COMMUNICATION", 0),
    ):
        heard.clear()
        node.nmt.state = command
        network.pump(25 * MS)
        assert set(heard) == {state}
    assert node.nmt.state == "PRE-OPERATIONAL"  # the state after a boot-up


def test_modes_the_client_finds_are_those_of_the_drive(client):
    """Compare canopen's names and codes of modes (p402.OperationMode) with 6502h and 6060h."""
    _, node = client
    names = [name for name in OperationMode.SUPPORTED if name != "NO MODE"]
    found = [name for name in names if node.is_op_mode_supported(name)]
    assert sorted(OperationMode.NAME2CODE[name] for name in found) == sorted(
        EMULATED_MODES.values()
    )
    for name in found:
        node.op_mode = name
        assert node.op_mode == name
        assert node.sdo[0x6061].raw == OperationMode.NAME2CODE[name]


def test_client_remaps_the_pdos_and_uses_them(client):
    """Use read(), clear(), add_variable(), save(): 1800h and 1A00h by the standard's procedure."""
    network, node = client
    node.nmt.state = "PRE-OPERATIONAL"
    node.tpdo.read()
    assert [variable.index for variable in node.tpdo[1].map] == [0x6041]
    for pdo, kind, variables in (
        (node.tpdo[3], 255, (0x6041, 0x60F4)),
        (node.tpdo[4], 1, (0x6041, 0x6061, 0x6064)),
        (node.rpdo[4], 1, (0x6040, 0x6060, 0x60FF)),
    ):
        pdo.clear()
        for index in variables:
            pdo.add_variable(index)
        pdo.trans_type, pdo.event_timer = kind, 20 if kind == 255 else None
        pdo.enabled = True
        pdo.save()
    node.tpdo.read()
    node.rpdo.read()
    assert [one.index for one in node.tpdo[4].map] == [0x6041, 0x6061, 0x6064]
    assert [one.index for one in node.rpdo[4].map] == [0x6040, 0x6060, 0x60FF]
    node.nmt.state = "OPERATIONAL"
    heard = []
    node.tpdo[4].add_callback(lambda pdo: heard.append([one.raw for one in pdo.map]))
    for word in (0x06, 0x07, 0x0F, 0x0F):
        for variable, value in zip(node.rpdo[4].map, (word, 3, 9_000), strict=True):
            variable.raw = value
        node.rpdo[4].transmit()
        network.send_message(0x080, b"")
        network.pump(30 * MS)
    assert heard[-1][0] & 0x6F == State402.SW_MASK["OPERATION ENABLED"][1]
    assert heard[-1][1] == 3
    network.pump(200 * MS)
    network.send_message(0x080, b"")
    network.pump(1 * MS)
    assert heard[-1][2] > 1_000
    assert abs(node.tpdo[3].map[1].raw) < 500  # following error actual value, every 20 ms


def test_client_needs_tpdos_that_come_regularly(bench, monkeypatch):
    """docs/how-to/use-base-node-402.md names the two causes."""
    network, node = connect(bench, str(OWN_EDS), monkeypatch)
    set_up_402(network, node, cyclic_tpdos=())
    assert node.sdo[0x6061].raw == 1
    assert node.op_mode == "NO MODE"
    for word in (0x06, 0x07):
        node.controlword = word
        network.pump(50 * MS)
    with pytest.raises(RuntimeError, match="Timeout waiting for updated statusword"):
        node.check_statusword()


def test_client_works_with_event_timers_of_the_rig(monkeypatch):
    bench = Bench(objects={"1800h:5": 20, "1801h:5": 20})
    network, node = connect(bench, str(OWN_EDS), monkeypatch)
    set_up_402(network, node, cyclic_tpdos=())
    node.op_mode = "PROFILED POSITION"
    assert node.op_mode == "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    node.sdo[0x607A].raw = 20_000
    node.controlword = State402.CW_OPERATION_ENABLED | 0x10
    assert network.pump_until(lambda: node.statusword & 0x1000, 0.1)
    node.controlword = State402.CW_OPERATION_ENABLED
    network.pump(50 * MS)
    assert network.pump_until(lambda: node.statusword & 0x0400, 3.0)
    assert node.sdo[0x6062].raw == 20_000
