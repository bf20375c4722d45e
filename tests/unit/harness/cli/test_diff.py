import argparse
import json

import pytest

from motorhil.harness.cli import diff
from motorhil.traces.errors import TraceError
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.schema import GROUP_SYNC, MOTOR_LOCK, SERIAL_DATA
from motorhil.traces.semantics.model import meaning_of
from tests.support.recordings.handmade import MS, Recorded, S

SHUTDOWN = ("2B40600006", "604060")
SWITCH_ON = ("2B40600007", "604060")
PP = ("2F60600001", "606060")


def moved(one, motor="left_wheel", late_ns=0, speed=1.0, stop=1.0):
    """Write samples of a motor's motion."""
    for number in range(41):
        at_s = number * 0.05
        one.position(int(at_s * S) + late_ns, motor, min(speed * at_s, stop))


def ordinary(one):
    one.frame(1 * MS, 0x701, "00").frame(1 * MS + 1, 0x702, "00")
    one.sdo(2 * MS, 1, *PP).sdo(4 * MS, 1, *SHUTDOWN).sdo(6 * MS, 1, *SWITCH_ON)
    one.sdo(8 * MS, 2, "40416000", "4B4160003702")
    moved(one)
    lock = {"action": 1, "owner": "start() of left_wheel", "held_s": 0.1}
    one.message(10 * MS, "/motor/left_wheel/lock", MOTOR_LOCK, lock)
    sync = {"phase": 1, "motor": ["left_wheel"], "skew_s": 0.0001, "method": "SYNC"}
    one.message(11 * MS, "/group/drive/sync", GROUP_SYNC, sync)
    one.event(12 * MS, "warm", "left_wheel")


@pytest.fixture
def compare(tmp_path, capsys):
    """A function that compares two written recordings: (exit status, output)."""

    def compared(first, second, *words):
        paths = []
        for number, make in enumerate((first, second)):
            one = Recorded(tmp_path / f"{number}.mcap")
            make(one)
            paths.append(one.close())
        parser = argparse.ArgumentParser()
        diff.add_arguments(parser)
        status = diff.run(parser.parse_args([*paths, *words]))
        return status, capsys.readouterr().out

    return compared


def on_a_serial_line(last):
    def make(one):
        for number in range(40):
            data = {"data": bytes((number if number < 39 else last,))}
            one.message(number * MS, "/serial/line", SERIAL_DATA, data)

    return make


def test_bytes_of_serial_lines_are_compared(compare):
    assert compare(on_a_serial_line(39), on_a_serial_line(39))[0] == 0
    status, out = compare(on_a_serial_line(39), on_a_serial_line(7))
    assert status == 1
    assert "line line: 27 at 0.039000 s, but 07 at 0.039000 s" in out


def test_recording_equals_itself(compare):
    status, out = compare(ordinary, ordinary)
    assert status == 0
    assert out.startswith("the same: 7 orders of events and 1 motions compared")
    assert compare(ordinary, ordinary, "--exact") == (0, "every message is the same\n")


def test_unrelated_order_times_and_repetition_are_equal(compare):
    def other(one):
        one.frame(1 * MS, 0x702, "00").frame(2 * MS, 0x701, "00")  # in reverse order
        one.frame(2 * MS, 0x080, "").frame(3 * MS, 0x080, "")  # SYNC
        one.sdo(8 * MS, 2, "40416000", "4B4160003702").sdo(9 * MS, 2, "40416000", "4B4160003702")
        one.sdo(12 * MS, 1, *PP).sdo(24 * MS, 1, *SHUTDOWN).sdo(36 * MS, 1, *SWITCH_ON)
        one.event(40 * MS, "warm", "left_wheel")
        lock = {"action": 1, "owner": "start() of left_wheel", "held_s": 0.3}
        one.message(41 * MS, "/motor/left_wheel/lock", MOTOR_LOCK, lock)
        sync = {"phase": 1, "motor": ["left_wheel"], "skew_s": 0.0002, "method": "SYNC"}
        one.message(42 * MS, "/group/drive/sync", GROUP_SYNC, sync)
        moved(one, late_ns=20 * MS)

    status, out = compare(ordinary, other)
    assert (status, out[:9]) == (0, "the same:")
    status, out = compare(ordinary, other, "--exact")
    assert status == 1
    assert "against" in out


def changed(**changes):
    """Return a function that writes the ordinary recording with some changed steps."""

    def make(one):
        for step, usual in (
            ("boot", lambda: one.frame(1 * MS, 0x701, "00")),
            ("mode", lambda: one.sdo(2 * MS, 1, *PP)),
            ("shutdown", lambda: one.sdo(4 * MS, 1, *SHUTDOWN)),
            ("switch_on", lambda: one.sdo(6 * MS, 1, *SWITCH_ON)),
            ("heartbeat", lambda: one.frame(8 * MS, 0x701, "05")),
            ("read", lambda: one.sdo(9 * MS, 1, "40416000", "4B4160003702")),
            ("modbus", lambda: one.modbus(11 * MS, "000100000006030600010003", True)),
            ("answer", lambda: one.modbus(12 * MS, "000100000006030600010003", False)),
            ("motion", lambda: moved(one)),
            ("event", lambda: one.event(3 * S, "warm", "left_wheel")),
        ):
            how = changes.get(step, usual)
            if how is not None:
                how(one) if step in changes else how()

    return make


