"""Kinds of hardware, each as a rig of two motors, `left` and `right`, in a group.

Tests may rely only on the facts of a kind stated here: its commands, its deviation from a
trajectory, its deviation from the target. All kinds have the same motor model: 2 rad/s, 4 rad/s^2.
"""

from contextlib import contextmanager
from dataclasses import dataclass

from motorhil.harness.rig.config.rig_file import parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlVariable

POSITION, VELOCITY = ControlVariable.POSITION, ControlVariable.VELOCITY
TORQUE, CURRENT = ControlVariable.TORQUE, ControlVariable.CURRENT
VELOCITY_MAX, ACCELERATION_MAX = 2.0, 4.0

MODEL = f"""\
velocity_max_rad_s = {VELOCITY_MAX}
acceleration_max_rad_s2 = {ACCELERATION_MAX}
torque_max_n_m = 5.0
current_max_a = 4.0
gear_ratio = 66.0
encoder_increments_rev = 2000
velocity_unit_rad_s = 4.7599888690754445e-05
acceleration_unit_rad_s2 = 4.7599888690754445e-05
"""
GROUP = '[group.both]\nmotors = ["left", "right"]\n'
BUS = "[bus.can0]\nbitrate_bit_s = 1_000_000\n"


_CIA402_DRIVE = """\
[controller.{name}]
kind = "cia402"
bus = "can0"
node_id = {number}
plant = {{ preset = "wheel_60w" }}
"""
_IO_NODE = """\
[controller.node]
kind = "cia401"
bus = "can0"
node_id = 1
channels = 2
plant = { preset = "wheel_60w" }
"""
# The motor of each kind, to be formatted with its name and place ("left", 1) or ("right", 2).
_IDEAL = 'adaptation = "ideal"\naxis = "{place}"\n'
_CIA402 = 'adaptation = "cia402"\ncontroller = "{place}"\nservo_period_ms = 1.0\n'
_SOFTWARE = """\
adaptation = "software"
controller = "node"
channel = {number}
current_per_volt_a_v = 0.8
torque_constant_n_m_a = 1.7094
amplifier_tick_ms = 0.1
[motor.{name}.gains]
bandwidth_rad_s = 60.0
acceleration_feedforward_a_s2_rad = 0.038
friction_feedforward_a = 0.154
"""
_LINE = '[bus.line]\nkind = "modbus_rtu"\nbaud_bit_s = 115_200\nparity = "N"\n'
_MODBUS_DRIVE = """\
[controller.{name}]
kind = "{kind}"
bus = "line"
unit = {number}
plant = {{ preset = "wheel_60w" }}
"""
_MODBUS = 'adaptation = "{kind}"\ncontroller = "{{place}}"\n'
_PLACES = (("left", 1), ("right", 2))


@dataclass(frozen=True)
class Kind:
    """One kind of hardware with its guarantees.

    hardware: the devices on its bus, in a rig file.
    motor: one of its motors, in a rig file.
    following: maximum deviation of the motor from the demand, at any instant [rad].
    window: maximum deviation from its target at the end [rad].
    latency_s: minimum and maximum time from the reported start to the start of motion.
    heard_s: maximum age of another motor's position when it is used.
    variables: its control variables, for set-points and for trajectories.
    complex: the variables for which it follows any function.
    """

    name: str
    hardware: str
    motor: str
    following: float
    window: float
    latency_s: tuple[float, float]
    heard_s: float
    variables: tuple
    complex: tuple

    def rig(self, users=()):
        """Return the rig of a left and a right motor, with these logical motors of the left one."""
        places = [*((name, name, number) for name, number in _PLACES)]
        places += [(user, "left", 1) for user in users]
        return (
            self.hardware
            + "".join(
                f"[motor.{name}]\n"
                + self.motor.format(name=name, place=place, number=number)
                + f"[motor.{name}.model]\n{MODEL}"
                for name, place, number in places
            )
            + GROUP
        )


ALL = (POSITION, VELOCITY, TORQUE, CURRENT)
DRIVES = "".join(_CIA402_DRIVE.format(name=name, number=number) for name, number in _PLACES)


def modbus_kind(adaptation, controller):
    """Return register drives: profiles in whole rpm or steps, polled in turn every 10 ms."""
    drives = (
        _MODBUS_DRIVE.format(name=name, number=number, kind=controller) for name, number in _PLACES
    )
    return Kind(
        adaptation,
        _LINE + "".join(drives),
        _MODBUS.format(kind=adaptation),
        0.06,  # it began up to one exchange before or after the report
        0.003,
        (-0.02, 0.02),
        0.1,
        (POSITION, VELOCITY),
        (),
    )


KINDS = {
    kind.name: kind
    for kind in (
        Kind("ideal", "", _IDEAL, 1e-12, 1e-12, (0.0, 0.0), 0.0, ALL, ALL),
        Kind(
            "cia402",
            BUS + DRIVES,
            _CIA402,
            0.0005,  # ten increments: one tick of delay in the control loops of the drive
            0.001,
            (0.0, 0.001),
            0.04,  # status every 20 ms, applied as a step
            (POSITION, VELOCITY, TORQUE),
            (POSITION, VELOCITY),
        ),
        Kind(
            "software",
            BUS + _IO_NODE,
            _SOFTWARE,
            0.0002,  # four increments: the demand is predicted to the time of the output
            0.001,
            (0.0, 0.0),
            0.004,
            ALL,
            ALL,
        ),
    )
}


ASKED = {
    name: modbus_kind(name, controller)
    for name, controller in (
        ("leadshine", "leadshine_pr"),
        ("oriental_az", "oriental_az"),
    )
}
"""Kinds that must be polled, and follow no function: they meet the common rules in their own time.
"""
EVERY = {**KINDS, **ASKED}


@contextmanager
def opened(kind, path, users=()):
    """Open the rig of the kind; `path` is its name, and not read."""
    description = parse_rig(Source(path, kind.rig(users)), installed_plugins())
    with Rig(description) as rig:
        yield rig


def true_position(rig, name):
    """Return the true position of the motor [rad], from the plant and not from the bus."""
    motor = rig.description.motors[name]
    if motor.controller is None:
        return rig.motors[name].position()
    prefix = "" if motor.settings.get("channel", 1) == 1 else "channel_2_"
    return rig.controllers[motor.controller].snapshot()[f"{prefix}position_rad"]
