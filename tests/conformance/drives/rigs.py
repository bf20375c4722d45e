"""Rigs of one drive each: correct ones that no clause may accuse, and drives with known findings.

`DRIVES` has the keys of their controllers. On a drive of `DEVIATIONS`, the clause named there must
fail. Drives of `CLAUSES` are judged by these clauses alone, since all others say nothing new.
"""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from motorhil.emulators.cia402.settings import OWN_EDS
from motorhil.harness.conformance.drives.target import DriveTarget
from motorhil.harness.conformance.target import Job

_RIG: Final = """\
[rig]
name = "a drive"
seed = 1
[bus.can0]
bitrate_bit_s = 1_000_000
[controller.drive]
kind = "cia402"
bus = "can0"
node_id = 5
{keys}
"""
_PLANT: Final = 'plant = { preset = "wheel_60w" }'
_FILES: Final = TemporaryDirectory()

DEVIATIONS: Final = {
    "inverted_set_point_acknowledge": "PP-02",
    "single_set_point_only": "PP-01",
    "edge_only_bits": "PP-04",
    "stale_target_reached": "PP-05",
    "halt_holds_mode": "OD-07",
    "stray_emcy": "ERR-01",
    "misplaced_error_register": "ERR-01",
}
"""Quirks that break a promise of the standards; all others are legal behaviour."""
LEGAL: Final = [
    *("slow_sdo", "deaf_after_boot_up", "late_boot_up", "heartbeat_jitter", "size_not_indicated"),
    *("stale_sdo_bytes", "statusword_bits", "target_reached_in_fault", "emcy_vendor_bytes"),
    *("emcy_after_boot_up", "emcy_on_overrun"),
]


def _variable(index: str, name: str, data_type: int, default: int) -> str:
    kind = f"ObjectType=0x7\nDataType=0x{data_type:04X}\nAccessType=ro\nPDOMapping=1"
    return f"\n[{index}]\nParameterName={name}\n{kind}\nDefaultValue={default}\n"


@cache
def _eds(
    name: str,
    *,
    without: tuple[str, ...] = (),
    added: str = "",
    changed: tuple[tuple[str, str], ...] = (),
) -> Path:
    """Write our own EDS without some objects, with others, or changed; return its path."""
    text = OWN_EDS.read_text()
    for old, new in changed:
        assert old in text
        text = text.replace(old, new)
    for index in without:
        text = re.sub(rf"\n\[{index}(sub\w+)?\]\n.*?(?=\n\[)", "", text, flags=re.DOTALL)
        text = re.sub(rf"^\d+=0x{index}\n", "", text, flags=re.MULTILINE)
    path = Path(_FILES.name, f"{name}.eds")
    path.write_text(text + added)
    return path


_MORE: Final = (
    _variable("6069", "Velocity sensor actual value", 4, 0),
    _variable("6079", "DC link circuit voltage", 7, 0),
    _variable("60FC", "Position demand internal value", 4, 0),
)
_UNUSUAL: Final = """
[606D]
ParameterName=Velocity window, in a byte and without a default
ObjectType=0x7
DataType=0x0005
AccessType=rw
PDOMapping=0

[2000]
ParameterName=Name of the axis
ObjectType=0x7
DataType=0x0009
AccessType=rw
DefaultValue=left
PDOMapping=0

[2001]
ParameterName=Axis has a brake
ObjectType=0x7
DataType=0x0001
AccessType=ro
DefaultValue=1
PDOMapping=1

[2002]
ParameterName=Ratio of the gear
ObjectType=0x7
DataType=0x0008
AccessType=ro
DefaultValue=1.5
PDOMapping=1

[2003]
ParameterName=Serial number of the gear
ObjectType=0x7
DataType=0x0016
AccessType=ro
DefaultValue=0x123456
PDOMapping=1
"""
_ODD: Final = (
    ("DefaultValue=motorhil CiA 402 drive", "DefaultValue=motorhil CiA 402 axis"),  # 3 segments
    ("Dummy0001=0", "Dummy0001=1"),
    ("Granularity=8", "Granularity=1"),
    ("DefaultValue=0x60610008", "DefaultValue=0x60610010"),  # 6061h in two bytes of TPDO 2
)
_RPM: Final = _variable("608C", "Velocity dimension index", 5, 0xA4)
_DEGREES: Final = (
    _variable("60A8", "SI unit position", 7, 0xFF41_0000),  # 0.1 degree
    _variable("60A9", "SI unit velocity", 7, 0xFFB4_4700),  # 0.1 revolution per minute
)
_RADIANS: Final = (
    _variable("60A8", "SI unit position", 7, 0xFD10_0000),  # 1 mrad
    _variable("60A9", "SI unit velocity", 7, 0xFD10_0300),  # 1 mrad/s
)
_ELASTIC: Final = (
    "backlash_rad = 0.0003, coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0"
)
_SUB_MODE: Final = "AccessType=rww\n{}PDOMapping=1\n\n[60C1]"
_SAYS_LESS: Final = ((_SUB_MODE.format("DefaultValue=0\n"), _SUB_MODE.format("")),)
_LEAN: Final = (
    "6084",
    "6085",
    "6082",
    "60C5",
    "60C6",
    "60F2",
    "60F8",
    "605B",
    "605D",
    "1006",
)

