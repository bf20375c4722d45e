"""An emulated dryve D1 by its telegrams.

Expected bytes: igus, Operating Manual dryve D1 V2.4, pages 104, 105 and 110, and igus's sample
program of 2020-12-04, whose arrays users' programs compare as a whole.
"""

from pathlib import Path

import pytest

from motorhil.emulators.controller import ControllerContext, SettingError
from motorhil.emulators.dryve.drive import build
from tests.support.dryve.bench import Bench


@pytest.fixture
def bench():
    return Bench()


# --- golden telegrams


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (  # statusword, at rest and enabled by DI7
            "0000 0000 000D 00 2B 0D 00 00 00 6041 00 0000 00 02",
            "0000 0000 000F 00 2B 0D 00 00 00 6041 00 0000 00 02 40 06",
        ),
        (  # transaction identifier of the manual's example
            "0F0F 0000 000D 00 2B 0D 00 00 00 6041 00 0000 00 02",
            "0F0F 0000 000F 00 2B 0D 00 00 00 6041 00 0000 00 02 40 06",
        ),
        *(
            (
                f"0000 0000 {13 + len(bytes.fromhex(data)):04X} 00 2B 0D 01 00 00 {place} 0000 00"
                f" {len(bytes.fromhex(data)):02X} {data}",
                f"0000 0000 000D 00 2B 0D 01 00 00 {place} 0000 00 00",
            )
            for place, data in (
                ("6040 00", "06 00"),  # shutdown
                ("6040 00", "07 00"),  # switch on
                ("6040 00", "0F 00"),  # enable
                ("6040 00", "1F 00"),  # start
                ("6040 00", "0F 01"),  # stop
                ("6040 00", "00 01"),  # reset, as the sample program has it
                ("6040 00", "80 00"),  # fault reset
                ("6060 00", "06"),
                ("6092 01", "18 15 00 00"),  # feed 5400
                ("6099 01", "70 17 00 00"),  # homing speed 6000
                ("609A 00", "A0 86 01 00"),  # homing acceleration 100000
                ("6081 00", "98 3A 00 00"),  # velocity 15000
                ("6083 00", "50 C3 00 00"),  # acceleration 50000
                ("607A 00", "A8 61 00 00"),  # target 250 mm
            )
        ),
    ],
)
def test_telegram_of_the_maker_is_answered_as_told(bench, request_, answer):
    assert bench.ask(request_) == answer.replace(" ", "")


def test_mode_display_is_read_as_told(bench):
    bench.write(0x6060, "06")
    assert bench.ask("0000 0000 000D 00 2B 0D 00 00 00 6061 00 0000 00 01") == (
        "0000 0000 000E 00 2B 0D 00 00 00 6061 00 0000 00 01 06".replace(" ", "")
    )


@pytest.mark.parametrize(("on", "bits"), [("di2", "08 00 42 00"), ("di1", "08 00 41 00")])
def test_digital_inputs_are_read_as_told(bench, on, bits):
    bench.stimulate(on, 1)
    assert bench.ask("0000 0000 000D 00 2B 0D 00 00 00 60FD 00 0000 00 04") == (
        f"0000 0000 0011 00 2B 0D 00 00 00 60FD 00 0000 00 04 {bits}".replace(" ", "")
    )


# --- exceptions


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("03 0000 0001", "8301"),  # other function
        ("2B 0E 01 00", "AB03"),  # other MEI type
        ("2B 0D 00 00 00 5FFF 00 0000 00 02", "AB02"),  # no such object
        ("2B 0D 00 00 00 605A 00 0000 00 02", "AB02"),  # of the standard, not of this drive
        ("2B 0D 00 00 00 6092 03 0000 00 04", "AB02"),  # no such sub-index
        ("2B 0D 00 00 00 6041 00 0000 00 00", "AB03"),  # byte counts
        ("2B 0D 00 00 00 6041 00 0000 00 05", "AB03"),
        ("2B 0D 00 00 00 6041 00 0000 00 01", "AB03"),
        ("2B 0D 00 00 00 6041 00 0000 00 02 00", "AB03"),  # byte 5 is 14
        ("2B 0D 01 00 00 6040 00 0000 00 02 06", "AB03"),
        ("2B 0D 01 00 00 6040 00 0000 00 01 06", "AB03"),  # as one old client does
        ("2B 0D 02 00 00 6040 00 0000 00 02 06 00", "AB03"),  # neither read nor write
        ("2B 0D 00 01 00 6041 00 0000 00 02", "AB03"),
        ("2B 0D 00 00 00 6041 00 0001 00 02", "AB03"),
        ("2B 0D 01 00 00 6041 00 0000 00 02 06 00", "AB03"),  # read-only
        ("2B 0D 01 00 00 6060 00 0000 00 01 08", "AB03"),  # csp
    ],
)
def test_wrong_telegram_gets_exception(bench, pdu, code):
    length = len(bytes.fromhex(pdu)) + 1
    assert bench.ask(f"0001 0000 {length:04X} 00 {pdu}") == f"00010000000300{code}"


def test_garbage_closes_connection(bench):
    bench.ask("FF" * 20)
    assert bench.heard == [b""]


def test_object_shorter_than_asked_answers_with_its_own_size(bench):
    assert bench.read(0x6098, 4) == "25"


def test_telegram_before_boot_up_has_no_answer():
    bench = Bench(boot=False)
    assert bench.read(0x6041, 2) == ""
    bench.run_ms(3000)
    assert bench.status() == "4006"


# --- states


