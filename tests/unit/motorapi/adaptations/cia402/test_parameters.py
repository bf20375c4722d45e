"""Parameters of a logical motor: gains and windows, written at its start."""

from collections.abc import Callable
from math import inf
from pathlib import Path

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.adaptations.canopen.errors import ProtocolViolation
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.cia402.parameters import Cia402Parameters
from motorhil.motorapi.commands import ControlMode
from motorhil.motorapi.errors import LimitError, UnsupportedError, UsageError
from motorhil.motorapi.state import MotorState
from tests.support.checkout import CHECKOUT
from tests.support.motors.drive_rigs import drive
from tests.unit.motorapi.adaptations.cia402.test_controlword import written_to_left

OpenRig = Callable[..., Rig]
OWN_EDS = CHECKOUT / "emulators" / "eds" / "motorhil_cia402.eds"
INC_PER_RAD = 132_000 / (2 * 3.141592653589793)
OWN = 66_667  # 60FBh:1 of the emulated drive's default motor, in 1/1000 per s


@pytest.fixture
def rig(open_rig: OpenRig) -> Rig:
    return open_rig(drive("left", 1))


def two_motors(rig: Rig) -> tuple[Cia402Motor, Cia402Motor]:
    first = rig.motors["left"]
    assert isinstance(first, Cia402Motor)
    return first, Cia402Motor(first.hardware, first.model, name="second")


def move(motor: Cia402Motor, distance: float = 0.01) -> None:
    motor.set_control_mode(ControlMode.SETPOINT)
    motor.set_setpoint(distance, relative=True)
    motor.start()
    motor.wait_until_done(timeout_s=3)


def gain(motor: Cia402Motor) -> object:
    return motor.hardware.read(0x60FB, 1, "u32")


def test_two_logical_motors_each_move_with_their_own_gains(rig: Rig):
    """The paper, 3.5: settings of one do not affect another on the same hardware."""
    soft, stiff = two_motors(rig)
    soft.set_parameters(Cia402Parameters(position_gains=(20_000,)))
    stiff.set_parameters(Cia402Parameters(position_gains=(60_000,)))
    for _ in range(3):
        move(soft)
        assert gain(soft) == 20_000
        move(stiff)
        assert gain(stiff) == 60_000
    written = written_to_left(rig)
    move(stiff)
    move(stiff)
    assert "60FB" not in [name for name, _ in written]  # it has not changed hands


def test_original_value_that_was_cut_is_not_restored(rig: Rig, monkeypatch: pytest.MonkeyPatch):
    """One bit of the answer's length had turned: 2 of 4 bytes were kept, and written back."""
    motor, _ = two_motors(rig)
    move(motor)
    motor.set_parameters(Cia402Parameters(position_window=0.05))
    sdo = motor.hardware.node.sdo
    whole = sdo.upload
    monkeypatch.setattr(
        sdo, "upload", lambda *place: whole(*place)[: 2 if place == (0x6067, 0) else 8]
    )
    with pytest.raises(ProtocolViolation, match="2 bytes"):
        move(motor)
    monkeypatch.undo()
    move(motor)


def test_what_was_written_is_believed_only_while_the_motor_does_not_change_hands(rig: Rig):
    """An owner in between may have written other values; here they are written directly."""
    first, second = two_motors(rig)
    for motor in (first, second):
        motor.set_parameters(Cia402Parameters(position_gains=(30_000,)))
    move(first)
    first.hardware.node.sdo.download(0x60FB, 1, (50_000).to_bytes(4, "little"))
    move(first)
    assert gain(first) == 50_000
    move(second)
    assert gain(second) == 30_000


def test_open_parameters_get_the_drives_own_values(rig: Rig):
    tuned, plain = two_motors(rig)
    tuned.set_parameters(Cia402Parameters(position_gains=(20_000, None, 0), position_window=0.05))
    move(tuned)
    assert tuned.hardware.read(0x60FB, 3, "u32") == 0
    assert tuned.hardware.read("position_window") == round(0.05 * INC_PER_RAD)
    move(plain)
    assert gain(plain) == OWN
    assert plain.hardware.read(0x60FB, 3, "u32") == 1_801_069
    assert plain.hardware.read("position_window") == 10
    tuned.set_parameters(Cia402Parameters())
    move(tuned)
    assert gain(tuned) == OWN


def test_setting_and_reading_parameters_send_nothing(rig: Rig):
    motor, _ = two_motors(rig)
    parameters = Cia402Parameters(velocity_gains=(300_000, 15_000_000))
    motor.set_parameters(parameters)
    assert motor.parameters is parameters
    assert motor.state() is MotorState.OFFLINE
    rig.runtime.run_for(0.5)
    assert motor.state() is MotorState.OFFLINE


def test_parameters_are_written_again_after_a_drive_reset(rig: Rig):
    motor, _ = two_motors(rig)
    motor.set_parameters(Cia402Parameters(position_gains=(20_000,)))
    move(motor)
    motor.disable()
    motor.hardware.node.bus.nmt(0x81, 1)  # reset node restores the drive's own values
    rig.runtime.run_for(1.0)
    move(motor)
    assert gain(motor) == 20_000


