import gc
import os
import signal
import threading
import time
import tomllib
import weakref
from pathlib import Path

import can
import pytest

from motorhil.emulators.can.fault_rules import FaultKind, FaultRule
from motorhil.harness.examples import two_wheels
from motorhil.harness.python_can.bus import EmulatedBus
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from tests.support.checkout import CHECKOUT
from tests.support.plugin_rigs import FAULT, GOOD, WHEEL

MS = 1_000_000
TWO_WHEELS = Path(two_wheels.__file__).with_name("two_wheels.toml")


PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
OWN = PROJECT["entry-points"]["motorhil.controllers"]


@pytest.fixture
def write(bench):
    def write_rig(text):
        (bench / "rig.toml").write_text(text)
        (bench / "wheel.toml").write_text(WHEEL)
        return bench / "rig.toml"

    return write_rig


def refusal(path):
    with pytest.raises(RigError) as caught, Rig.open(path):
        pass
    return str(caught.value).replace(f"{path.parent}/", "")


def answers(rig, count=20):
    """Send `count` requests to node 1, every 10 ms; return those that were answered."""
    bus = rig.bus("can0")
    heard = []
    for number in range(count):
        bus.send(can.Message(arbitration_id=0x101, data=[number], is_extended_id=False))
        rig.runtime.run_for(0.01)
        while (message := bus.recv(0)) is not None:
            if message.arbitration_id == 0x181:
                heard.append(message.data[0])
    return heard


def test_third_party_controllers_answer_in_virtual_time(write):
    with Rig.open(write(GOOD)) as rig:
        bus = rig.bus("can0")
        bus.send(can.Message(arbitration_id=0x101, data=[42], is_extended_id=False))
        heard = [bus.recv(0.1) for _ in range(3)]
        assert [message.arbitration_id for message in heard] == [0x701, 0x702, 0x181]
        assert heard[2].data == b"\x2a"
        assert (
            0.001 < heard[2].timestamp < 0.002
        )  # the controller's delay plus the frames' duration
        assert bus.recv(3600.0) is None
        assert rig.runtime.now_ns() > 3600 * 10**9


def test_python_can_program_joins_the_rig_by_channel(write):
    with Rig.open(write(GOOD)), can.Bus(interface="emulated", channel="can0") as bus:
        bus.send(can.Message(arbitration_id=0x102, data=[1], is_extended_id=False))
        assert bus.recv(0.1) is not None


def test_controllers_motors_and_groups_are_found_by_name(write):
    text = GOOD + '[group.both]\nmotors = ["right", "left"]\n'
    with Rig.open(write(text)) as rig:
        assert list(rig.controllers) == ["left", "right"]
        assert list(rig.motors) == ["left", "right"]
        assert list(rig.groups) == ["both"]
        left = rig.motors["left"]
        assert left is rig.motors["left"]
        assert left.bus is rig.bus("can0")
        assert left.settings == {"name": "left", "node_id": 1}
        assert left.runtime is rig.runtime
        assert left.model.velocity_max == 6.0
        assert rig.motors["right"].model.name == "wheel"
        with pytest.raises(KeyError, match=r"this rig has no motor 'lefft' \(known: left, right\)"):
            rig.motors["lefft"]


def test_controller_can_be_stimulated_and_inspected(write):
    with Rig.open(write(GOOD)) as rig:
        left = rig.controllers["left"]
        left.stimulate("load_torque_n_m", 0.5)
        assert left.snapshot() == {"load_torque_n_m": 0.5}
        assert rig.controllers["right"].snapshot() == {"load_torque_n_m": 0.0}
        with pytest.raises(ValueError, match="known: load_torque_n_m"):
            left.stimulate("load", 1.0)


def test_controller_gets_its_name_folder_and_seed(write):
    path = write(GOOD)
    with Rig.open(path) as rig:
        context = rig.controllers["right"].core.context
        assert (context.name, context.folder, context.seed) == ("right", path.parent, 7)
    with Rig.open(path, seed=9) as rig:
        assert rig.seed == 9
        assert rig.controllers["right"].core.context.seed == 9


def test_everything_is_closed_after_an_exception(write):
    path = write(GOOD)
    threads = threading.active_count()
    motors = []

    def fail_in_the_middle():
        with Rig.open(path) as rig:
            motors.append(rig.motors["left"])
            rig.runtime.spawn("waits for ever", lambda: rig.runtime.wait_until(lambda: False))
            rig.runtime.run_for(1.0)
            assert threading.active_count() == threads + 1
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail_in_the_middle()
    assert motors[0].closed
    assert threading.active_count() == threads
    with pytest.raises(can.CanInitializationError, match="neither a bus of a rig open"):
        EmulatedBus("can0")
    with Rig.open(path):  # the names are available again
        pass


