"""NMT and error control on the wire, in every state.

Expected: CiA 301, 7.3.2.2 (NMT state diagram, table 38: states and communication objects) and
7.2.8.2.2 (heartbeat, boot-up).
"""

import pytest

from tests.support.canopen.drive_wire import BOOT_UP, MS, US, Wire

PRE, OP, STOP = 0x7F, 0x05, 0x04
COMMANDS = {PRE: "80", OP: "01", STOP: "02"}
BOOT_UP_FRAME_NS = 55 * US  # 705#00 at 1 Mbit/s to its end: 55 bits with IFS, plus 3 stuff bits


def in_state(state: int) -> Wire:
    wire = Wire().boot()
    wire.set(0x1017, 0, 10, 2)
    wire.tell(f"000#{COMMANDS[state]}05")
    wire.run(15 * MS)
    assert wire.since()[-1] == f"705#{state:02X}"
    return wire


@pytest.mark.parametrize("state", [PRE, OP, STOP])
@pytest.mark.parametrize("addressee", ["05", "00"])
@pytest.mark.parametrize(("command", "after"), [("01", OP), ("02", STOP), ("80", PRE)])
def test_command_leads_to_standard_state(state, addressee, command, after):
    wire = in_state(state)
    count = len(wire.log)
    wire.tell(f"000#{command}{addressee}")
    wire.run(25 * MS)
    beats = [text for text in wire.since(count) if text.startswith("705#")]
    assert beats == [f"705#{after:02X}"] * len(beats)
    assert len(beats) >= 2


@pytest.mark.parametrize("state", [PRE, OP, STOP])
@pytest.mark.parametrize(("command", "delay"), [("81", 300 * MS), ("82", 20 * MS)])
def test_reset_is_silence_and_one_boot_up(state, command, delay):
    wire = in_state(state)
    count = len(wire.log)
    wire.tell(f"000#{command}05")
    reset = wire.now
    wire.run(delay + 30 * MS)
    assert wire.since(count) == ["705#00"]  # 1017h is 0 again: CiA 301, reset communication
    (heard,) = wire.times(0x705, count)
    assert heard == reset + delay + BOOT_UP_FRAME_NS


@pytest.mark.parametrize(
    "text", ["000#0104", "000#01", "000#010500", "000#0005", "000#0305", "000#8305", "001#0105"]
)
def test_foreign_command_is_ignored(text):
    wire = in_state(PRE)
    count = len(wire.log)
    wire.tell(text)
    wire.run(25 * MS)
    assert wire.since(count) == ["705#7F"] * len(wire.since(count))


def test_boot_up_is_on_time_and_first():
    wire = Wire()
    wire.run_to(200 * MS)
    wire.send("605#4000100000000000", "000#0105", "705#R1")
    wire.run_to(BOOT_UP + 50 * MS)
    assert wire.since() == ["705#00"]
    assert wire.times(0x705)[-1] == BOOT_UP + BOOT_UP_FRAME_NS
    assert wire.statusword() == 0x0250  # pre-operational, switch on disabled


def test_first_heartbeat_is_one_period_after_boot_up():
    wire = Wire({"node_id": 5, "objects": {"1017h": 100}})
    wire.run_to(BOOT_UP + 250 * MS)
    assert wire.since() == ["705#00", "705#7F", "705#7F"]
    first, second, third = wire.times(0x705)
    assert (second - first, third - second) == (100 * MS, 100 * MS)


SERVICES = {
    # a request, and the response expected if (and only if) the state has that service
    "SDO": ("605#4000100000000000", "585#", {PRE, OP}),
    "SYNC": ("080#", "385#", {OP}),
    "RPDO": ("205#8000", "", set()),
}


@pytest.mark.parametrize("state", [PRE, OP, STOP])
@pytest.mark.parametrize("service", ["SDO", "SYNC"])
def test_service_works_in_its_states_only(state, service):
    wire = in_state(state)
    request, answer, states = SERVICES[service]
    count = len(wire.log)
    wire.tell(request)
    wire.run(8 * MS)
    heard = [text for text in wire.since(count) if text.startswith(answer)]
    assert len(heard) == (1 if state in states else 0)


@pytest.mark.parametrize(("state", "counts"), [(PRE, False), (OP, True), (STOP, False)])
def test_rpdos_work_in_operational_only(state, counts):
    wire = in_state(state)
    wire.tell("205#0600")
    wire.tell("000#8005")
    assert wire.statusword() & 0x6F == (0x21 if counts else 0x40)


@pytest.mark.parametrize(("state", "told"), [(PRE, True), (OP, True), (STOP, False)])
def test_emergencies_are_sent_except_in_stopped(state, told):
    wire = in_state(state)
    count = len(wire.log)
    wire.stimulate("fault", 0x2310)
    wire.run(5 * MS)
    heard = [text for text in wire.since(count) if text.startswith("085#")]
    assert heard == (["085#1023030000000000"] if told else [])


def test_stop_drops_pending_output():
    wire = in_state(OP)
    count = len(wire.log)
    wire.tell("605#4000100000000000", "000#0205")
    wire.run(8 * MS)
    assert wire.since(count) == [] or wire.since(count) == ["705#04"]
    wire.tell("000#8005")
    assert wire.ask("605#4000100000000000") == "585#4300100092010200"


def test_reset_communication_restores_its_objects_only():
    wire = in_state(PRE)
    wire.set(0x1800, 5, 50, 2)
    wire.set(0x6081, 0, 1234, 4)
    wire.tell("000#8205")
    wire.run(25 * MS)
    assert (wire.read(0x1800, 5), wire.read(0x1017), wire.read(0x6081)) == (0, 0, 1234)
    wire.tell("000#8105")
    wire.run(305 * MS)
    assert wire.read(0x6081) == 40960  # from the file


def test_broadcast_command_reaches_every_node():
    wire = Wire(*({"node_id": node, "objects": {"1017h": 10}} for node in (1, 2, 127))).boot()
    wire.tell("000#0100")
    wire.run(20 * MS)
    assert set(wire.since()[-3:]) == {"701#05", "702#05", "77F#05"}


def test_guarded_drive_stops_when_guarding_ends():
    """7.2.8.2.1: the toggle bit; 100Ch x 100Dh = 100 ms; 6007h = 1: a fault signal."""
    wire = Wire().boot()
    wire.enable()
    for index, value, size in ((0x6007, 1, 2), (0x1017, 0, 2), (0x100C, 50, 2), (0x100D, 2, 1)):
        wire.set(index, 0, value, size)
    answers = []
    for _ in range(3):
        count = len(wire.log)
        wire.tell("705#R1")
        wire.run(50 * MS)
        answers += [text for text in wire.since(count) if text.startswith("705#")]
    assert answers == ["705#05", "705#85", "705#05"]
    count = len(wire.log)
    wire.run(60 * MS)
    emergencies = [text for text in wire.since(count) if text.startswith("085#")]
    assert emergencies[0].startswith("085#3081")
    wire.run(1_000 * MS)
    assert wire.statusword() & 0x4F == 0x08  # fault
    assert wire.read(0x603F) == 0x8130
