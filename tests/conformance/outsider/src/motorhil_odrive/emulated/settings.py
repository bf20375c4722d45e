"""Settings of an emulated ODrive: its table `[controller.NAME]` in a rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.settings.motor import MOTOR_KEYS, MotorSettings, motor_in
from motorhil.emulators.settings.tables import duration_ns, number, refuse_unknown, table_in, whole

NODE_ID_MAX: Final = 0x3E
_TIMING: Final = ("boot_up_s", "heartbeat_s", "encoder_s", "calibration_s")
_CONFIG: Final = {  # key: default, lowest, highest
    "watchdog_s": (0.0, 0.0, 3600.0),
    "velocity_ramp_rev_s2": (1.0, 1e-6, 1e9),
    "torque_ramp_n_m_s": (0.01, 1e-9, 1e9),
    "homing_speed_rev_s": (0.25, 1e-6, 1e4),
}


@final
@dataclass(frozen=True, slots=True, kw_only=True)
class OdriveSettings:
    """The settings of one ODrive.

    Attributes:
        node_id: 0..62.
        serial_number: 48 bits.
        motor: the motor, its plant and its gains.
        boot_up_ns: from power-on to the first heartbeat.
        heartbeat_ns, encoder_ns: periods of 01h and 09h; 0: only on request.
        calibration_ns: the duration of every calibration.
        watchdog_ns: without a message for this time it disarms; 0: never (default).
        velocity_ramp_rev_s2: the ramp of the input mode VEL_RAMP.
        torque_ramp_n_m_s: the ramp of the input mode TORQUE_RAMP.
        homing_speed_rev_s: the speed towards the end stop.
        min_endstop_rad: the position at the output where its end stop switch closes; None: no
            switch.
    """

    node_id: int
    serial_number: int
    motor: MotorSettings
    boot_up_ns: int
    heartbeat_ns: int
    encoder_ns: int
    calibration_ns: int
    watchdog_ns: int
    velocity_ramp_rev_s2: float
    torque_ramp_n_m_s: float
    homing_speed_rev_s: float
    min_endstop_rad: float | None


def read_settings(table: Mapping[str, object], context: ControllerContext) -> OdriveSettings:
    """Read the settings in a rig's table.

    Raises:
        SettingError: a key is unknown, or a value is missing or wrong.
    """
    known = ("node_id", "serial_number", *MOTOR_KEYS, "timing", *_CONFIG, "min_endstop_rad")
    refuse_unknown(table, known, ())
    if "node_id" not in table:
        raise SettingError(("node_id",), "is missing", f"a number 0..{NODE_ID_MAX}")
    timing = table_in(table, "timing")
    refuse_unknown(timing, _TIMING, ("timing",))
    config = {
        key: number(table.get(key, default), (key,), low, high)
        for key, (default, low, high) in _CONFIG.items()
    }
    endstop = table.get("min_endstop_rad")
    return OdriveSettings(
        node_id=whole(table["node_id"], ("node_id",), 0, NODE_ID_MAX),
        serial_number=whole(table.get("serial_number", 1), ("serial_number",), 1, (1 << 48) - 1),
        motor=motor_in(table, context.stream()),
        boot_up_ns=duration_ns(timing, "boot_up_s", 0.5, ("timing",)),
        heartbeat_ns=duration_ns(timing, "heartbeat_s", 0.1, ("timing",)),
        encoder_ns=duration_ns(timing, "encoder_s", 0.01, ("timing",)),
        calibration_ns=duration_ns(timing, "calibration_s", 2.0, ("timing",)),
        watchdog_ns=round(config["watchdog_s"] * 1e9),
        velocity_ramp_rev_s2=config["velocity_ramp_rev_s2"],
        torque_ramp_n_m_s=config["torque_ramp_n_m_s"],
        homing_speed_rev_s=config["homing_speed_rev_s"],
        min_endstop_rad=None
        if endstop is None
        else number(endstop, ("min_endstop_rad",), -1e9, 1e9),
    )
