"""The bases of a drive on CAN, seen from a kind that is written by hand."""

from dataclasses import dataclass
from math import tau

import pytest

from motorhil.emulators.can.frame import pack
from motorhil.motorapi.api import (
    REQUIRED,
    CanBuilder,
    CanHardware,
    CanMotor,
    LinkError,
    Measurement,
    MotionKind,
    MotorModel,
    MotorState,
    Options,
    PeerError,
    UnsupportedError,
    UsageError,
    adaptation,
    motor_turns,
    output_sign,
    positive,
    require_here,
    text,
    whole,
    whole_steps,
)
from motorhil.motorapi.commands import ControlMode, ControlVariable
from motorhil.motorapi.motion import Motion
from tests.unit.motorapi.api.test_can_drive import Rig

STATUS = 0x201


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveOptions(Options):
    timeout_ms: float = positive(60.0, "ms", "Time without a status.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Table(DriveOptions):
    node_id: int = whole(REQUIRED, 1, 9, "", "Number.", example="1")
    name: str | None = text(None, "Name.")


class Hardware(CanHardware[DriveOptions]):
    OPTIONS = DriveOptions
    NOUN = "a drive"
    NODE_ID_MIN, NODE_ID_MAX = 1, 9
    LACKS = "status"
    CONNECT_S = 0.5

    def _begin(self):
        if self.options.timeout_ms > 1e3:
            raise UsageError("too long")
        self.version, self.checks, self.greetings = None, 0, 0
        self._life = self.drive.expect("status", self.options.timeout_ms / 1e3, self._lose)
        self.drive.handle(STATUS, self._on_status)

    def _on_status(self, data, time_ns):
        self.version = data[0]
        self._life.came(time_ns)

    def _knows(self):
        return self.version is not None

    def _greet(self):
        self.greetings += 1

    def _connected(self):
        self.checks += 1
        if self.version != 1:
            raise PeerError(f"version {self.version}; expected 1")


class Motor(CanMotor[Hardware]):
    def _units_of(self, model):
        return 100.0 * motor_turns(model)

    def _latest(self):
        return Measurement(0, MotorState.DISABLED, 0.0, 0.0)

    def _enable(self):
        pass

    def _disable(self):
        pass

    def _command(self, motion):
        pass

    def _stop(self):
        pass


build = adaptation(api=1, rig="rig.toml")(CanBuilder(Table, Hardware, Motor))


def model(kind=MotionKind.ROTARY, gear_ratio=None):
    limits = {"velocity_max": 1.0, "acceleration_max": 1.0}
    return MotorModel(name="wheel", kind=kind, gear_ratio=gear_ratio, **limits)


@pytest.fixture
def rig():
    rig = Rig()
    yield rig
    rig.close()


def test_a_connection_is_checked_once_and_again_after_a_loss(rig):
    hardware = Hardware(rig.bus, 1)
    with pytest.raises(LinkError, match=r"no status within 0\.5 s"):
        hardware.connect()
    assert hardware.checks == 0
    assert hardware.greetings > 1
    rig.peer.send(pack(STATUS, b"\1"))
    rig.wait(0.001)
    hardware.connect()
    hardware.connect()
    assert hardware.checks == 1
    rig.wait(0.2)
    assert not hardware.is_up()
    rig.peer.send(pack(STATUS, b"\2"))
    rig.wait(0.001)
    for _ in range(2):  # what was refused is not connected
        with pytest.raises(PeerError, match="version 2; expected 1"):
            hardware.connect()
    hardware.close()


def test_overheard_command_ends_the_motion_and_what_was_told(rig):
    hardware = Hardware(rig.bus, 1)
    hardware.drive.remember("mode", 3)
    forgotten = []
    hardware.forget = lambda: forgotten.append(1)  # as a kind adds to it
    hardware.overheard("command 7", 0)
    assert forgotten == [1]
    assert hardware.drive.remembered("mode") is None
    hardware.close()


def test_motor_offers_the_start_that_its_drive_declares(rig):
    motor = build(rig.bus, {"node_id": 1}, model(gear_ratio=2.0), rig.runtime)
    assert motor._sync_offer().no_firing_bound == "no bound is known for that command"
    motor.hardware.drive.starts_by(0x101, 4)
    assert motor._sync_offer() == motor.hardware.drive.start_offer(0x101, 4)
    motor.close()


def test_refused_hardware_leaves_its_place_free(rig):
    with pytest.raises(UsageError, match="too long"):
        Hardware(rig.bus, 1, options=DriveOptions(timeout_ms=2e3))
    for node_id in (0, 10):
        with pytest.raises(UsageError, match=f"drive = {node_id}: out of range; expected 1 to 9"):
            Hardware(rig.bus, node_id)
    Hardware(rig.bus, 1).close()


def test_motors_of_a_builder_share_one_hardware_object(rig):
    own = model(gear_ratio=2.0)
    left = build(rig.bus, {"node_id": 1}, own, rig.runtime)
    right = build(rig.bus, {"node_id": 1, "name": "right"}, own, rig.runtime)
    assert left.hardware is right.hardware
    assert right.name == "right"
    assert left._units == pytest.approx(200.0 / tau)
    with pytest.raises(UsageError, match="is used with other settings already"):
        build(rig.bus, {"node_id": 1, "timeout_ms": 5.0}, own, rig.runtime)
    left.close()
    assert not right.hardware.is_closed
    right.close()
    assert right.hardware.is_closed
    assert build.conformance_rig == "rig.toml"
    assert build.__module__ == __name__  # the rig is beside it


def test_units_of_models():
    with pytest.raises(UsageError, match=r"gear_ratio is missing.*; add it"):
        motor_turns(model())
    assert motor_turns(model(gear_ratio=3.0, kind=MotionKind.LINEAR)) == 3.0
    assert (output_sign(model()), output_sign(model(gear_ratio=-2.0))) == (1.0, -1.0)
    with pytest.raises(UsageError, match="kind is linear; expected rotary"):
        output_sign(model(kind=MotionKind.LINEAR))


def test_homing_by_another_method_than_here_is_refused():
    require_here("left", None)
    require_here("left", 37)
    with pytest.raises(UnsupportedError, match="homing by method 1"):
        require_here("left", 1)


def test_whole_steps_are_never_faster():
    motion = Motion(
        *(ControlMode.SETPOINT, ControlVariable.POSITION, 0.0, 0.126, 0.99, 0.55, 0.004)
    )
    rounded = whole_steps(motion, -100.0)
    assert (rounded.target, rounded.velocity) == (0.13, 0.99)
    assert (rounded.acceleration, rounded.deceleration) == (0.55, 0.01)
    assert whole_steps(rounded, -100.0) == rounded
