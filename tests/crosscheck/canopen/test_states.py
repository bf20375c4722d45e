"""The PDS FSA over the bus: commands in all states, statuswords.

Expected: CiA 402-2's state machine by canopen's table of transitions (p402.State402), and the state
coding of Kollmorgen's AKD manual and canopen; bits 10, 12 and 13 per mode.
"""

import itertools

import pytest
from canopen.profiles.p402 import State402

from tests.support.canopen.drive_wire import MS, Wire

SOD, RTSO, SO, OE, QSA = (
    "SWITCH ON DISABLED",
    "READY TO SWITCH ON",
    "SWITCHED ON",
    "OPERATION ENABLED",
    "QUICK STOP ACTIVE",
)
FAULT = "FAULT"
PATH = {SOD: (), RTSO: (0x06,), SO: (0x06, 0x07), OE: (0x06, 0x07, 0x0F)}
COMMANDS = {"shutdown": 0x06, "switch on": 0x07, "enable": 0x0F, "quick stop": 0x02, "off": 0x00}
# By command; switch on in OPERATION ENABLED is "disable operation"; enable from READY TO SWITCH ON
# passes SWITCHED ON automatically (CiA 402-2 allows this).
AFTER = {
    SOD: {"shutdown": RTSO},
    RTSO: {"switch on": SO, "enable": OE, "quick stop": SOD, "off": SOD},
    SO: {"shutdown": RTSO, "enable": OE, "quick stop": SOD, "off": SOD},
    OE: {"shutdown": RTSO, "switch on": SO, "quick stop": QSA, "off": SOD},
    QSA: {"enable": OE, "off": SOD},
    FAULT: {},
}


def state_of(word: int) -> str:
    (state,) = (name for name, (mask, bits) in State402.SW_MASK.items() if word & mask == bits)
    return state


def in_state(state: str) -> Wire:
    wire = Wire().operational()
    wire.set(0x605A, 0, 6, 2)
    for word in PATH.get(state, PATH[OE]):
        wire.controlword(word)
    wire.run(25 * MS)
    if state == QSA:
        wire.controlword(0x02)
    if state == FAULT:
        wire.stimulate("fault", 0x2310)
    wire.run(25 * MS)
    assert state_of(wire.statusword()) == state
    return wire


@pytest.mark.parametrize("state", AFTER)
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("extra", [0x0000, 0xF810], ids=["plain", "other bits"])
def test_command_leads_to_standard_state(state, command, extra):
    wire = in_state(state)
    wire.controlword(COMMANDS[command] | extra)
    wire.run(200 * MS)
    after = AFTER[state].get(command, state)
    assert state_of(wire.statusword()) == after
    names_it = command != "quick stop" or state == OE  # canopen only names disable voltage to SOD
    if after != state and names_it and (state, after) in State402.TRANSITIONTABLE:
        assert State402.TRANSITIONTABLE[(state, after)] & 0x8F == COMMANDS[command] & 0x8F


@pytest.mark.parametrize("state", AFTER)
def test_fault_is_entered_from_any_state_and_left_by_edge(state):
    wire = in_state(state)
    wire.controlword(0x80)  # no fault yet, except FAULT itself: this is an edge
    wire.stimulate("fault", 0x2310)
    wire.run(100 * MS)
    assert state_of(wire.statusword()) == FAULT
    wire.controlword(0x80)  # no edge: the bit was set already
    wire.run(5 * MS)
    assert state_of(wire.statusword()) == FAULT
    wire.controlword(0x00)
    wire.controlword(0x8F)
    wire.run(5 * MS)
    assert state_of(wire.statusword()) == SOD
    wire.controlword(0x86)  # bit 7 still set: no command
    wire.run(5 * MS)
    assert state_of(wire.statusword()) == SOD


# voltage 10h, remote 200h, target reached 400h; state bits as in AKD's table
@pytest.mark.parametrize(
    ("state", "word"),
    [(SOD, 0x0250), (RTSO, 0x0231), (SO, 0x0233), (OE, 0x0637), (QSA, 0x0617), (FAULT, 0x0218)],
)
def test_whole_statusword_matches_state_and_mode(state, word):
    assert in_state(state).statusword() == word


def test_missing_supply_clears_only_bit_4():
    wire = in_state(SO)
    wire.stimulate("power", 0)
    assert wire.statusword() == 0x0223


def words(wire: Wire, count: int) -> list[int]:
    """Return the statuswords of TPDO 1."""
    return [
        int.from_bytes(bytes.fromhex(text[4:]), "little")
        for text in wire.since(count)
        if text.startswith("185#")
    ]


def tell_all(wire: Wire) -> None:
    """Set the inhibit time to 0, so that no statusword is held back."""
    wire.set(0x1800, 1, 0x8000_0185, 4)
    wire.set(0x1800, 3, 0, 2)
    wire.set(0x1800, 1, 0x185, 4)


