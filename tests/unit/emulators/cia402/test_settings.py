"""A rig's table: every mistake is reported with the path of its key and a remedy."""

from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.emulators.cia402.settings import OWN_EDS, read_settings, shown_parameters
from motorhil.emulators.controller import SettingError
from motorhil.emulators.plant.presets import PRESETS
from tests.support.cia402.bench import Bench, new_drive

HERE = Path(__file__).parent


def refused(**table: object) -> str:
    with pytest.raises(SettingError) as caught:
        new_drive(**table)
    return str(caught.value)


def test_node_id_alone_is_sufficient():
    settings = read_settings({"node_id": 7}, HERE)
    assert settings.node_id == 7
    assert settings.eds == OWN_EDS
    assert OWN_EDS.is_file()
    assert settings.plant == PRESETS["wheel_60w"]
    assert (settings.boot_up_ns, settings.sdo_reply_ns, settings.enable_ns) == (
        300_000_000,
        1_000_000,
        20_000_000,
    )


def test_numbers_reach_the_settings():
    settings = read_settings(
        {
            "node_id": 1,
            "plant": {"preset": "mast_20w", "gear_ratio": 50, "load_torque_n_m": -0.5},
            "servo": {"tick_s": 0.0005, "current_steps": 4, "position_kp_1_s": 12.5},
            "timing": {"boot_up_s": 0, "sdo_reply_s": 0.0025, "enable_s": 0.1},
            "units": {"velocity_unit_inc_s": 33.3, "acceleration_unit_inc_s2": 10},
            "objects": {"6065h": 2000, "1A00h:1": 0x60640020, "1018h:0Ah": 1, "1008h": "mine"},
            "supported_modes": ["pp", "csp"],
            "initial_position_rad": 0.25,
        },
        HERE,
    )
    assert settings.plant == replace(PRESETS["mast_20w"], gear_ratio=50.0, load_torque_n_m=-0.5)
    assert (settings.tick_ns, settings.current_steps) == (500_000, 4)
    assert settings.gains.position_kp_1_s == 12.5
    assert (settings.boot_up_ns, settings.sdo_reply_ns, settings.enable_ns) == (
        0,
        2_500_000,
        100_000_000,
    )
    assert settings.velocity_unit_inc_s == 33.3
    assert [(o.index, o.subindex, o.value) for o in settings.objects] == [
        (0x6065, 0, 2000),
        (0x1A00, 1, 0x60640020),
        (0x1018, 10, 1),
        (0x1008, 0, "mine"),
    ]
    assert settings.supported_modes == ("pp", "csp")
    assert settings.initial_position_rad == 0.25


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"node_id": 0}, "node_id: 0 is out of range; allowed: 1 to 127"),
        ({"node_id": 128}, "node_id: 128 is out of range; allowed: 1 to 127"),
        ({"node_id": "5"}, 'node_id: must be an integer, but is a string ("5"); write node_id = 1'),
        (
            {"node_id": True},
            "node_id: must be an integer, but is a boolean (true); write node_id = 1",
        ),
        ({"edz": "x"}, "edz: unknown key"),
        ({"eds": "none.eds"}, "eds: file "),
        ({"eds": 3}, 'eds: must be a string, but is an integer (3); write eds = "drive.eds"'),
        (
            {"plant": {"preset": "tank"}},
            'plant.preset: unknown preset "tank"',
        ),
        ({"plant": {"gear": 3}}, "plant.gear: unknown key"),
        ({"plant": {"gear_ratio": 3}}, "plant: resistance_ohm, inductance_h"),
        (
            {"plant": {"preset": "mast_20w", "gear_ratio": 0}},
            "plant.gear_ratio: 0 is out of range; allowed: 0.0001 to 1e+06",
        ),
        (
            {"plant": {"preset": "mast_20w", "load_torque_n_m": float("inf")}},
            "plant.load_torque_n_m: must be finite (inf); allowed: -1e+09 to 1e+09 N·m",
        ),
        (
            {"plant": {"preset": "mast_20w", "resistance_ohm": 1e300}},
            "plant.resistance_ohm: 1e+300 ohm is out of range; allowed: 0.0001 to 1e+06 ohm",
        ),
        (
            {"plant": {"preset": "mast_20w", "encoder_increments_rev": 2.5}},
            "plant.encoder_increments_rev: must be an integer, but is a float (2.5); allowed: 1",
        ),
        ({"plant": 3}, "plant: must be a table, but is an integer (3); write [plant]"),
        ({"servo": {"kp": 3}}, "servo.kp: unknown key"),
        (
            {"servo": {"position_kp_1_s": -1}},
            "servo.position_kp_1_s: -1 1/s is out of range; allowed: 0 to 1e+12 1/s",
        ),
        (
            {"servo": {"tick_s": 1e-9}},
            "servo.tick_s: 1e-09 s is out of range; allowed: 1e-06 to 1 s",
        ),
        (
            {"servo": {"tick_s": 1e9}},
            "servo.tick_s: 1000000000.0 s is out of range; allowed: 1e-06 to 1 s",
        ),
        (
            {"servo": {"tick_s": 5e-6}},
            "servo.current_steps: 10 steps in a servo period of 5000 ns are shorter than a "
            "microsecond each; a longer tick_s, or fewer steps",
        ),
        ({"timing": {"boot_s": 3}}, "timing.boot_s: unknown key"),
        (
            {"timing": {"enable_s": -1}},
            "timing.enable_s: -1 s is out of range; allowed: 0 to 3600 s",
        ),
        (
            {"timing": {"boot_up_s": 1e25}},
            "timing.boot_up_s: 1e+25 s is out of range; allowed: 0 to 3600 s",
        ),
        (
            {"timing": {"enable_s": "soon"}},
            'timing.enable_s: must be a number [s], but is a string ("soon"); allowed: 0 to 3600 s',
        ),
        (
            {"timing": {"enable_s": float("nan")}},
            "timing.enable_s: must be finite (nan); allowed: 0 to 3600 s",
        ),
        (
            {"units": {"velocity_unit_inc_s": 0}},
            "units.velocity_unit_inc_s: 0 is out of range; allowed: 1e-12 to 1e+12",
        ),
        ({"units": {"velocity": 1}}, "units.velocity: unknown key"),
        ({"objects": {"xyz": 1}}, 'objects.xyz: is not an object; like "6065h" or "1A00h:1"'),
        ({"objects": {"60650h": 1}}, 'objects.60650h: is not an object; like "6065h"'),
        ({"objects": {"0FFFh": 1}}, "objects.0FFFh: is not an object; 1000h..FFFFh"),
        ({"objects": {"60_5h": 1}}, 'objects.60_5h: is not an object; like "6065h"'),
        (
            {"objects": {"6065h:": 1}},
            'objects.\'6065h:\': is not an object; like "6065h" or "1A00h:1"',
        ),
        ({"objects": {"\uff16065h": 1}}, "is not an object; like"),
        ({"objects": {"6065h": 1, "6065H:0": 2}}, "objects.'6065H:0': is given twice; remove one"),
        (
            {"objects": {"6065h": [1]}},
            "objects.6065h: must be a number or a string, but is an array; a number, or a text",
        ),
        ({"objects": {"6065h": 1.5}}, "objects.6065h: 1.5 is not a whole number"),
        ({"objects": {"6065h": -1}}, "objects.6065h: -1 does not fit data type 07h"),
        ({"objects": {"60C2h:2": 3}}, "objects.'60C2h:2': 3 is outside -6..0"),
        ({"objects": {"6065h": "a"}}, "objects.6065h: 'a' is not a number"),
        ({"objects": {"2000h": 1}}, "objects.2000h: motorhil_cia402.eds has no such object"),
        (
            {"objects": {"60c2h:3": 1}},
            "objects.'60c2h:3': motorhil_cia402.eds has no such object, and the drive does not",
        ),
        (
            {"supported_modes": "pp"},
            'supported_modes: must be a list, but is a string ("pp"); write supported_modes =',
        ),
        (
            {"supported_modes": []},
            'supported_modes: is empty; write supported_modes = ["pp", "pv"]',
        ),
        ({"supported_modes": ["vl"]}, 'supported_modes[0]: unknown mode "vl"'),
        ({"supported_modes": ["p"]}, 'supported_modes[0]: unknown mode "p"'),
        ({"protection": {"stop": 1}}, "protection.stop: unknown key"),
        (
            {"protection": {"sto": 1}},
            "protection.sto: must be a string, but is an integer (1)",
        ),
        (
            {"protection": {"sto_error_code": 0x5441}},
            "protection.sto_error_code: has no effect, because sto is not a fault; write sto",
        ),
        (
            {"protection": {"sto": "fault", "sto_error_code": 0}},
            "protection.sto_error_code: 0 is out of range; allowed: 4096 to 65535",
        ),
        (
            {"protection": {"device_temperature_max_c": 60.0}},
            "protection.device_temperature_warning_c: 75 C is above the maximum, 60 C;"
            " device_temperature_warning_c = 60 at most",
        ),
        (
            {"protection": {"winding_temperature_max_c": 100}},
            "protection.winding_temperature_max_c: the plant does not model this quantity; give ",
        ),
        (
            {"protection": {"i2t_warning": 0.5}},
            "give the plant i2t_continuous_a, i2t_peak_a and i2t_peak_s",
        ),
        (
            {"protection": {"over_voltage_v": 30.0}},
            "protection.over_voltage_v: the plant does not model this quantity; give the",
        ),
        (
            {
                "plant": {"preset": "wheel_60w", "source_resistance_ohm": 1.0},
                "protection": {"under_voltage_v": 40.0},
            },
            "protection.under_voltage_v: under-voltage at 40 V is not below over-voltage at 30 V; "
            "the supply's own is 24 V",
        ),
        (
            {"quirks": "slow_sdo"},
            'quirks: must be a list, but is a string ("slow_sdo"); write quirks =',
        ),
        (
            {"quirks": ["slow"]},
            'quirks[0]: unknown quirk "slow"',
        ),
        ({"quirks": [["a"]]}, "quirks[0]: must be a string, but is an array (1 entry); write"),
        (
            {"quirks": {"slow_sdo": 3}},
            "quirks.slow_sdo: must be true, false or a table, but is an integer (3); true, or a",
        ),
        (
            {"quirks": {"slow_sdo": {"mean": 1}}},
            "quirks.slow_sdo.mean: unknown key",
        ),
        (
            {"quirks": {"slow_sdo": {"mean_s": -1}}},
            "quirks.slow_sdo.mean_s: -1 s is out of range; allowed: 0 to 3600 s",
        ),
        (
            {"quirks": {"stray_emcy": {"for_s": 1}}},
            "quirks.stray_emcy.for_s: unknown key",
        ),
        (
            {"quirks": "stray_emcy"},
            'quirks: must be a list, but is a string ("stray_emcy"); write quirks =',
        ),
        ({"quirks": ["stray_emcy"] * 2}, 'quirks[1]: "stray_emcy" is there twice; take one out'),
        (
            {"supported_modes": ["pp", "pp"]},
            'supported_modes[1]: "pp" is there twice; take one out',
        ),
        (
            {"cyclic": {"sync_lost_code": 0x8700}},
            "cyclic.sync_lost_code: has no effect without sync_lost_periods; "
            "add sync_lost_periods = 5",
        ),
        (
            {"plant": {"preset": "wheel_6w"}},
            'plant.preset: unknown preset "wheel_6w"',
        ),
        (
            {"plant": {"chopper_resistance_ohm": 5.0, "chopper_threshold_v": 28.0}},
            "plant.chopper_resistance_ohm: 5 does nothing without source_resistance_ohm; add",
        ),
        (
            {"plant": {"coupling_damping_n_m_s_rad": 3.0}},
            "plant.coupling_damping_n_m_s_rad: 3 does nothing without coupling_stiffness_n_m_rad or"
            " backlash_rad; add it to the plant",
        ),
        ({"switches": {"home": 1}}, "switches.home: unknown key"),
        (
            {"switches": {"home_to_rad": "x"}},
            'switches.home_to_rad: must be a number [rad], but is a string ("x"); allowed:',
        ),
        (
            {"switches": {"negative_limit_rad": 1.0, "positive_limit_rad": 1.0}},
            "switches.positive_limit_rad: 1.0 rad is not above the negative limit switch; ",
        ),
        (
            {"switches": {"home_from_rad": 1.0, "home_to_rad": 1.000001}},
            "switches.home_to_rad: 1.000001 rad is not above home_from_rad; at least an increment "
            "of 4.76e-05 rad",
        ),
        (
            {"switches": {"positive_limit_rad": 1e8}},
            "increments do not fit 32 bits; at most 102220 rad either way",
        ),
        (
            {"switches": {"index_rad": 7}},
            "switches.index_rad: 7 rad is out of range; allowed: -6.283185307179586 to",
        ),
        (
            {"switches": {"index_pulse": 1}},
            "switches.index_pulse: must be true or false, but is an integer (1); write",
        ),
        (
            {"switches": {"index_pulse": False, "index_rad": 1}},
            "switches.index_rad: the encoder has no index pulse; take one of them out",
        ),
        (
            {"initial_position_rad": "x"},
            'initial_position_rad: must be a number [rad], but is a string ("x"); allowed:',
        ),
        (
            {"initial_position_rad": float("nan")},
            "initial_position_rad: must be finite (nan); allowed: -1e+09 to 1e+09 rad",
        ),
        (
            {"initial_position_rad": -1e6},
            "initial_position_rad: -21008452488 increments do not fit 32 bits; "
            "at most 102220 rad in either direction",
        ),
    ],
)
def test_mistake_is_reported_with_key_and_remedy(table, text):
    assert text in refused(**table)


