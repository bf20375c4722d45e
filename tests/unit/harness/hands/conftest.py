"""Fixtures: rigs of the examples, driven by hand without a page."""

from collections import deque
from random import Random
from shutil import copytree

import pytest

from motorhil.harness.hands.brake import Brake
from motorhil.harness.hands.hands import Hands
from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.harness.rig.rig import Rig
from motorhil.harness.rig.script import read_script, run_script


class Script:
    """A channel without a page: requests at times of a wall clock that only waiting moves.

    Attributes:
        now_ns: the wall clock.
        answers: problem of each request by number.
        states: the states told, in order.
    """

    def __init__(self, requests):
        """Take (wall time [s], act), in order."""
        self.inbox = deque()
        self.is_open = True
        self.now_ns = 0
        self.answers, self.states = {}, []
        self.elements = None
        self._ahead = [(round(at_s * 1e9), act) for at_s, act in requests]
        self._count = 0

    def wait(self, timeout_s):
        if timeout_s > 0.0 and not self.inbox:
            ends_ns = self.now_ns + max(1, round(timeout_s * 1e9))
            self.now_ns = min([ends_ns, *(max(at_ns, self.now_ns) for at_ns, _ in self._ahead[:1])])
        while self._ahead and self._ahead[0][0] <= self.now_ns:
            self._count += 1
            self.inbox.append({"id": self._count, "act": self._ahead.pop(0)[1]})
        if not self._ahead and not self.inbox and self.states and self.states[-1]["stands"]:
            self.is_open = False  # else time would stand still for ever

    def answer(self, number, problem=""):
        self.answers[number] = problem

    def tell_elements(self, elements):
        self.elements = elements

    def finish(self):
        self.is_finished = True

    def tell_state(self, state):
        self.states.append(state)


@pytest.fixture
def driven(tmp_path):
    """Return a function that runs the wheels' program in a rig, with or without hands."""
    folder = copytree(EXAMPLES, tmp_path / "examples")

    def run(name, record, requests=None, pace=1.0, is_stopped=False, **options):
        script = read_script(str(folder / "two_wheels.py"))
        with Rig.open(folder / f"{name}.toml", record=tmp_path / record, **options) as rig:
            channel = None
            if requests is not None:
                channel = Script(requests)
                clock = lambda: channel.now_ns  # noqa: E731 -- as short as it is
                rig.runtime.follow(Brake(Hands(rig), channel, pace, is_stopped, clock))
            run_script(rig, script, (), on_error=lambda error, name: None)
        return tmp_path / record, channel

    return run


@pytest.fixture
def random_acts():
    """Return a function that draws acts on the two wheels within a duration [s]."""

    def draw(seed, count, within_s):
        random = Random(seed)
        acts = [random.choice(_KINDS)(random) for _ in range(count)]
        times = sorted(random.uniform(0.0, within_s) for _ in acts)
        return list(zip(times, acts, strict=True))

    return draw


def _stimulus(name, low, high):
    def draw(random):
        side = random.choice(["left", "right"])
        value = random.uniform(low, high)
        return {"act": "stimulus", "controller": side, "name": name, "value": value}

    return draw


def _fault(kind, keys):
    return lambda random: {"act": "fault", "bus": "can0", "kind": kind, "keys": keys}


_KINDS = (
    _stimulus("load_torque_n_m", -4.0, 4.0),
    _stimulus("load_torque_n_m", -4.0, 4.0),
    _stimulus("device_temperature_c", 20.0, 60.0),
    lambda random: {"act": "stimulus", "controller": "left", "name": "home", "value": 1},
    _fault("cut", 'nodes = ["right"]'),
    _fault("noise", "bit_error_rate = 1e-4"),
    _fault("drop", 'sender = "left", probability = 0.2'),
    _fault("error", 'error = "crc", limit = 2'),
    _fault("delay", "delay_s = 0.0005, limit = 4"),
    _fault("split", 'nodes = ["right"]'),
    lambda random: {"act": "mend", "name": f"hand {random.randrange(1, 8)}"},
    lambda random: {"act": "mend", "name": f"hand {random.randrange(1, 8)}"},
    lambda random: {"act": "stop"},
    lambda random: {"act": "step", "for_s": random.uniform(1e-6, 0.2)},
    lambda random: {"act": "continue"},
    lambda random: {"act": "pace", "pace": random.choice([0.5, 1.0, 10.0])},
)
