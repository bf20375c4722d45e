"""Variations of the kit's own benches that state the options of adaptations and drives.

An option that no bench states is code that no clause executes. Each kind has variations that state
its options, with other values than the defaults, and the facts that follow from them.
"""

from collections.abc import Mapping, Sequence
from typing import Final

Change = tuple[str, str]

_RANGES: Final = (
    "p_max_rad = 20.0\nv_max_rad_s = 40.0\nt_max_n_m = 12.0\nkp_max_n_m_rad = 600.0\n"
    "kd_max_n_m_s_rad = 6.0"
)


_ACCELERATION: Final = "acceleration_max_rad_s2 = 4.0\n"
_BORNE: Final = ("borne_s = 0.08", "borne_s = 0.06")
_JERK: Final = (_ACCELERATION, f"{_ACCELERATION}jerk_max_rad_s3 = 8.0\n")


def of_motor(kind: str, settings: str) -> list[Change]:
    """Return the change that gives both motors of an adaptation these settings."""
    return [(f'adaptation = "{kind}"\n', f'adaptation = "{kind}"\n{settings}\n')]


def of_controller(kind: str, settings: str) -> list[Change]:
    """Return the change that gives both controllers of a kind these settings."""
    return [(f'kind = "{kind}"\n', f'kind = "{kind}"\n{settings}\n')]


def _over_tcp(kind: str) -> list[Change]:
    """Return the changes that put two drives on Modbus TCP, each on a bus of its own."""
    line = '[bus.line]\nkind = "modbus_rtu"\nbaud_bit_s = 115_200\nparity = "N"\n'
    buses = '[bus.line]\nkind = "modbus_tcp"\n\n[bus.second]\nkind = "modbus_tcp"\n'
    unit = f'[controller.right]\nkind = "{kind}"\nbus = '
    return [(line, buses), (f'{unit}"line"', f'{unit}"second"')]


def _patient(kind: str) -> list[Change]:
    """Return the changes with which a gateway in front of a drive tells that it is silent."""
    return [*of_motor(kind, "timeout_s = 1.5"), ("lost_s = 1.0", "lost_s = 6.0")]