def test_rig_that_fails_to_open_leaves_nothing_open(write):
    path = write(GOOD + "[controller.third]\nkind='echo'\nbus='can0'\nnode_id=3\nspeed=1\n")
    assert refusal(path) == (
        "rig.toml:28: controller.third.speed: unknown key; known: node_id, delay_s"
    )
    with pytest.raises(can.CanInitializationError, match="neither a bus of a rig open"):
        EmulatedBus("can0")


def test_second_rig_with_the_same_bus_is_refused(write):
    path = write(GOOD)
    with Rig.open(path):
        assert "another rig that is open in this process has a bus of that name" in refusal(path)


# (old text, new text, message); the message names the line of the value, in any file
@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "plant.resistance_ohm = 1.5",
            "plant.resistance_ohm = 0",
            "rig.toml:9: controller.left.plant.resistance_ohm: must be > 0 ohm; write 1.0",
        ),
        (
            "plant.resistance_ohm = 1.5",
            "delay_s = -1.0",
            "rig.toml:5: controller.left: cannot be built: delay_s = -1.0: must be >= 0; "
            "correct its numbers",
        ),
        (
            'kind = "echo"',
            'kind = "broken"',
            'rig.toml:6: controller.left.kind: plugin "broken" cannot be loaded from '
            "tests.unit.harness.no_such_module:controller: ModuleNotFoundError: "
            "No module named 'tests.unit.harness.no_such_module'; reinstall bench 1.0",
        ),
        (
            'kind = "echo"',
            'kind = "ecco"',
            'rig.toml:6: controller.left.kind: unknown controller kind "ecco" '
            f"(known: {', '.join(sorted([*OWN, 'broken', 'echo']))}); did you mean echo?",
        ),
        (
            "velocity_max_rad_s = 6.0",
            "velocity_max_rad_s = -6.0",
            "rig.toml:18: motor.left.model.velocity_max_rad_s: -6.0 rad/s is out of range; "
            "allowed: more than 0 rad/s",
        ),
    ],
)
def test_plugin_error_is_reported_with_its_line(write, old, new, told):
    assert old in GOOD
    assert refusal(write(GOOD.replace(old, new, 1))) == told


def test_model_file_error_is_reported_with_its_line(write, bench):
    path = write(GOOD)
    (bench / "wheel.toml").write_text("velocity_max_rad_s = 5\nacceleration_max = 3\n")
    assert refusal(path).startswith("wheel.toml:2: acceleration_max: unknown key")


def test_adaptation_error_is_reported_with_the_motors_line(write):
    path = write(GOOD.replace('controller = "left"', 'controller = "left"\nheartbeat = 1'))
    with Rig.open(path) as rig, pytest.raises(RigError) as caught:
        rig.build_motors()
    assert str(caught.value) == (
        f"{path}:17: motor.left.heartbeat: heartbeat: unknown key; did you mean heartbeat_s?; "
        "correct its settings"
    )


def test_warnings_at_power_on_become_notes(write):
    with Rig.open(write(GOOD.replace("node_id = 2", 'node_id = 2\neds = "a.eds"'))) as rig:
        assert rig.notes == ["right: warning: a.eds:3: mended"]


@pytest.mark.parametrize(
    ("nodes", "destroyers"),
    [
        ("", "left, right"),
        ('[bus.can0.node.right]\nframes = "fd_tolerant"\n', "left"),
        ('[bus.can0.node.left]\nqueue = "priority"\n', "right, left"),
        ('[bus.can0.node.host]\nframes = "classical"\n', "left, right, host"),
    ],
)
def test_can_fd_bus_note_names_nodes_that_destroy_frames(write, nodes, destroyers):
    fd = "bitrate_bit_s = 1_000_000\ndata_bitrate_bit_s = 2_000_000\n"
    assert "bitrate_bit_s = 1_000_000\n" in GOOD
    with Rig.open(write(GOOD.replace("bitrate_bit_s = 1_000_000\n", fd + nodes))) as rig:
        (note,) = rig.notes
    assert note == (
        f"can0: warning: classical CAN controllers destroy its CAN FD frames: {destroyers}; give"
        ' them frames = "fd_tolerant" or "fd" in [bus.can0.node.' + destroyers.split(", ")[0] + "]"
    )


def test_can_fd_note_is_absent_if_all_nodes_tolerate_it(write):
    tolerant = "".join(
        f'[bus.can0.node.{name}]\nframes = "fd_tolerant"\n' for name in ("left", "right")
    )
    for rates in ("", "data_bitrate_bit_s = 2_000_000\n" + tolerant):
        text = GOOD.replace("bitrate_bit_s = 1_000_000\n", "bitrate_bit_s = 1_000_000\n" + rates)
        with Rig.open(write(text)) as rig:
            assert rig.notes == []


