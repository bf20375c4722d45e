"""Real axes, told by emulated drives on a bus, and from their own recordings."""

import numpy as np
import pytest

from motorhil.emulators.cia402.drive import Readings
from motorhil.emulators.firmware.axis import Axis
from motorhil.harness.identification.inverse_model import fitted
from motorhil.harness.identification.output_error import compared, refined
from motorhil.harness.identification.samples import Reading, samples_in
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from tests.support.motion.measured_axes import PUBLISHED, ak80, emps

PER_M = 5e6  # increments of the drive's encoder
RATED_N = 100.0
BEGIN_MS = 1000
LOOP_RAD_S = 200.0  # a chirp is faster than motions of machines
RIG = f"""
[bus.can0]
bitrate_bit_s = 1_000_000

[controller.axis]
kind = "cia402"
bus = "can0"
node_id = 1

[motor.axis]
adaptation = "cia402"
controller = "axis"

[motor.axis.model]
kind = "linear"
velocity_max_m_s = 1.0
acceleration_max_m_s2 = 1.0
increments_per_m = {PER_M}
"""


@pytest.mark.data
@pytest.mark.pure("the state of compiled cores cannot be replaced")
def test_a_measured_axis_told_by_a_drive_in_pdos_agrees(shared, tmp_path, monkeypatch):
    """EMPS as 6064h and 6077h each ms, in increments and thousandths: within 2 %."""
    pytest.importorskip("scipy.io")
    record = emps(shared, "DATA_EMPS.mat")
    position = np.round(record.position * PER_M).astype(int).tolist()
    force = np.round(record.effort / RATED_N * 1000.0).astype(int).tolist()

    def at(axis, values, before):
        number = axis._time.tick - BEGIN_MS
        return values[min(number, len(values) - 1)] if number >= 0 else before

    monkeypatch.setattr(Axis, "position_inc", lambda axis: at(axis, position, position[0]))
    monkeypatch.setattr(Readings, "torque", lambda told: at(told._axis, force, 0))
    (tmp_path / "rig.toml").write_text(RIG)
    file = tmp_path / "emps.mcap"
    options = HwOptions(status_period_ms=1, velocity_period_ms=1, status_inhibit_ms=0.5)
    with Rig.open(tmp_path / "rig.toml", record=file) as rig:
        drive = Cia402HwMotor(rig.bus("can0"), node_id=1, options=options, runtime=rig.runtime)
        drive.connect()
        rig.runtime.wait_until(lambda: False, 25.0)  # the record ends at 25.8 s
        drive.close()
    samples = samples_in(file, "axis", Reading(rated=RATED_N))
    assert samples.unit == "m"
    assert samples.source == "6064h on the bus, 6077h on the bus"
    fit = refined(samples, fitted(samples))
    for name, value in PUBLISHED.items():
        assert fit.parameters[name].value == pytest.approx(value, rel=0.02), name
    assert fit.error <= 0.042


@pytest.mark.data
def test_the_torque_of_an_ak80_is_predicted_on_the_part_not_used(shared):
    """A chirp of current, 3.7 s, on the motor itself: no reference values are published."""
    samples = ak80(shared)
    first, second = samples.part(0.0, 0.48), samples.part(0.48, 1.0)  # its two sweeps
    fit, other = (refined(part, fitted(part), LOOP_RAD_S) for part in (first, second))
    inertia, again = fit.parameters["inertia"], other.parameters["inertia"]
    assert inertia.unseen == again.unseen == ""
    assert inertia.relative < 0.1
    deviation = np.hypot(inertia.deviation, again.deviation)
    assert abs(inertia.value - again.value) < 2.0 * deviation
    assert compared(second, fit, LOOP_RAD_S).error() < 0.55
