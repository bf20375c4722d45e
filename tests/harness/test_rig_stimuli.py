"""`[[stimulus]]`: what a rig file says will happen to a controller, and when."""

import pytest

from harness.rig import Rig
from harness.settings import RigError
from tests.harness.rigs import GOOD, WHEEL

STIMULUS = '[[stimulus]]\ncontroller = "left"\nname = "load_torque_n_m"\nvalue = {}\nat_s = {}\n'


@pytest.fixture
def opened(bench):
    """Opens the rig GOOD with more at its end."""

    def open_rig(more):
        (bench / "rig.toml").write_text(GOOD + more)
        (bench / "wheel.toml").write_text(WHEEL)
        return Rig.open(bench / "rig.toml")

    return open_rig


def test_a_stimulus_comes_at_its_time_in_the_order_of_the_file_and_is_told(opened):
    stimuli = ((0.5, 0.1), (1.5, 0.1), (0.25, 0.05), (2.0, 0))
    with opened("".join(STIMULUS.format(*one) for one in stimuli)) as rig:
        left, told = rig.controllers["left"], []
        rig.world.tap_events(lambda *event: told.append(event))
        seen = []
        for _ in range(3):
            rig.runtime.run_for(0.05)
            seen.append(left.snapshot()["load_torque_n_m"])
        assert seen == [0.25, 1.5, 1.5]
        assert told == [
            (time_ns, "info", "left", f"stimulus load_torque_n_m = {value}")
            for time_ns, value in ((0, 2), (50_000_000, 0.25), (100_000_000, 0.5), (10**8, 1.5))
        ]


def test_what_the_controller_would_refuse_is_refused_before_anything_runs(opened):
    wrong = STIMULUS.format(1, 2).replace("load_torque_n_m", "lead")
    with pytest.raises(RigError, match=r"rig.toml:24: stimulus\[0\]: .*known: load_torque_n_m"):
        opened(wrong)