def test_plant_takes_model_parameters_on_request_with_note(write):
    path = write(GOOD)
    with Rig.open(path) as rig:
        assert rig.notes == []
        assert rig.controllers["right"].core.settings == {"node_id": 2}
    asked = "node_id = 2\nplant.from_motor_model = true\nplant.gear_ratio = 16\n"
    path = write(GOOD.replace("node_id = 2\n", asked))
    with Rig.open(path) as rig:
        assert rig.controllers["right"].core.settings["plant"] == {
            "gear_ratio": 16,
            "current_max_a": 4.0,
            "encoder_increments_rev": 4000,  # 10185.9163 * 2 pi / 16
        }
        assert rig.notes == [
            f"{path}:14: controller.right.plant: current_max_a = 4, encoder_increments_rev = 4000 "
            'taken from motor model "wheel": a mistake in it is on both sides'
        ]


def test_plant_values_of_the_rig_override_the_motor_model(write):
    asked = "node_id = 2\n[controller.right.plant]\nfrom_motor_model = true\ncurrent_max_a = 9\n"
    text = GOOD.replace("node_id = 2\n", asked + "gear_ratio = 16\n")
    with Rig.open(write(text)) as rig:
        assert rig.controllers["right"].core.settings["plant"]["current_max_a"] == 9


def test_model_without_whole_encoder_increments_is_refused(write):
    asked = "node_id = 2\nplant.from_motor_model = true\nplant.gear_ratio = 16.5\n"
    assert refusal(write(GOOD.replace("node_id = 2\n", asked))) == (
        "rig.toml:14: controller.right.plant.from_motor_model: the motor model's increments, "
        "10185.9163 per rad with gear_ratio = 16.5, are 3878.79 per motor turn: not a whole "
        "number; "
        "correct one of them"
    )


def test_random_faults_depend_only_on_the_seed(write):
    path = write(GOOD + FAULT + "probability = 0.5\n")

    def heard(seed):
        with Rig.open(path, seed=seed) as rig:
            return answers(rig)

    first = heard(1)
    assert 2 < len(first) < 18
    assert heard(1) == first
    assert heard(2) != first


@pytest.mark.parametrize(("until_s", "first"), [(0.149989, 15), (0.14999, 16)])
def test_cut_node_is_silent_for_exactly_its_time(write, until_s, first):
    """The node also waits for 11 recessive bits after the cut, 11 us at 1 Mbit/s."""
    cut = f'[[fault]]\nbus="can0"\nkind="cut"\nnodes=["left"]\nfrom_s=0.05\nuntil_s={until_s}\n'
    with Rig.open(write(GOOD + cut)) as rig:
        assert answers(rig) == [0, 1, 2, 3, 4, *range(first, 20)]
        assert rig.faults.fired() == {"fault 1": 1}


def test_faults_can_be_injected_and_lifted_while_open(write):
    with Rig.open(write(GOOD)) as rig:
        told = []
        rig.world.tap_events(lambda *event: told.append(event))
        rig.faults.inject("can0", FaultRule(name="loss", kind=FaultKind.DROP, identifier=0x181))
        assert answers(rig, 3) == []
        assert rig.faults.fired() == {"loss": 3}
        rig.faults.lift("can0", "loss")
        assert answers(rig, 3) == [0, 1, 2]
        assert [event[1:] for event in told] == [("warning", "can0", "loss: drop 181h")] * 3


@pytest.mark.wall
def test_realtime_rig_never_runs_ahead_of_wall_time(write):
    with Rig.open(write(GOOD), realtime=True) as rig:
        start_s = time.monotonic()
        rig.runtime.run_for(0.05)
        rig.runtime.run_for(0.05)
        assert time.monotonic() - start_s >= 0.1
        assert rig.runtime.now_ns() == 100_000_000


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_does_not_interrupt_an_event(rig):
    before = signal.getsignal(signal.SIGINT)
    with Rig.open("rig.toml") as opened:
        whole = []

        def act():
            os.kill(os.getpid(), signal.SIGINT)
            whole.append(opened.runtime.now_ns())

        opened.runtime.every(0.1, act)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                opened.runtime.run_for(1.0)
        assert whole == [100 * MS, 200 * MS]
        with pytest.raises(KeyboardInterrupt):  # takes effect at once between events
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_invalid_seed_is_refused(bench):
    (bench / "rig.toml").write_text(GOOD)
    (bench / "wheel.toml").write_text(WHEEL)
    with pytest.raises(RigError, match="seed -3 is not within 0 to"):
        Rig.open(bench / "rig.toml", seed=-3)


def test_used_rig_leaves_nothing_in_memory(tmp_path):
    left = []
    for number in range(3):
        with Rig.open(TWO_WHEELS, record=tmp_path / f"{number}.mcap") as rig:
            motor = next(iter(rig.motors.values()))
            motor.enable()
            motor.disable()
            left += [weakref.ref(motor), weakref.ref(rig)]
        del rig, motor
    gc.collect()
    assert [one() for one in left] == [None] * 6


def test_motors_of_a_rig_are_printed_by_name():
    with Rig.open(TWO_WHEELS) as rig:
        assert repr(rig.motors) == "<motors of the rig: left, right>"
        assert repr(rig.groups).startswith("<groups of the rig: ")
