"""`[world]` and `[swarm]` of a rig, and fragments that are appended to one."""

import can
import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.config.worlds import WEIGHTS
from motorhil.harness.rig.reading import describe
from motorhil.harness.rig.rig import Rig
from motorhil.traces.mcap.reader import read_trace
from tests.support.plugin_rigs import GOOD, WHEEL

CHANGE = '[[world.change]]\ncontroller = "left"\nkey = "{}"\nvalue = {}\n'
DROP = '[[fault]]\nbus = "can0"\nkind = "drop"\nsender = "left"\nlimit = 1\n'


@pytest.fixture
def read(bench):
    """Return a function that reads the rig GOOD with a fragment, from two files."""
    (bench / "rig.toml").write_text(GOOD)
    (bench / "wheel.toml").write_text(WHEEL)

    def read_both(fragment):
        (bench / "world.toml").write_text(fragment)
        return describe(bench / "rig.toml", bench / "world.toml")

    return read_both


def refused(read, fragment):
    """Return the message with which a fragment is refused."""
    with pytest.raises(RigError) as caught:
        read(fragment)
    return str(caught.value)


def test_a_fragment_adds_faults_and_changes_settings(read):
    rig = read(DROP + CHANGE.format("plant.load_inertia_kg_m2", 0.125) + "[world]\n")
    assert [one.rule.kind.value for one in rig.faults] == ["drop"]
    assert rig.controllers["left"].settings["plant"]["load_inertia_kg_m2"] == 0.125


def test_a_change_keeps_all_other_settings(read):
    plain = read("").controllers["left"].settings
    changed = read(CHANGE.format("oscillator.ppm", 20.0)).controllers["left"].settings
    assert {**plain, "oscillator": {"ppm": 20.0}} == changed


@pytest.mark.parametrize(
    ("fragment", "expected"),
    [
        (DROP.replace("drop", "dorp"), 'world.toml:3: fault[0].kind: unknown fault kind "dorp"'),
        ("[[fault]\n", "world.toml:1: not TOML"),
        (CHANGE.format("bus", '"can1"'), 'world.toml:3: world.change[0].key: "bus" cannot be'),
        (CHANGE.replace("left", "lift").format("x", 1), "there is no controller"),
        (CHANGE.format("kind.name", 1), '"kind" is not a table'),
        ("[world]\ninterleaving = -1\n", "world.toml:2: world.interleaving: -1"),
        ("[swarm.weights]\ndorp = 1.0\n", "dorp: is no kind of disturbance (known: drop, delay"),
        ("[swarm]\nplant_tolerance = 2.0\n", "world.toml:2: swarm.plant_tolerance: 2.0"),
    ],
)
def test_an_error_names_the_file_and_line_that_it_is_in(read, fragment, expected):
    assert expected in refused(read, fragment)


def test_a_wrong_value_names_the_change_and_not_the_rig(bench):
    (bench / "world.toml").write_text(CHANGE.format("plant.load_inertia_kg_m2", -1))
    with pytest.raises(RigError) as caught:
        Rig.open(EXAMPLES / "two_wheels.toml", world=bench / "world.toml")
    assert f"{bench / 'world.toml'}:4: controller.left.plant.load_inertia_kg_m2" in str(
        caught.value
    )


def test_a_fault_strikes_the_second_connection_of_an_application(read):
    rig = Rig(read(DROP.replace("left", "host-2")), seed=1, doubts=False)

    def connection():
        return can.Bus(interface="emulated", channel="can0")

    with rig, connection() as first, connection() as second:
        for number, bus in enumerate((first, second)):
            bus.send(can.Message(arbitration_id=0x7F0 + number, is_extended_id=False))
        rig.runtime.run_for(0.01)
        heard = []
        for bus in (first, second):
            frames = iter(lambda bus=bus: bus.recv(timeout=0.0), None)
            heard.append([one.arbitration_id for one in frames if one.arbitration_id >= 0x7F0])
        assert heard == [[], [0x7F0]]
        assert rig.faults.fired() == {"fault 1": 1}


@pytest.mark.parametrize("name", ["host-1", "host-02", "host-x", "hosts"])
def test_a_fault_names_only_connections_that_there_can_be(read, name):
    expected = f'world.toml:4: fault[0].sender: there is no controller "{name}"'
    assert expected in refused(read, DROP.replace("left", name))


def test_a_record_contains_the_whole_world(read, bench):
    read(DROP)
    with Rig.open(bench / "rig.toml", world=bench / "world.toml", record=bench / "run.mcap") as rig:
        rig.runtime.run_for(0.01)
    with read_trace(bench / "run.mcap") as trace:
        (attached,) = [one for one in trace.attachments if one.name == "rig.toml"]
    assert attached.data.decode() == GOOD + DROP


def test_a_recording_takes_no_world(read, bench):
    test_a_record_contains_the_whole_world(read, bench)
    with pytest.raises(RigError, match="is a recording; no world disturbs it"):
        Rig.open(bench / "run.mcap", world=bench / "world.toml")


def test_declared_weights_replace_the_usual_ones(read):
    table = read("[swarm.weights]\ndrop = 7.5\n").world.swarm
    assert (table.weight("drop"), table.weight("cut")) == (7.5, WEIGHTS["cut"])
