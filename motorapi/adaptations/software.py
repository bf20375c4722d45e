"""Central servo: the names that applications and rigs use.

The servo runs on the host, as on JPL's FIDO: trajectories are sampled and PID is computed once a
cycle. The hardware is a plain torque amplifier and an encoder counter on a CANopen I/O node::

    hw = AmplifierHwMotor(bus, node_id=3, channel=1, current_per_volt_a_v=0.8)
    gains = PidGains.tuned(60.0, current_per_acceleration=0.038)
    motor = SoftwareMotor(hw, MotorModel.load("wheel.toml"), gains)
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Final

from motorapi.adaptations.building import Shared, as_name, number, refuse_unknown
from motorapi.adaptations.software_cycle import CycleReport
from motorapi.adaptations.software_gains import PidGains
from motorapi.adaptations.software_hardware import AmplifierHwMotor
from motorapi.adaptations.software_motor import ServoParameters, SoftwareMotor
from motorapi.adaptations.software_options import IoOptions
from motorapi.errors import UsageError
from motorapi.sharing import bus_key

if TYPE_CHECKING:
    import can

    from motorapi.model import MotorModel
    from motorapi.runtime import Runtime

__all__ = [
    "AmplifierHwMotor",
    "CycleReport",
    "IoOptions",
    "PidGains",
    "ServoParameters",
    "SoftwareMotor",
    "build",
]

_OPTIONS: Final = tuple(field.name for field in fields(IoOptions))
# Fields and their keys in a table; {u} is the motor's unit (rad or m).
_SETTINGS: Final = {
    "position_window": "position_window_{u}",
    "settle_s": "settle_s",
    "following_error_window": "following_error_window_{u}",
    "following_error_s": "following_error_s",
    "quick_stop_deceleration": "quick_stop_deceleration_{u}_s2",
}
_GAINS: Final = {
    "kp": "kp_a_{u}",
    "ki": "ki_a_{u}_s",
    "kd": "kd_a_s_{u}",
    "velocity_feedforward": "velocity_feedforward_a_s_{u}",
    "acceleration_feedforward": "acceleration_feedforward_a_s2_{u}",
    "friction_feedforward": "friction_feedforward_a",
    "derivative_filter_s": "derivative_filter_s",
}
_BANDWIDTH: Final = "bandwidth_rad_s"
_TORQUE: Final = {"rad": "torque_constant_n_m_a", "m": "torque_constant_n_a"}
_SHARED: Final[Shared[AmplifierHwMotor]] = Shared("amplifier")


def build(
    bus: "can.BusABC", settings: Mapping[str, object], model: "MotorModel", runtime: "Runtime"
) -> SoftwareMotor:
    """Return the motor described by a settings table (`motorhil.adaptations`, software).

    Motors that name the same channel of a node share one hardware object.

    Args:
        bus: the bus of the node.
        settings: `node_id`, `channel` (1), `current_per_volt_a_v`, `gains` (a table); `name`; any
            field of IoOptions; any of ServoParameters, with its unit in the key.
        model: the motor model.
        runtime: the runtime to wait with.

    Raises:
        UsageError: a setting is unknown, missing or invalid.
    """
    keys = {key.format(u=model.unit): field for field, key in _SETTINGS.items()}
    torque = _TORQUE[model.unit]
    own = ("name", "node_id", "channel", "current_per_volt_a_v", torque, "gains")
    known = (*own, *keys, *_OPTIONS)
    refuse_unknown(settings, known, "setting of a software motor")
    for key, example in (("current_per_volt_a_v", "0.8"), ("gains", "a table")):
        if key not in settings:
            raise UsageError(f"{key} is missing: write {key} = {example}")
    node_id = _whole(settings, "node_id", None)
    channel = _whole(settings, "channel", 1)
    options = IoOptions(
        **{key: number(key, value) for key, value in settings.items() if key in _OPTIONS}  # type: ignore[arg-type]  # IoOptions checks them
    )
    current_per_volt_a_v = float(number("current_per_volt_a_v", settings["current_per_volt_a_v"]))
    gains = _gains(settings["gains"], model.unit)
    parameters = ServoParameters(
        **{field: number(key, settings[key]) for key, field in keys.items() if key in settings}
    )
    hardware = _SHARED.get(
        (*bus_key(bus), node_id, channel),
        lambda: AmplifierHwMotor(
            *(bus, node_id, channel),
            current_per_volt_a_v=current_per_volt_a_v,
            runtime=runtime,
            options=options,
        ),
        lambda built: (
            (built.options, built.current_per_volt_a_v) == (options, current_per_volt_a_v)
        ),
    )
    return SoftwareMotor(
        hardware,
        model,
        gains,
        parameters=parameters,
        torque_constant=number(torque, settings[torque]) if torque in settings else None,
        name=as_name(settings.get("name")),
        on_close=lambda: _SHARED.give_back(hardware),
    )


def _gains(table: object, unit: str) -> PidGains:
    """Return the gains of a table: given one by one, or tuned for a bandwidth."""
    if not isinstance(table, Mapping):
        raise UsageError(f"gains = {table!r}: must be a table")
    keys = {key.format(u=unit): field for field, key in _GAINS.items()}
    refuse_unknown(table, (_BANDWIDTH, *keys), "gain")
    given = {field: number(key, table[key]) for key, field in keys.items() if key in table}
    if _BANDWIDTH not in table:
        if "kp" not in given:
            raise UsageError(
                f"gains: {_GAINS['kp'].format(u=unit)} is missing; give it, or {_BANDWIDTH} with"
                f" {_GAINS['acceleration_feedforward'].format(u=unit)}"
            )
        return PidGains(**given)
    inertia = given.pop("acceleration_feedforward", None)
    if inertia is None:
        key = _GAINS["acceleration_feedforward"].format(u=unit)
        raise UsageError(
            f"gains: {_BANDWIDTH} needs {key}, the current per acceleration of the motor"
        )
    tuned = PidGains.tuned(number(_BANDWIDTH, table[_BANDWIDTH]), inertia)
    return PidGains(**{**{f.name: getattr(tuned, f.name) for f in fields(tuned)}, **given})


def _whole(settings: Mapping[str, object], key: str, default: int | None) -> int:
    value = settings.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool):
        raise UsageError(f"{key} = {value!r}: must be an integer")
    return value