_CIA402: Final[Mapping[str, Sequence[Change]]] = {
    "motor options": [
        *of_motor(
            "cia402",
            "host_node_id = 100\nheartbeat_ms = 60\nheartbeat_timeout_ms = 250\n"
            "status_period_ms = 10\nstatus_inhibit_ms = 3.0\nvelocity_period_ms = 12\n"
            "set_point_period_ms = 4\nconnect_timeout_s = 2.0\nsdo_timeout_s = 0.2\n"
            "sdo_quarantine_s = 0.6\nsdo_reply_ms = 10.0\noscillator_ppm = 100.0",
        ),  # it is told to leave its third TPDO on, which the host must switch off
        *of_controller("cia402", 'objects = { "1802h:2" = 255, "1802h:5" = 5 }'),
    ],
    "lost host disables": of_motor("cia402", "connection_loss = 2"),
    "lost host is a fault": of_motor("cia402", "connection_loss = 1"),
    "status by SDO": [  # start() hears of it late; a wait lasts as long as its request
        *of_motor("cia402", "status_period_ms = 0\nsdo_timeout_s = 0.05"),
        ("latency_s = [0.0, 0.001]", "latency_s = [-0.003, 0.001]"),
    ],
    "limited jerk": [('kind = "cia402"\n', 'kind = "cia402"\n'), _JERK],
    "drive boots late": of_controller("cia402", "timing = { boot_up_s = 1.0, enable_s = 0.1 }"),
}
_OTHERS: Final[Mapping[str, Sequence[Change]]] = {
    "dryve drive options": of_controller(
        "dryve",
        "timing = { boot_up_s = 0.5, enable_s = 0.05, sdo_reply_s = 0.002 }\n"
        "switches = { negative_limit_rad = -500.0, positive_limit_rad = 500.0,"
        " home_from_rad = 300.0, home_to_rad = 301.0, index_rad = 0.3 }",
    ),
    "servo drive options": of_controller(
        "dynamixel",
        "boot_up_s = 0.3\nturn_round_s = 0.0001\nfirmware = 46\nmodel_information = 0x0102_0304",
    ),
    "Leadshine drive options": of_controller(
        "leadshine_pr",
        "timing = { boot_up_s = 0.5, reply_s = 0.003 }\n"
        "switches = { limit_backward_rad = -500.0, limit_forward_rad = 500.0, home_rad = 300.0 }",
    ),
    "AZ drive options": of_controller(
        "oriental_az",
        "timing = { boot_up_s = 0.5, reply_s = 0.003 }\nregisters = { gear_a = 3, gear_b = 2 }\n"
        "switches = { limit_backward_rad = -500.0, limit_forward_rad = 500.0, home_rad = 300.0 }",
    ),
    "AZ drive keeps its trigger": of_controller("oriental_az", "trigger_auto_clear = false"),
    "impedance drive options": of_controller("mit", "boot_up_s = 0.3\nanswer_bytes = 8"),
    "RobStride drive options": of_controller("robstride", "boot_up_s = 0.3"),
    "moteus drive options": of_controller(
        "moteus",
        "family = 1\nserial_number = 77\nabi_version = 0x010101\nregister_map_version = 5\n"
        "poles = 28\ndefault_timeout_s = 0.12\ntimeout_mode = 12\ntimeout_max_torque_n_m = 4.0\n"
        "max_velocity_rev_s = 400.0\nmax_current_a = 50.0\nmax_voltage_v = 50.0\n"
        "fault_velocity_error_rev_s = 50.0\ndefault_velocity_limit_rev_s = 30.0\n"
        "default_accel_limit_rev_s2 = 60.0",
    ),
    "RMD drive options": of_controller(
        "rmd",
        'acceleration_dps_s = 20_000\nanswer_s = 0.0003\nrestart_s = 0.5\nmodel = "X8"\n'
        "date = 20230101\nstall_deg = 20.0\nfault_s = 0.08",
    ),
    "VESC drive options": of_controller(
        "vesc",
        "status_2 = 32\nstatus_rate_2_hz = 20\ntimeout_s = 0.8\ntimeout_brake_a = 2.0\n"
        "fault_stop_s = 0.4\nerpm_max = 90_000.0\ncurrent_max_a = 40.0\n"
        "current_brake_max_a = 30.0\ncurrent_min_a = 0.04\nduty_min = 0.004\nduty_max = 0.97\n"
        'duty_ramp_s = 25.0\nhardware = "410"\nfirmware_major = 6\nfirmware_minor = 2',
    ),
    "amplifier options": [  # used up to its full scale, by a slow motor whose friction is not told
        *of_controller(
            "cia401",
            "timing = { boot_up_s = 0.5, sdo_reply_s = 0.002 }\namplifier = { enable_s = 0.01,"
            " tick_s = 0.0002, current_steps = 4, current_per_volt_a_v = 0.28 }",
        ),
        ("current_per_volt_a_v = 0.8", "current_per_volt_a_v = 0.28"),
        ("velocity_max_rad_s = 2.0", "velocity_max_rad_s = 1.0"),
        ("friction_feedforward_a = 0.154\n", ""),
        ("following_rad = 0.0002", "following_rad = 0.002"),
    ],
    "two amplifiers on two buses": [
        (
            '[motor.left]\nadaptation = "software"',
            '[bus.can1]\nbitrate_bit_s = 1_000_000\n\n[controller.second]\nkind = "cia401"\n'
            'bus = "can1"\nnode_id = 1\nchannels = 1\nplant = { preset = "wheel_60w" }\n\n'
            '[motor.left]\nadaptation = "software"',
        ),
        ('controller = "node"\nchannel = 2', 'controller = "second"\nchannel = 1'),
    ],
    "velocities in rpm": [
        ('adaptation = "dryve"\n', 'adaptation = "dryve"\nvelocity_unit = "rpm"\n'),
        ('kind = "dryve"\n', 'kind = "dryve"\nvelocity_unit = "rpm"\n'),
    ],
    "dryve options": of_motor("dryve", "timeout_s = 0.3"),
    "dryve awaited for longer": _patient("dryve"),
    "servo options": of_motor("dynamixel", "timeout_s = 0.08"),
    "servo in velocity mode": [  # without position control, it yields to a load
        *of_motor("dynamixel", 'mode = "velocity"'),
        ("window_rad = 0.004", "window_rad = 0.008"),
    ],
    "ideal motor begins at 0.3 rad": of_motor(
        "ideal", "position_rad = 0.3\ntorque_constant_n_m_a = 0.5"
    ),
    "ideal motor with limited jerk": [('adaptation = "ideal"\n', 'adaptation = "ideal"\n'), _JERK],
    "Leadshine over TCP": _over_tcp("leadshine_pr"),
    "Leadshine awaited for longer": [*_over_tcp("leadshine_pr"), *_patient("leadshine")],
    "Leadshine options": of_motor("leadshine", "timeout_s = 0.15"),
    "AZ over TCP": _over_tcp("oriental_az"),
    "AZ options": of_motor("oriental_az", "timeout_s = 0.15"),
    "other ranges": [*of_motor("mit", _RANGES), *of_controller("mit", _RANGES)],
    "impedance options": [
        *of_motor(
            "mit", "period_ms = 4.0\nquiet_ms = 16.0\ntimeout_ms = 80.0\nconnect_timeout_s = 1.5"
        ),
        _BORNE,
    ],
    "other ranges of a RobStride": [
        *of_motor("robstride", _RANGES),
        *of_controller("robstride", _RANGES),
    ],
    "RobStride options": of_motor(
        "robstride",
        "host_id = 170\nperiod_ms = 4.0\nquiet_ms = 16.0\ntimeout_ms = 80.0\n"
        "connect_timeout_s = 1.5",
    ),
    "moteus options": [
        *of_motor("moteus", "poll_ms = 8.0\nwatchdog_ms = 120.0\ntimeout_ms = 80.0"),
        _BORNE,
    ],
    "RMD options": [
        *of_motor(
            "rmd",
            "poll_period_ms = 4.0\ntimeout_ms = 150.0\nstream_period_ms = 4.0\nlead_ms = 17.0",
        ),
        ("borne_s = 0.18", "borne_s = 0.13"),
    ],
    "VESC options": [
        *of_motor(
            "vesc",
            "host_id = 77\nstream_period_ms = 4.0\nlead_ms = 16.0\nstatus_timeout_ms = 150.0\n"
            "brake_current_a = 6.0\npole_pairs = 10",
        ),
        *of_controller("vesc", "pole_pairs = 10"),
        ("borne_s = 0.18", "borne_s = 0.13"),
    ],
    "servo options of the host": [
        *of_motor(
            "software",
            "host_node_id = 100\nheartbeat_ms = 60\nheartbeat_timeout_ms = 250\n"
            "status_period_ms = 15\nconnect_timeout_s = 2.0\nsdo_timeout_s = 0.2\n"
            "sdo_quarantine_s = 0.6\ncycle_ms = 2.0\nmisses_max = 6\n"
            "position_window_rad = 0.0008\nsettle_s = 0.03\nfollowing_error_window_rad = 0.1\n"
            "following_error_s = 0.02\nquick_stop_deceleration_rad_s2 = 8.0",
        )
    ],
    "gains of the host's servo": [
        (
            "bandwidth_rad_s = 60.0\n",
            "kp_a_rad = 420.0\nki_a_rad_s = 8000.0\nkd_a_s_rad = 7.0\n"
            "derivative_filter_s = 0.001\nvelocity_feedforward_a_s_rad = 0.01\n",
        )
    ],
}
OPTIONS: Final[Mapping[str, Sequence[Change]]] = {**_CIA402, **_OTHERS}
"""All variations, by name; the text of a rig tells which one it can have."""
