"""Settings of an emulated ODrive: its table `[controller.NAME]` in a rig."""

from dataclasses import dataclass
from typing import Final, final

from motorhil.emulators.api import REQUIRED, MotorTable, number, table, whole

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
