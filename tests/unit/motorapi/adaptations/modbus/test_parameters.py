"""Parameters of Modbus drives, kept per logical motor."""

import pytest

from motorhil.motorapi import ControlMode
from motorhil.motorapi.adaptations.leadshine import LeadshineMotor, LeadshineParameters
from motorhil.motorapi.adaptations.oriental_az import OrientalAzMotor, OrientalAzParameters
from motorhil.motorapi.errors import UsageError
from tests.support.modbus.rigs import opened, text

# The register of the current limit, and its values at power-on and for the parameters.
KINDS = {
    "leadshine": (LeadshineMotor, LeadshineParameters(peak_current_a=2.5), 0x0191, 80, 25),
    "oriental_az": (OrientalAzMotor, OrientalAzParameters(current_ratio=0.6), 0x0065, 1000, 600),
}


def move(motor, position):
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(position)
    motor.start()
    motor.wait_until_done(5)


@pytest.mark.parametrize("adaptation", list(KINDS))
def test_parameters_of_one_motor_do_not_affect_another(adaptation):
    kind, parameters, register, own, wanted = KINDS[adaptation]
    with opened(text(adaptation)) as rig:
        gentle = rig.motors["mast"]
        other = kind(gentle.hardware, gentle.model, name="other")
        registers = gentle.hardware.registers
        gentle.enable()
        gentle.set_parameters(parameters)
        for motor, current in ((other, own), (gentle, wanted), (other, own), (gentle, wanted)):
            move(motor, 0.1 if motor is gentle else 0.0)
            assert registers.read(register) == [current]
        assert (gentle.parameters, other.parameters) == (parameters, type(parameters)())


@pytest.mark.parametrize("adaptation", list(KINDS))
def test_parameters_of_another_kind_are_refused(adaptation):
    with opened(text(adaptation)) as rig, pytest.raises(UsageError, match="is not a"):
        rig.motors["mast"].set_parameters({"current": 1.0})


@pytest.mark.parametrize("current", [0.0, 0.09, 70.1, float("nan"), "1"])
def test_impossible_peak_current_is_refused(current):
    with pytest.raises(UsageError, match=r"0\.1 to 70 A"):
        LeadshineParameters(peak_current_a=current)


@pytest.mark.parametrize("ratio", [0.0, 0.0009, 1.001, float("nan")])
def test_impossible_current_ratio_is_refused(ratio):
    with pytest.raises(UsageError, match=r"0\.001 to 1"):
        OrientalAzParameters(current_ratio=ratio)
