"""Settings of an emulated ODrive: its table `[controller.NAME]` in a rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.api import (
    REQUIRED,
    ControllerContext,
    MotorSettings,
    MotorTable,
    ns,
    number,
    read,
    table,
    whole,
)

NODE_ID_MAX: Final = 0x3E


@final
@dataclass(frozen=True, kw_only=True)
class TimingTable:
    """Times of the drive."""

    boot_up_s: float = number(0.5, 0, 3600, "s", "From power-on to the first heartbeat.")
    heartbeat_s: float = number(0.1, 0, 3600, "s", "Period of 01h; 0: only on request.")
    encoder_s: float = number(0.01, 0, 3600, "s", "Period of 09h; 0: only on request.")
    calibration_s: float = number(2.0, 0, 3600, "s", "Duration of every calibration.")


@final
@dataclass(frozen=True, kw_only=True)
class OdriveTable(MotorTable):
    """An ODrive."""

    node_id: int = whole(REQUIRED, 0, NODE_ID_MAX, "", "Its node-ID.", example="1")
    serial_number: int = whole(1, 1, (1 << 48) - 1, "", "Its serial number.")
    timing: TimingTable = table(TimingTable, "Times of the drive.")
    watchdog_s: float = number(
        0.0, 0, 3600, "s", "It disarms after this time without a message; 0: never."
    )
    velocity_ramp_rev_s2: float = number(1.0, 1e-6, 1e9, "rev/s²", "Ramp of VEL_RAMP.")
    torque_ramp_n_m_s: float = number(0.01, 1e-9, 1e9, "N·m/s", "Ramp of TORQUE_RAMP.")
    homing_speed_rev_s: float = number(0.25, 1e-6, 1e4, "rev/s", "Speed towards the end stop.")
    min_endstop_rad: float | None = number(
        None, -1e9, 1e9, "rad", "Output position of its end stop switch; absent: no switch."
    )


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
    own = read(OdriveTable, table)
    return OdriveSettings(
        node_id=own.node_id,
        serial_number=own.serial_number,
        motor=own.motor(context.stream()),
        boot_up_ns=ns(own.timing.boot_up_s),
        heartbeat_ns=ns(own.timing.heartbeat_s),
        encoder_ns=ns(own.timing.encoder_s),
        calibration_ns=ns(own.timing.calibration_s),
        watchdog_ns=ns(own.watchdog_s),
        velocity_ramp_rev_s2=own.velocity_ramp_rev_s2,
        torque_ramp_n_m_s=own.torque_ramp_n_m_s,
        homing_speed_rev_s=own.homing_speed_rev_s,
        min_endstop_rad=own.min_endstop_rad,
    )