def test_low_level_access_may_change_the_own_values(rig: Rig):
    tuned, plain = two_motors(rig)
    tuned.set_parameters(Cia402Parameters(position_gains=(20_000,)))
    move(tuned)
    with plain.low_level() as hardware:
        hardware.write(0x60FB, 44_000, 1, "u32")
    move(plain)
    assert gain(plain) == 44_000
    move(tuned)
    assert gain(tuned) == 20_000
    move(plain)
    assert gain(plain) == 44_000


def test_windows_are_in_si_units(rig: Rig):
    motor, _ = two_motors(rig)
    motor.set_parameters(
        Cia402Parameters(
            position_window=0.01,
            position_window_s=0.05,
            velocity_window=0.02,
            velocity_window_s=0.015,
            following_error_window=0.1,
            following_error_s=0.2,
        )
    )
    move(motor)
    read = motor.hardware.read
    assert read("position_window") == round(0.01 * INC_PER_RAD)
    assert read("position_window_time") == 50
    assert read("velocity_window") == int(0.02 * INC_PER_RAD)  # rounded down, as velocities are
    assert read("velocity_window_time") == 15
    assert read("following_error_window") == round(0.1 * INC_PER_RAD)
    assert read("following_error_time_out") == 200
    motor.set_parameters(Cia402Parameters(following_error_window=inf))
    move(motor)
    assert read("following_error_window") == 0xFFFF_FFFF  # off


def test_wider_window_is_reached_earlier(rig: Rig):
    motor, _ = two_motors(rig)
    took = []
    for window in (0.0005, 0.3):
        motor.set_parameters(Cia402Parameters(position_window=window, position_window_s=0.0))
        began_ns = rig.runtime.now_ns()
        move(motor, 1.0)
        took.append(rig.runtime.now_ns() - began_ns)
        rig.runtime.run_for(0.5)
    assert took[1] <= took[0]


def test_unstable_gain_is_refused_before_motion(rig: Rig):
    motor, _ = two_motors(rig)
    motor.set_parameters(Cia402Parameters(current_gains=(4_000_000_000,)))
    with pytest.raises(UnsupportedError, match="60F6h:1 = 4000000000"):
        move(motor)
    assert rig.controllers["left"].snapshot()["demand_inc"] == 0
    motor.set_parameters(Cia402Parameters())
    move(motor, 0.5)


def test_parameter_that_the_drive_keeps_is_not_restored(open_rig: OpenRig, tmp_path: Path):
    text = OWN_EDS.read_text()
    before, window, after = text.partition("ParameterName=Following error window\n")
    eds = tmp_path / "fixed_window.eds"
    eds.write_text(before + window + after.replace("AccessType=rww", "AccessType=ro", 1))
    motor, _ = two_motors(open_rig(drive("left", 1, f'eds = "{eds}"')))
    motor.set_parameters(Cia402Parameters(following_error_window=1.0))
    with pytest.raises(UnsupportedError, match="6065h = "):
        move(motor)
    motor.set_parameters(Cia402Parameters())
    move(motor, 0.5)


def test_missing_parameter_object_is_reported(rig: Rig):
    motor, _ = two_motors(rig)
    motor.set_parameters(Cia402Parameters(current_gains=(None, None, 7)))
    with pytest.raises(UnsupportedError, match="60F6h:3"):
        move(motor)
    motor.set_parameters(Cia402Parameters(position_gains=(2**40,)))
    with pytest.raises(UnsupportedError, match="60FBh:1 = 1099511627776: it has 4 bytes"):
        move(motor)
    motor.set_parameters(Cia402Parameters(position_window=1e-6))
    with pytest.raises(LimitError, match="whole increments"):
        move(motor)


@pytest.mark.parametrize(
    "wrong",
    [
        {"position_gains": 5},
        {"position_gains": (0.5,)},
        {"position_gains": (True,)},
        {"position_window": 0.0},
        {"position_window": inf},
        {"velocity_window": "wide"},
        {"position_window_s": -0.1},
        {"position_window_s": 66.0},
        {"following_error_window": -1.0},
    ],
)
def test_invalid_parameter_is_refused_by_name(wrong: dict[str, object]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Cia402Parameters(**wrong)  # type: ignore[arg-type]


def test_set_parameters_of_another_type_is_refused(rig: Rig):
    motor, _ = two_motors(rig)
    with pytest.raises(UsageError, match="is not a Cia402Parameters"):
        motor.set_parameters({"position_gains": (1,)})  # type: ignore[arg-type]


@pytest.mark.data
def test_gains_are_written_in_the_vendors_size(open_rig: OpenRig, shared):
    """Gains of maxon's drives are INTEGER16; the emulated drive keeps them as integers."""
    eds = shared / "data" / "eds" / "maxon_epos2_50_5.eds"
    rig = open_rig(
        drive(
            "left",
            1,
            f'eds = "{eds}"\nobjects = {{ "6065h" = 0xFFFFFFFF }}\n'
            "units = { velocity_unit_inc_s = 1000.0, acceleration_unit_inc_s2 = 1000.0 }",
            model="increments_per_rad = 21008.4524\nvelocity_unit_rad_s = 0.0476\n"
            "acceleration_unit_rad_s2 = 0.0476",
        )
    )
    motor, plain = two_motors(rig)
    motor.set_parameters(Cia402Parameters(position_gains=(200, 11)))
    move(motor)
    assert motor.hardware.read(0x60FB, 1, "i16") == 200
    move(plain)
    assert (plain.hardware.read(0x60FB, 1, "i16"), plain.hardware.read(0x60FB, 2, "i16")) == (
        150,
        10,
    )