def test_statusword_of_each_state_is_exact(bench):
    for word, status in (("06 00", "2106"), ("07 00", "2306"), ("0F 00", "2706")):
        bench.write(0x6040, word)
        bench.run_ms(30)
        assert bench.status() == status


def test_drive_without_di7_shows_it_and_stays_off(bench):
    bench.enable()
    bench.stimulate("di7", 0)
    assert bench.status() == "4004"
    assert bench.read(0x60FD, 4) == "00000000"
    bench.enable()
    assert bench.status() == "4004"
    bench.stimulate("di7", 1)
    assert bench.status() == "4006"
    bench.enable()
    assert bench.status() == "2706"


def test_fault_is_reset_only_with_di7(bench):
    bench.enable()
    bench.stimulate("fault", 0x2310)
    bench.run_ms(50)
    assert bench.status() == "0806"
    assert bench.read(0x603F, 2) == "1023"
    bench.stimulate("di7", 0)
    bench.write(0x6040, "80 00")
    assert bench.status() == "0804"
    bench.stimulate("di7", 1)
    bench.write(0x6040, "00 01")  # no edge of bit 7: no reset
    assert bench.status() == "0806"
    bench.write(0x6040, "80 00")
    assert bench.status() == "4006"


def test_following_error_shows_bit_13(bench):
    bench.enable()
    bench.stimulate("fault", 0x8611)
    bench.run_ms(50)
    assert bench.status() == "0822"


def test_homing_and_motion_of_the_sample_program(bench):
    bench.enable()
    bench.write(0x6060, "06")
    bench.write(0x6040, "1F 00")
    bench.run_ms(50)
    assert bench.status() == "2716"
    assert bench.read(0x2014, 2) == "0100"
    bench.write(0x6060, "01")
    bench.write(0x6040, "0F 00")
    assert bench.status() == "2706"
    for index, data in ((0x6081, "98 3A"), (0x6083, "50 C3"), (0x6084, "50 C3"), (0x607A, "A8 61")):
        assert bench.write(index, data + " 00 00") == ""
    bench.write(0x6040, "1F 00")
    assert bench.status() == "2712"  # on the way: acknowledged, not reached
    bench.run_ms(3000)
    assert bench.status() == "2716"
    assert bench.position() == pytest.approx(25_000, abs=2)  # its own servo
    assert bench.true("position_rad") == pytest.approx(25_000 / 5_400 * 6.283185, abs=0.002)
    bench.write(0x6040, "06 00")
    bench.run_ms(30)
    assert bench.status() == "2116"  # homed


def test_target_outside_607b_does_not_move(bench):
    bench.enable()
    for subindex, data in ((1, "00 00 00 00"), (2, "10 27 00 00")):
        assert bench.write(0x607B, data, subindex) == ""
    bench.write(0x607A, "11 27 00 00")
    bench.write(0x6040, "1F 00")
    bench.run_ms(1000)
    assert bench.true("position_rad") == pytest.approx(0.0, abs=1e-3)
    assert bench.status() == "2706"
    bench.write(0x6040, "0F 00")
    bench.write(0x607A, "10 27 00 00")
    bench.write(0x6040, "1F 00")
    bench.run_ms(3000)
    assert bench.position() == pytest.approx(10_000, abs=2)  # its own servo


def test_60a8_rotary_counts_hundredths_of_a_degree(bench):
    bench.write(0x60A8, "00 00 41 FE")
    bench.enable()
    bench.write(0x607A, "28 23 00 00")  # 90 degrees
    bench.write(0x6040, "1F 00")
    bench.run_ms(3000)
    assert bench.true("position_rad") == pytest.approx(1.5708, abs=0.002)


@pytest.mark.parametrize(("unit", "rpm"), [("position", 15_000 / 5_400 * 60), ("rpm", 150.0)])
def test_velocity_unit_is_that_of_the_setting(unit, rpm):
    bench = Bench(velocity_unit=unit)
    bench.enable()
    bench.write(0x6060, "03")
    bench.write(0x60FF, "98 3A 00 00")
    bench.run_ms(3000)
    assert bench.true("velocity_rad_s") * 60 / 6.283185 == pytest.approx(rpm, rel=0.01)


# --- settings


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"unit": 0}, "unit"),
        ({"velocity_unit": "mm"}, "velocity_unit"),
        ({"objects": {"605A": 1}}, "is not an object of this drive"),
        ({"objects": {"6098": 1000}}, "6098"),
        ({"objects": {"position": 1}}, "is not an object"),
    ],
)
def test_wrong_setting_is_refused(table, text):
    with pytest.raises(SettingError, match=text):
        Bench(**table)


def test_objects_of_the_rig_are_values_at_power_on():
    bench = Bench(objects={"607B:2": 10_000, "6092:1": 36_000})
    assert bench.read(0x607B, 4, 2) == "10270000"
    assert bench.read(0x6092, 4, 1) == "A08C0000"


def test_stimulus_of_other_name_is_refused(bench):
    with pytest.raises(ValueError, match="known: di1"):
        bench.stimulate("di11", 1)
    with pytest.raises(ValueError, match="0 or 1"):
        bench.stimulate("di1", 2)


def test_clock_and_unreachable_switches_are_told():
    stops = {"preset": "wheel_60w", "stop_low_rad": -1.0, "stop_high_rad": 1.0}
    table = {
        **{"unit": 1, "plant": stops, "oscillator": {"ppm": 80.0}},
        "switches": {"home_from_rad": 2.0, "home_to_rad": 3.0},
    }
    drive = build(table, ControllerContext("drive", Path(), 1))
    told = " ".join(text for _, text in drive.take_events())
    assert "switch home is beyond the ends of the way" in told
    assert "80 ppm fast" in told
