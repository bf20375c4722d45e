"""A polled drive on a slow line: the time of a measurement is that of its position."""

from pathlib import Path

import pytest

from motorhil.emulators.media.serial_faults import SerialFaultKind, SerialFaultRule
from motorhil.harness import conformance
from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, ControlVariable

RIGS = Path(conformance.__file__).parent / "rigs"
LATE_NS = 80_000_000  # each answer
EXCHANGE_NS = 8_000_000  # without that
ROUNDING_RAD = 0.002


@pytest.mark.parametrize("kind", ["leadshine", "oriental_az", "dryve"])
def test_position_is_no_older_than_its_answer(kind):
    """A poll of several requests once told a position of its begin with the time of its end."""
    source = Source(RIGS / f"{kind}.toml", (RIGS / f"{kind}.toml").read_text())
    path = []
    with Rig(parse_rig(source, installed_plugins()), seed=1) as rig:
        motor, bus = rig.motors["left"], rig.description.motors["left"].bus
        rig.world.tap_samples(
            1_000_000,
            lambda now_ns, name, truth: (
                path.append((now_ns, truth["position_rad"])) if name == "left" else None
            ),
        )
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(1.0)
        motor.start()
        rig.runtime.run_for(0.2)
        rule = SerialFaultRule("late", SerialFaultKind.DELAY, sender="left", delay_ns=LATE_NS)
        rig.faults.inject(bus, rule)
        for _ in range(3):
            position = motor.position()
            latest = motor.latest()
            assert latest.position == position
            later = 0 if kind == "dryve" else 1  # the others read the demand after it
            assert rig.runtime.now_ns() - latest.time_ns <= later * (LATE_NS + EXCHANGE_NS)
            since_ns = latest.time_ns - LATE_NS - EXCHANGE_NS
            true = [one for now_ns, one in path if since_ns <= now_ns <= latest.time_ns]
            assert max(true) - min(true) > 10 * ROUNDING_RAD  # it moves
            assert min(true) - ROUNDING_RAD <= position <= max(true) + ROUNDING_RAD
