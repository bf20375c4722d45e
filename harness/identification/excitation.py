"""A motion that shows inertia, friction and load of a motor, and the application that makes it.

Each move goes there and back, so that friction and a constant load differ. Speeds and
accelerations vary: inertia shows in hard ramps, viscous friction at high speeds, Coulomb friction
at low ones. All values stay a tenth below the limits of the motor's model.

Source: Swevers et al., "Optimal Robot Excitation and Identification", IEEE Trans. Robotics and
Automation 13 (1997), for what excites; trapezoids, because every drive knows them.
"""

from collections.abc import Mapping
from math import sqrt
from pathlib import Path
from typing import Final, NamedTuple, final

from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.toml import RigError
from motorhil.motorapi.model import MotorModel
from motorhil.settings import listed, nearest

PERIOD_MS: Final = 4
"""Period of position and torque, in which the drive of the application sends both."""
_MARGIN: Final = 0.9  # of each limit
_ROOM: Final = 0.8  # of a limited range
_CRUISE_S: Final = 0.5
_SHARES: Final = (  # of highest speed and acceleration
    *((1.0, 1.0), (0.12, 0.3), (0.6, 0.7), (0.3, 1.0), (0.8, 0.4), (0.06, 0.2), (0.45, 0.5)),
    *((0.9, 0.8), (0.2, 0.6), (0.7, 1.0)),
)
_RAMP_S: Final = 0.1  # the shortest ramp: samples must show it
_ADAPTATION: Final = "cia402"


@final
class Move(NamedTuple):
    """One move there, and then back.

    Attributes:
        distance: [rad or m].
        velocity: highest speed [rad/s or m/s].
        acceleration: [rad/s^2 or m/s^2].
    """

    distance: float
    velocity: float
    acceleration: float


def moves_of(model: MotorModel) -> tuple[Move, ...]:
    """Return the moves for a motor, within the limits of its model."""
    fastest = _MARGIN * model.velocity_max
    hardest = _MARGIN * min(model.acceleration_max, model.deceleration_max or float("inf"))
    low, high = model.position_min, model.position_max
    room = float("inf") if low is None or high is None else _ROOM * (high - low) / 2.0
    moves: list[Move] = []
    for speed_share, acceleration_share in _SHARES:
        speed, acceleration = speed_share * fastest, acceleration_share * hardest
        acceleration = min(acceleration, speed / _RAMP_S)
        distance = speed * speed / acceleration + speed * _CRUISE_S
        if distance > room:  # the same shape in the room there is
            distance, speed = room, sqrt(0.5 * room * acceleration)
            speed = min(speed, speed_share * fastest)
        moves.append(Move(*(float(f"{one:.4g}") for one in (distance, speed, acceleration))))
    return tuple(moves)


def middle_of(model: MotorModel) -> float | None:
    """Return the middle of a limited range [rad or m]; None: it is not limited."""
    low, high = model.position_min, model.position_max
    return None if low is None or high is None else (low + high) / 2.0


def application_for(
    description: RigDescription, name: str, models: Mapping[str, MotorModel]
) -> str:
    """Return the application that excites a motor of a rig.

    Raises:
        RigError: the rig has no such motor, or it is of another kind than CiA 402.
    """
    path = description.source.path
    motor = description.motors.get(name)
    if motor is None:
        known = list(description.motors)
        raise RigError(path, f"has no motor {name!r} ({listed(known)})", nearest(name, known))
    if motor.adaptation != _ADAPTATION or not isinstance(motor.model, Path):
        problem = f"{name} is driven by {motor.adaptation!r}; expected {_ADAPTATION!r}"
        if motor.adaptation == _ADAPTATION:
            problem = f"the model of {name} is a table; expected a file beside the rig"
        remedy = "move it with an application of yours: there and back, at several speeds"
        raise RigError(path, problem, remedy)
    model = models[name]
    moves = "\n".join(
        f"    ({one.distance}, {one.velocity}, {one.acceleration})," for one in moves_of(model)
    )
    return _APPLICATION.format(
        name=name,
        unit=model.unit,
        rig=path.name,
        bus=motor.bus,
        node=motor.node_id,
        model=motor.model.name,
        moves=moves,
        middle=middle_of(model),
        period=PERIOD_MS,
        script=script_of(name),
    )


def script_of(name: str) -> str:
    """Return the name of the application's file."""
    return f"excite_{''.join(one if one.isalnum() else '_' for one in name)}.py"


_APPLICATION: Final = '''\
"""Move {name} so that a recording shows its inertia, friction and load.

motorhil run {rig} {script} -o {name}.mcap             emulated, in virtual time
motorhil identify {name}.mcap --motor {name} --gear N

On the drive itself, record the bus meanwhile, and name the rig, which knows the motor's units:

motorhil record --on {bus}=can0 -o {name}.mcap
CAN_INTERFACE=socketcan CAN_CHANNEL=can0 python {script}
motorhil identify {name}.mcap --rig {rig} --motor {name} --gear N

Free the axis first: it moves there and back by the distances below.
"""

import time
from contextlib import closing
from pathlib import Path

import can

from motorhil.motorapi import ControlMode, DerivativeLimits, MotorModel, TrapezoidalTrajectory
from motorhil.motorapi.adaptations.cia402.bringup import HwOptions
from motorhil.motorapi.adaptations.cia402.hardware import Cia402HwMotor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor

MODEL = MotorModel.load(Path(__file__).parent / "{model}")
OPTIONS = HwOptions(status_period_ms={period}, velocity_period_ms={period})  # position, torque
MIDDLE = {middle}  # of a limited range [{unit}]
ROUNDS = 2
MOVES = (  # distance [{unit}], speed [{unit}/s], acceleration [{unit}/s^2]
{moves}
)


def main() -> None:
    """Make each move there and back."""
    with can.Bus() as bus, closing(Cia402HwMotor(bus, node_id={node}, options=OPTIONS)) as drive:
        motor = Cia402Motor(drive, MODEL, name="{name}")
        motor.torque()  # the drive tells its rated torque, and the recording knows it
        drive.objects.read_optional(0x6075)  # its rated current
        motor.enable()
        if MIDDLE is not None:
            motor.set_control_mode(ControlMode.SETPOINT)
            motor.set_setpoint(MIDDLE)
            motor.start()
            motor.wait_until_done(timeout_s=60.0)
        motor.set_control_mode(ControlMode.TRAJECTORY)
        for distance, speed, acceleration in ROUNDS * MOVES:
            limits = DerivativeLimits(first=speed, second=acceleration)
            for way in (distance, -distance):
                motor.set_trajectory(TrapezoidalTrajectory(way, limits=limits))
                motor.start()
                time.sleep(0.05)  # within the ramp: current beside torque is the torque constant
                drive.objects.read_optional(0x6078)
                motor.wait_until_done(timeout_s=60.0)
        motor.disable()


if __name__ == "__main__":
    main()
'''