def test_set_point_handshake_is_exact_bit_by_bit(wire):
    tell_all(wire)
    wire.enable(1)
    wire.set(0x607A, 0, 10_000, 4)
    count = len(wire.log)
    wire.controlword(0x1F)
    wire.run(5 * MS)
    assert words(wire, count) == [0x1237]  # acknowledged, no longer reached
    wire.controlword(0x0F)
    wire.run(5 * MS)
    assert words(wire, count)[1:] == [0x0237]
    wire.run(1000 * MS)
    assert words(wire, count)[2:] == [0x0637]
    assert wire.read(0x6062, signed=True) == 10_000


def test_buffered_set_point_keeps_bit_10_low_in_between(wire):
    """Danfoss VLT: target reached stays 0 until all set-points are processed."""
    wire.enable(1)
    count = len(wire.log)
    for target in (5_000, 9_000):
        wire.set(0x607A, 0, target, 4)
        wire.controlword(0x1F)
        wire.controlword(0x0F)
    assert wire.statusword() & 0x1400 == 0x1000  # one runs, one waits: the buffer is full
    wire.run(2000 * MS)
    assert [word & 0x0400 for word in words(wire, count)].count(0x0400) == 1
    assert wire.read(0x6062, signed=True) == 9_000


def test_velocity_mode_is_exact_bit_by_bit(wire):
    tell_all(wire)
    wire.enable(3)
    wire.run(20 * MS)
    assert wire.statusword() & 0x3400 == 0x1400  # 60FFh and the velocity are 0
    count = len(wire.log)
    wire.set(0x60FF, 0, 20_000, 4)
    wire.run(500 * MS)
    wire.controlword(0x010F)  # halt
    wire.run(500 * MS)
    seen = [word & 0x3400 for word in words(wire, count)]
    # moving; above zero speed; reached; halt: slowing down; below 606Fh; at rest for 606Eh
    passed = [0x1000, 0, 0x0400, 0, 0x1000, 0x1400]
    assert [bits for bits, _ in itertools.groupby(seen)] == passed


def test_torque_mode_is_exact_bit_by_bit(wire):
    """CiA 402-2: bit 10 is "target torque reached", and "at rest" under halt; 12, 13 are unused."""
    tell_all(wire)
    wire.set(0x6087, 0, 10_000, 4)  # 200 in 20 ms
    wire.enable(4)
    wire.run(20 * MS)
    assert wire.statusword() & 0x3C00 == 0x0400  # 6071h and the torque are 0
    count = len(wire.log)
    wire.set(0x6071, 0, -200, 2)
    wire.run(100 * MS)
    assert wire.read(0x6074, signed=True) == -200
    wire.controlword(0x010F)  # halt
    wire.run(500 * MS)
    wire.set(0x6072, 0, 50, 2)
    wire.controlword(0x000F)
    wire.run(50 * MS)
    seen = [word & 0x3C00 for word in words(wire, count)]
    # the ramp; reached; halt: slowing down; at rest; continued: 6072h limits it to 50
    changes = [bits for bits, _ in itertools.groupby(seen)]
    assert changes == [0, 0x0400, 0, 0x0400, 0, 0x0800]


def test_homing_is_exact_bit_by_bit(wire):
    wire.enable(6)
    wire.set(0x607C, 0, -777, 4)
    count = len(wire.log)
    assert wire.statusword() & 0x3400 == 0x0400  # not started
    wire.controlword(0x1F)
    wire.run(20 * MS)
    assert [word & 0x3400 for word in words(wire, count)] == [0x0000, 0x1400]
    assert wire.read(0x6064, signed=True) == 777
    wire.controlword(0x0F)
    wire.run(20 * MS)
    assert wire.statusword() & 0x3400 == 0x1400


@pytest.mark.parametrize(("option", "ramp"), [(1, 0x6084), (2, 0x6085), (5, 0x6084), (6, 0x6085)])
def test_quick_stop_takes_time_of_its_ramp(wire, option, ramp):
    wire.set(0x605A, 0, option, 2)
    wire.enable(3)
    wire.set(0x60FF, 0, 40_000, 4)
    wire.run(500 * MS)
    expected = 40_000 / wire.read(ramp)
    begun = wire.now
    wire.controlword(0x02)
    over = (lambda word: word & 0x4F == 0x40) if option < 5 else (lambda word: word & 0x0400)
    count = len(wire.log)
    wire.run_while(lambda: not any(over(word) for word in words(wire, count)), 1000 * MS)
    assert (wire.now - begun) / 1e9 == pytest.approx(expected, abs=0.004)


@pytest.mark.parametrize(("option", "brakes"), [(0, False), (1, True), (2, True)])
def test_fault_reaction_is_shown_for_its_duration(wire, option, brakes):
    wire.set(0x605E, 0, option, 2)
    wire.enable(3)
    wire.set(0x60FF, 0, 40_000, 4)
    wire.run(500 * MS)
    count = len(wire.log)
    wire.stimulate("fault", 0x2310)
    wire.run(500 * MS)
    states = [word & 0x4F for word in words(wire, count)]
    assert states == ([0x0F, 0x08] if brakes else [0x08])
    told = [text[:3] for text in wire.since(count)]
    assert told.index("085") < told.index("185")  # the EMCY first