def test_explicit_default_values_change_nothing():
    told = {"coupling_damping_n_m_s_rad": 0.0, "ambient_c": 25.0}
    assert read_settings({"node_id": 3, "plant": told}, HERE).plant == PRESETS["wheel_60w"]


def test_switch_beyond_the_end_of_travel_is_reported():
    plant = {"preset": "wheel_60w", "stop_low_rad": -1.0, "stop_high_rad": 1.0}
    there = {"negative_limit_rad": -0.9, "positive_limit_rad": 1.1, "home_from_rad": -3.0}
    drive = new_drive(plant=plant, switches={**there, "home_to_rad": -2.0})
    wanted = [
        f"switch {name} is beyond the ends of the way, -1..1 rad:"
        " it stays off unless a stimulus says otherwise"
        for name in ("positive_limit", "home")
    ]
    assert drive.take_events() == [("warning", text) for text in wanted]
    assert not new_drive(switches=there).take_events()
    within = {"negative_limit_rad": -0.9, "positive_limit_rad": 0.9}
    assert not new_drive(plant=plant, switches=within).take_events()


def test_missing_node_id_is_reported():
    with pytest.raises(SettingError, match="node_id: is missing"):
        read_settings({}, HERE)


def test_file_not_of_a_cia402_drive_is_rejected(tmp_path):
    text = OWN_EDS.read_text()
    (tmp_path / "other.eds").write_text(text.replace("6041", "6042"))
    assert "not the EDS of a CiA 402 drive" in refused(folder=tmp_path, eds="other.eds")


