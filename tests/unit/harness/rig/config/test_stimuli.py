"""`[[stimulus]]`: timed physical inputs of controllers in a rig file."""

import pytest

from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.rig.rig import Rig
from tests.support.plugin_rigs import GOOD, WHEEL

STIMULUS = '[[stimulus]]\ncontroller = "left"\nname = "load_torque_n_m"\nvalue = {}\nat_s = {}\n'


@pytest.fixture
def opened(bench):
    """Return a function that opens the rig GOOD with more text at its end."""

    def open_rig(more):
        (bench / "rig.toml").write_text(GOOD + more)
        (bench / "wheel.toml").write_text(WHEEL)
        return Rig.open(bench / "rig.toml")

    return open_rig


def test_stimuli_are_applied_and_reported_at_their_times(opened):
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


def test_invalid_stimulus_is_refused_before_the_run(opened):
    wrong = STIMULUS.format(1, 2).replace("load_torque_n_m", "lead")
    with pytest.raises(RigError, match=r"rig.toml:24: stimulus\[0\]: .*known: load_torque_n_m"):
        opened(wrong)


def test_stimulus_from_python_is_reported_as_well(opened):
    with opened("") as rig:
        told = []
        rig.world.tap_events(lambda *event: told.append(event))
        rig.runtime.run_for(0.05)
        rig.controllers["left"].stimulate("load_torque_n_m", 0.5)
        with pytest.raises(ValueError, match="load_torque_n_m"):
            rig.controllers["left"].stimulate("no_such", 1.0)
        assert told == [(50_000_000, "info", "left", "stimulus load_torque_n_m = 0.5")]