DIFFERENCES = [
    (
        "boot",
        lambda one: one.frame(1 * MS, 0x703, "00"),
        "can0, node 1 (left), NMT state: NMT state = boot-up at 0.001000 s, "
        "but NMT state = operational at 0.008000 s",
    ),
    (
        "heartbeat",
        lambda one: one.frame(8 * MS, 0x701, "7F"),
        "NMT state = operational at 0.008000 s, but NMT state = pre-operational at 0.008000 s",
    ),
    (
        "switch_on",
        lambda one: one.sdo(6 * MS, 1, "2B4060000F", "604060"),
        "can0, node 1 (left), commands: 6040h controlword = 0007h switch on at 0.007000 s, "
        "but 6040h controlword = 000Fh enable operation at 0.007000 s",
    ),
    ("switch_on", lambda one: one.sdo(6 * MS, 1, SWITCH_ON[0], "804060002200 0008"), "but nothing"),
    ("mode", None, "6060h modes of operation = 1 pp (profile position) at 0.003000 s, but 6040h"),
    (
        "read",
        lambda one: one.sdo(9 * MS, 1, "40416000", "4B4160001802"),
        "6041h statusword = 0237h operation enabled at 0.010000 s, "
        "but 6041h statusword = 0218h fault at 0.010000 s",
    ),
    (
        "modbus",
        lambda one: one.modbus(11 * MS, "000100000006030600010004", True),
        "rs485, unit 3 (lift), commands: register 0001h = 0003h at 0.012000 s, "
        "but register 0001h = 0004h",
    ),
    (
        "answer",
        lambda one: one.modbus(12 * MS, "000100000003038602", False),
        "illegal data address",
    ),
    ("motion", lambda one: moved(one, stop=0.9), "motor left_wheel, position: "),
    ("motion", lambda one: moved(one, late_ns=100 * MS), "motor left_wheel, position: "),
    (
        "event",
        lambda one: one.event(3 * S, "hot", "left_wheel"),
        "left_wheel: warm at 3.000000 s, but warning",
    ),
]


@pytest.mark.parametrize(("step", "how", "text"), DIFFERENCES)
def test_difference_is_named(compare, step, how, text):
    status, out = compare(changed(), changed(**{step: how}))
    assert status == 1
    assert out.startswith("first difference, ")
    assert text in out


def test_earliest_difference_is_first_and_all_are_summarised(compare):
    other = changed(
        read=lambda one: one.sdo(9 * MS, 1, "40416000", "4B4160001802"),
        mode=lambda one: one.sdo(2 * MS, 1, "2F60600003", "606060"),
        event=None,
    )
    status, out = compare(changed(), other)
    assert status == 1
    first, _, summary = out.partition("\n3 of ")
    assert "modes of operation = 1" in first.splitlines()[0]
    assert [line.split()[0] for line in summary.splitlines()[1:]] == [
        "0.003000",
        "0.010000",
        "3.000000",
    ]


def test_context_of_same_node_is_shown_for_both(compare):
    def other(one):
        one.sdo(6 * MS, 1, "2B4060000F", "604060")

    status, out = compare(changed(), changed(switch_on=other), "--context", "2")
    assert status == 1
    first, second = out.split(".mcap:\n")[1:3]
    assert first.splitlines()[:5] == [
        "     0.005000000  can0      SDO left (1): takes 6040h controlword",
        "     0.006000000  can0      SDO to left (1): write 6040h controlword = 0007h switch on",
        ">    0.007000000  can0      SDO left (1): takes 6040h controlword",
        "     0.008000000  can0      left (1) is operational",
        "     0.009000000  can0      SDO to left (1): read 6041h statusword",
    ]
    assert "write 6040h controlword = 000Fh enable operation" in second


def test_motion_within_tolerances_is_equal(compare):
    near = changed(motion=lambda one: moved(one, stop=1.009))
    assert compare(changed(), near)[0] == 0
    assert compare(changed(), near, "--tolerance", "0.008")[0] == 1
    late = changed(motion=lambda one: moved(one, late_ns=100 * MS))
    assert compare(changed(), late, "--tolerance-s", "0.1")[0] == 0


def test_missing_motion_differs_both_ways(compare):
    for pair in ((changed(), changed(motion=None)), (changed(motion=None), changed())):
        status, out = compare(*pair)
        assert status == 1
        assert "nothing" in out.splitlines()[0]