def test_broken_file_is_rejected_with_its_line(tmp_path):
    (tmp_path / "broken.eds").write_text("[1000]\nParameterName=x\nthis is no eds\n")
    message = refused(folder=tmp_path, eds="broken.eds")
    assert message.startswith("eds: ")
    assert "broken.eds" in message


def test_initial_position_is_that_of_the_output():
    bench = Bench(initial_position_rad=0.25)
    bench.boot()
    assert bench.truth("position_rad") == pytest.approx(0.25, abs=1e-4)
    assert bench.read(0x6064) == 0.25 / 6.283185307179586 * 132_000 // 1


def test_object_missing_in_the_file_may_have_a_hidden_value(tmp_path):
    eds = tmp_path / "without.eds"
    eds.write_text(OWN_EDS.read_text().replace("60F2", "60EF").replace("60C5", "60EE"))
    bench = Bench(eds=str(eds), objects={"60F2h": 1})  # relative moves count from the demand
    bench.boot()
    assert bench.write(0x60F2, 0, 0, 2) == 0x0602_0000
    assert new_drive(eds=str(eds), objects={"60C5h": 100}).od.integer(0x60C5, 0, 0) == 100


def test_device_type_without_a_value_in_the_file_is_402(tmp_path):
    text = OWN_EDS.read_text("utf-8").replace("DefaultValue=0x00020192\n", "", 1)
    (tmp_path / "own.eds").write_text(text, "utf-8")
    bench = Bench(folder=tmp_path, eds="own.eds")
    bench.boot()
    assert bench.read(0x1000, signed=False) == 0x0002_0192  # CiA 402-1, device type: servo drive


def test_bits_of_a_quirk_are_shown_in_hexadecimal():
    assert shown_parameters({"bits": 64, "by_s": 0.5}) == "bits = 0x40, by_s = 0.5"