DRIVES: dict[str, str] = {
    "own": "",
    "switches": (
        "switches = { negative_limit_rad = -1.0, positive_limit_rad = 6.0,"
        " home_from_rad = 0.5, home_to_rad = 0.7, touch_probe_1_from_rad = 0.2,"
        " touch_probe_1_to_rad = 0.3, touch_probe_2_from_rad = -0.5,"
        " touch_probe_2_to_rad = 900.0, index_rad = 0.7 }"
    ),
    "own clock": "oscillator = { ppm = -8000.0 }",
    "units": (
        'objects = { "6081h" = 2000, "6083h" = 2000 }\n'
        "units = { position_unit_inc = 4.0, velocity_unit_inc_s = 10.0,"
        " acceleration_unit_inc_s2 = 100.0 }"
    ),
    "sync supervision": (
        "cyclic = { sync_lost_periods = 3, sync_lost_code = 0xFF02 }\n"
        'protection = { sto = "fault", sto_error_code = 0xFF01,'
        " device_temperature_warning_c = 70.0, device_temperature_max_c = 90.0 }\n"
        "servo = { tick_s = 0.001, current_steps = 20 }"
    ),
    "backlash": (
        'plant = { preset = "wheel_60w", backlash_rad = 0.0003,'
        " coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0 }\n"
        "switches = { touch_probe_1_from_rad = 0.2, touch_probe_1_to_rad = 0.3 }"
    ),
    "much backlash": (
        'plant = { preset = "wheel_60w", backlash_rad = 0.005,'
        " coupling_stiffness_n_m_rad = 2000.0, coupling_damping_n_m_s_rad = 5.0 }\n"
        "switches = { home_from_rad = 0.2, home_to_rad = 0.3 }"
    ),
    "play": 'plant = { preset = "wheel_60w", backlash_rad = 0.0003 }',
    "warm": (
        'plant = { preset = "wheel_60w", ambient_c = 30.0, copper_coefficient_1_k = 0.0039,'
        " thermal_resistance_winding_housing_k_w = 2.0, thermal_time_constant_winding_s = 0.6,"
        " thermal_resistance_housing_ambient_k_w = 5.0, thermal_time_constant_motor_s = 6.0 }\n"
        "protection = { winding_temperature_warning_c = 50.0, winding_temperature_max_c = 75.0 }"
    ),
    "i2t": (
        'plant = { preset = "wheel_60w", i2t_continuous_a = 2.0, i2t_peak_a = 6.0, i2t_peak_s = 1.0'
        " }\nprotection = { i2t_warning = 0.5 }"
    ),
    "chopper": (
        'plant = { preset = "wheel_60w", source_resistance_ohm = 0.5, dc_link_bleed_ohm = 500.0,'
        " dc_link_capacitance_f = 0.0005, chopper_threshold_v = 27.0, chopper_resistance_ohm = 5.0"
        f' }}\neds = "{_eds("more", added="".join(_MORE))}"'
    ),
    "weak supply": (
        'plant = { preset = "wheel_60w", source_resistance_ohm = 0.5,'
        " dc_link_capacitance_f = 0.0005, dc_link_bleed_ohm = 300.0 }\n"
        "protection = { over_voltage_v = 32.0, under_voltage_v = 15.0 }"
    ),
    "end stops": (
        'plant = { preset = "wheel_60w", stop_low_rad = -0.3, stop_high_rad = 0.4,'
        " stop_restitution = 0.5 }"
    ),
    "elastic with end stops": (
        f'plant = {{ preset = "wheel_60w", stop_low_rad = -0.3, stop_high_rad = 0.4, {_ELASTIC} }}'
    ),
    "pendulum": (
        'plant = { preset = "wheel_60w", gravity_torque_n_m = 2.0, gravity_zero_rad = 0.5 }'
    ),
    "elastic pendulum": (
        'plant = { preset = "wheel_60w", gravity_torque_n_m = 2.0, gravity_zero_rad = 0.5,'
        f" {_ELASTIC} }}"
    ),
    "sticky": (
        'plant = { preset = "wheel_60w", static_friction_n_m = 0.012, stribeck_speed_rad_s = 5.0 }'
    ),
    "cogging": (
        'plant = { preset = "wheel_60w", cogging_torque_n_m = 0.004, cogging_periods_rev = 12,'
        " load_torque_n_m = 0.1 }\noscillator = { ppm_max = 50.0, phase_max_s = 0.001 }"
    ),
    "friction at the output": (
        'plant = { preset = "wheel_60w", output_viscous_friction_n_m_s_rad = 1.0,'
        " output_coulomb_friction_n_m = 0.3 }"
    ),
    "elastic with friction": (
        'plant = { preset = "wheel_60w", output_viscous_friction_n_m_s_rad = 1.0,'
        f" output_coulomb_friction_n_m = 0.3, {_ELASTIC} }}"
    ),
    "late wakes": "oscillator = { jitter_s = 0.002, phase_s = 0.0004 }",
    "position and homing only": 'supported_modes = ["pp", "hm"]',
    "more objects": f'eds = "{_eds("more", added="".join(_MORE))}"',
    "rpm": (f'eds = "{_eds("rpm", added=_RPM)}"\nobjects = {{ "6081h" = 2000, "6083h" = 20000 }}'),
    "degrees": (
        f'eds = "{_eds("degrees", added="".join(_DEGREES))}"\n'
        'objects = { "6081h" = 333, "6083h" = 667 }'
    ),
    "radians": (
        f'eds = "{_eds("radians", added="".join(_RADIANS))}"\n'
        'objects = { "6081h" = 2000, "6083h" = 4000, "6084h" = 4000, "6085h" = 8000 }'
    ),
    "lean": (
        f'eds = "{_eds("lean", without=_LEAN, changed=_SAYS_LESS)}"\n'
        'objects = { "6085h" = 400000, "1029h:1" = 1, "60C5h" = 300000 }\n'
        "switches = { index_pulse = false }"
    ),
    "commanded at power-on": 'objects = { "6040h" = 6 }',
    "modes untold": f'eds = "{_eds("modes untold", without=("6071", "6502"))}"',
    "unusual file": f'eds = "{_eds("unusual", without=("606D",), added=_UNUSUAL, changed=_ODD)}"',
    "no error behaviour": f'eds = "{_eds("no error behaviour", without=("1029",))}"',
    "legal quirks": f"quirks = {LEGAL}\n[conformance]\nfault_code = 0x4310",
    **{f"quirk {name}": f'quirks = ["{name}"]' for name in DEVIATIONS},
}