def test_periodic_pdo_differs_by_value_not_by_count(compare):
    def pdos(words, times=1):
        def make(one):
            one.sdo(1 * MS, 1, "2F001A0000", "60001A00").sdo(
                3 * MS, 1, "23001A0110004160", "60001A01"
            )
            one.sdo(5 * MS, 1, "2F001A0001", "60001A00")
            for number, word in enumerate(word for word in words for _ in range(times)):
                one.frame((10 + number) * MS, 0x181, word)

        return make

    assert compare(pdos(["3102", "3302", "3702"]), pdos(["3102", "3302", "3702"], 3))[0] == 0
    status, out = compare(pdos(["3102", "3302", "3702"]), pdos(["3102", "3702"]))
    assert status == 1
    assert "0233h switched on at 0.011000 s, but 6041h statusword = 0237h" in out


def test_measured_quantity_is_not_compared_by_value(compare):
    def measured(step):
        def make(one):
            for number in range(40):
                one.sdo(2 * number * MS, 1, "40022000", f"4B022000{number * step:02X}00")

        return make

    assert compare(measured(1), measured(2))[0] == 0


def test_object_of_few_values_is_compared_by_value(compare):
    def told(value):
        return lambda one: one.sdo(0, 1, "40022000", f"4B022000{value}00")

    assert compare(told("01"), told("02"))[0] == 1


def test_json_has_every_difference(compare):
    status, out = compare(changed(), changed(event=None), "--json")
    told = json.loads(out)
    assert (status, told["same"], len(told["differences"])) == (1, False, 1)
    assert told["differences"][0]["first"]["time_ns"] == 3 * S
    assert told["differences"][0]["second"] is None
    assert json.loads(compare(changed(), changed(), "--json")[1]) == {
        "same": True,
        "differences": [],
    }


@pytest.mark.parametrize(
    "once",
    [
        lambda one, at: one.sdo(at, 1, *SWITCH_ON),
        lambda one, at: one.frame(at, 0x701, "00"),
        lambda one, at: one.frame(at, 0x000, "0101"),
        lambda one, at: one.frame(at, 0x081, "1086210000000000"),
        lambda one, at: one.sdo(at, 1, "40026000", "8002600000000206"),
    ],
)
def test_commands_boots_emcy_and_aborts_are_counted(compare, once):
    def twice(one):
        once(one, 1 * MS)
        once(one, 5 * MS)

    status, out = compare(lambda one: once(one, 1 * MS), twice)
    assert status == 1
    assert "but " in out


def test_peak_between_samples_is_found_both_ways(compare):
    def flat(one):
        one.position(0, "left_wheel", 0.0).position(2 * S, "left_wheel", 0.0)

    def peak(one):
        for at, position in ((0, 0.0), (900 * MS, 0.0), (1 * S, 0.5), (1100 * MS, 0.0)):
            one.position(at, "left_wheel", position)
        one.position(2 * S, "left_wheel", 0.0)

    for pair in ((flat, peak), (peak, flat)):
        status, out = compare(*pair)
        assert status == 1
        assert "0.5 at 1.000000 s" in out.splitlines()[0]


def test_meaning_beyond_the_memory_is_refused(tmp_path):
    one = Recorded(tmp_path / "it.mcap")
    ordinary(one)
    with read_trace(one.close()) as trace:
        needed = meaning_of(trace).kept_bytes
        assert meaning_of(trace, memory_max=needed).kept_bytes == needed
        with pytest.raises(TraceError, match=r"more than 0 MiB.*--max-memory.*--exact"):
            meaning_of(trace, memory_max=needed - 1)


def test_many_beginnings_of_a_group_are_compared(compare):
    def make(one):
        for number in range(40):
            sync = {"phase": 1, "motor": ["left", "right"], "method": "SYNC"}
            one.message(number * MS, "/group/drive/sync", GROUP_SYNC, sync)

    assert compare(make, make)[0] == 0


def test_context_omits_other_nodes(compare):
    def with_neighbour(word):
        def make(one):
            one.sdo(2 * MS, 2, "40416000", "4B4160003702")
            one.sdo(4 * MS, 1, f"2B406000{word}", "604060")

        return make

    _, out = compare(with_neighbour("07"), with_neighbour("0F"))
    assert "right (2)" not in out


@pytest.mark.parametrize("index", ["6460", "6468"])
def test_reported_positions_are_motion_on_every_axis(compare, index):
    def told(last):
        def make(one):
            for at, value in enumerate((0, 500, last)):
                one.sdo(
                    at * S, 1, f"40{index}00", f"43{index}00{value.to_bytes(4, 'little').hex()}"
                )

        return make

    assert compare(told(1000), told(1009))[0] == 0  # 1 % of the distance
    status, out = compare(told(1000), told(1020))
    assert status == 1
    assert "position actual value" in out.splitlines()[0]