_OF_QUIRKS: Final = ("NMT-01", "NMT-03", "PDS-01", "PDS-03", "PP-01", "ERR-01", "PDO-07", "CSP-01")
_QUEUED: Final = ("PP-03", "PP-06")  # the next set-point, and the rest of a move after halt
_OF_UNITS: Final = ("VAL-01", "PV-02", "PV-03", "PP-01", "OD-01", "FAC-01", "HOME-01", "TQ-05")
_OF_SWITCHES: Final = tuple(f"HOME-{number:02}" for number in range(1, 10))
CLAUSES: dict[str, tuple[str, ...]] = {
    "switches": (
        *(*_OF_SWITCHES, "TP-01", "TP-02", "TP-04"),
        *("DIN-01", "DIN-02", "LSW-01", "LSW-02", "LIM-01"),
    ),
    "units": (
        *_OF_UNITS,
        "PV-05",
        "LIM-01",
        "RNG-01",
        "CSV-02",
        "PP-09",
        "HOME-07",
        "PV-08",
        "OD-10",
    ),
    "backlash": (
        *("PLANT-11", "TP-04", "HOME-06"),
        *("PP-01", "TQ-01", "CST-01", "STOP-05", "CSP-01"),
    ),
    "much backlash": ("DIN-02",),
    "play": ("PP-01", "HOME-06"),
    "own clock": ("NMT-03", "PP-01", "PDO-07", "PV-02", "CSP-01", "LSW-01", "ERR-03", "NMT-01"),
    "position and homing only": ("OD-05", "PP-01", "HOME-01", "HOME-02", "STOP-01", "LIM-01"),
    "sync supervision": ("CYC-01", "ERR-07", "CSP-01", "CSP-06", "IP-01", "IP-02", "CSV-01"),
    "warm": ("PLANT-01", "PP-01"),
    "i2t": ("PLANT-02", "PP-01"),
    "chopper": ("PLANT-03", "VAL-02", "PV-01"),
    "weak supply": ("PLANT-03", "PP-01"),
    "end stops": ("PLANT-04", "TQ-01"),
    "elastic with end stops": ("PLANT-04",),
    "pendulum": ("PLANT-05", "IP-01", "GAIN-01"),
    "elastic pendulum": ("PLANT-05",),
    "sticky": ("PLANT-06", "PP-01", "PV-01"),
    "cogging": ("PLANT-07", "PP-01"),
    "friction at the output": ("PLANT-08", "PP-01"),
    "elastic with friction": ("PLANT-08", "PP-01"),
    "late wakes": ("PLANT-09", "NMT-01", "PP-01", "PDO-07", "ERR-03", "SDO-01", "PDO-04"),
    "more objects": ("VAL-02", "VAL-03", "VAL-04", "ERR-05", "ERR-06"),
    "rpm": _OF_UNITS,
    "degrees": _OF_UNITS,
    "radians": _OF_UNITS,
    "lean": (
        *("OD-01", "OD-08", "OD-10", "PP-01", "PP-05", "PP-06", "PV-01", "PV-07", "TQ-03"),
        *("STOP-04", "STOP-05", "STOP-12", "ERR-01", "NMT-05", "SYN-01", "IP-05"),
    ),
    "commanded at power-on": ("OD-10",),
    "modes untold": ("OD-05",),
    "unusual file": ("PDO-10", "PDO-09", "PDO-12", "OD-09", "SDO-01"),
    "no error behaviour": ("NMT-04", "PP-01"),
    "legal quirks": (*_OF_QUIRKS, *_QUEUED),
    **{
        f"quirk {name}": (killer, *_OF_QUIRKS[:2], "CSP-01", "LSW-01")
        for name, killer in DEVIATIONS.items()
    },
    "quirk edge_only_bits": ("PP-04", *_OF_QUIRKS[:2], "CSP-01", "LSW-01", *_QUEUED),
    "quirk stale_target_reached": ("PP-05", *_OF_QUIRKS[:2], "CSP-01", "LSW-01", *_QUEUED),
}
"""The clauses for drives that differ in few points; all others have all clauses."""
TRULY_ACCUSED: Final = ("play", "unusual file")
"""Drives of which other clauses tell the truth: an undamped load never rests; 606Dh has a byte."""


def text_of(keys: str = "") -> str:
    """Return the rig of a drive with these keys of its controller."""
    return _RIG.format(keys=keys if "plant = " in keys else f"{_PLANT}\n{keys}")


def target(keys: str = "") -> DriveTarget:
    """Return a drive as target of the kit, with these keys of its controller."""
    with TemporaryDirectory() as folder:
        rig = Path(folder, "rig.toml")
        rig.write_text(text_of(keys))
        return DriveTarget(Job(rig=str(rig), controller="drive"))


def opener(name: str) -> Callable[[], Any]:
    """Return an opener of benches with the drive of this name."""
    return target(DRIVES[name]).opener()


def known_finding(name: str) -> str:
    """Return the clause that must fail on the drive of this name; "" if none may."""
    return DEVIATIONS.get(name.removeprefix("quirk "), "")
