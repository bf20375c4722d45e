"""A servo of the X series on a line: instructions, access rules, answers in turn, motion.

Expected packets are built here with the packets of test_packets, which are the maker's.
"""

from math import pi

import pytest

from motorhil.emulators.controller import SettingError
from motorhil.emulators.dynamixel.packets import crc16, packet, status
from tests.support.dynamixel.bench import MS, PLANT, Bench

PING, PONG = "FFFFFD0001030001194E", "FFFFFD000107005500B00434B2D4"
OK = "FFFFFD000104005500A10C"
TORQUE_ON = "FFFFFD0001060003400001DB66"
READ_132 = "FFFFFD0001070002840004001D15"
REBOOT = "FFFFFD00010300082F4E"
ACTION = "FFFFFD000103000502CE"
SYNC_READ_132 = "FFFFFD00FE090082840004000102CEFA"
US = 1000


def hexed(data: bytes) -> str:
    return data.hex().upper()


def write(address: int, size: int, value: int, unit: int = 1, code: int = 3) -> str:
    data = address.to_bytes(2, "little") + value.to_bytes(size, "little", signed=value < 0)
    return hexed(packet(unit, code, data))


def read(bench: Bench, address: int, size: int, unit: int = 1, *, signed: bool = False) -> int:
    asked = address.to_bytes(2, "little") + size.to_bytes(2, "little")
    answer = bytes.fromhex(bench.ask(hexed(packet(unit, 2, asked))))
    assert answer[8] & 0x7F == 0, answer
    return int.from_bytes(answer[9 : 9 + size], "little", signed=signed)


def position(bench: Bench) -> int:
    return read(bench, 132, 4, signed=True)


def error(bench: Bench, sent: str) -> int:
    answer = bytes.fromhex(bench.ask(sent))
    assert len(answer) == 11, answer
    return answer[8]


def moved(bench: Bench, *writes: tuple[int, int, int]) -> None:
    for address, size, value in writes:
        assert error(bench, write(address, size, value)) == 0


# ---- single servos --------------------------------------------------------------------------


def test_ping_answers_model_and_firmware():
    assert Bench().ask(PING) == PONG


def test_servo_is_silent_while_it_boots():
    bench = Bench(boot=False)
    assert bench.ask(PING) == ""
    bench.run_ms(400)
    assert bench.ask(PING) == PONG


def test_status_comes_after_the_return_delay():
    bench = Bench()
    for delay, expected_us in ((250, 500), (0, 50), (254, 508)):
        bench.ask(write(9, 1, delay))
        bench.sent.clear()
        bench.ask(PING)
        (_, end_ns, _, _), (start_ns, _, sender, _) = bench.sent
        assert (start_ns - end_ns, sender) == (expected_us * US, "1")


@pytest.mark.parametrize(
    ("level", "answers"), [(0, (True, False, False)), (1, (True, True, False)), (2, (True,) * 3)]
)
def test_status_return_level_silences(level, answers):
    bench = Bench()
    bench.ask(write(68, 1, level))
    found = tuple(bench.ask(one) != "" for one in (PING, READ_132, write(65, 1, 1)))
    assert found == answers
    bench.ask(write(68, 1, 2))
    assert read(bench, 65, 1) == 1  # it was executed all the same


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        (hexed(packet(1, 0x42)), 2),  # unknown instruction
        (ACTION, 2),  # without Reg Write
        (write(104, 4, 446), 6),  # above the velocity limit
        (write(116, 4, 4096), 6),  # above the position limit
        (write(102, 2, 1751), 4),  # above the item's own range
        (write(9, 1, 255), 4),
        (write(11, 1, 2), 4),  # not a mode
        (write(116, 2, 100), 5),  # half an item
        (hexed(packet(1, 3, b"\x40\x00")), 5),  # no data
        (write(132, 4, 0), 7),  # read-only
        (write(15, 1, 0), 7),  # undefined
        (hexed(packet(1, 0x10, b"\x01\x44\x58\x4c\x21")), 4),
    ],
)
def test_wrong_instruction_is_refused_with_its_error(sent, expected):
    bench = Bench()
    assert error(bench, sent) == expected


def test_reads_beyond_the_table_have_no_data():
    bench = Bench()
    assert bench.ask(hexed(packet(1, 2, bytes.fromhex("E400 0100")))) == hexed(status(1, 7))
    asked = hexed(packet(1, 2, bytes.fromhex("8500 0200")))  # bytes 1 and 2 of the position
    assert bench.ask(asked) == hexed(status(1, 0, b"\x08\x00"))


def test_eeprom_is_locked_while_torque_is_on():
    bench = Bench()
    assert error(bench, TORQUE_ON) == 0
    assert error(bench, write(11, 1, 4)) == 7
    assert error(bench, write(112, 4, 100)) == 0
    assert error(bench, write(64, 1, 0)) == 0
    assert error(bench, write(11, 1, 4)) == 0


def test_refused_write_of_several_items_writes_nothing():
    bench = Bench()
    data = bytes.fromhex("6C00 0A000000 FFFF0000")  # 108 = 10, 112 = 65535
    assert error(bench, hexed(packet(1, 3, data))) == 4
    assert read(bench, 108, 4) == 0
    assert error(bench, "FFFFFD00010D00036C000A000000640000004236") == 0
    assert (read(bench, 108, 4), read(bench, 112, 4)) == (10, 100)


def test_reg_write_waits_for_action():
    bench = Bench()
    assert error(bench, "FFFFFD00010900046800C8000000AE8E") == 0
    assert (read(bench, 69, 1), read(bench, 104, 4)) == (1, 0)
    assert bench.ask("FFFFFD00FE0300052AC2") == ""  # broadcast
    assert (read(bench, 69, 1), read(bench, 104, 4)) == (0, 200)


def test_new_id_and_rate_show_from_the_next_packet_on():
    bench = Bench()
    assert bench.ask("FFFFFD0001060003070002BD63") == OK
    assert bench.ask(PING) == ""
    assert bench.ask(hexed(packet(2, 1))) == hexed(status(2, 0, bytes.fromhex("B00434")))
    assert bench.ask(write(8, 1, 1, unit=2)) != ""
    assert bench.ask(hexed(packet(2, 1))) == ""
    assert bench.events[-1].endswith("it is unreachable now")


def test_secondary_id_is_executed_silently():
    bench = Bench()
    bench.ask(write(12, 1, 9))
    assert bench.ask(write(65, 1, 1, unit=9)) == ""
    assert bench.ask(write(9, 1, 7, unit=9)) == ""
    assert (read(bench, 65, 1), read(bench, 9, 1)) == (1, 250)  # the EEPROM is untouched


def test_reboot_answers_then_is_deaf_and_forgets_ram():
    bench = Bench()
    moved(bench, (9, 1, 5), (84, 2, 700), (168, 2, 132))
    assert bench.ask(REBOOT) == OK
    assert bench.ask(PING) == ""
    bench.run_ms(400)
    assert bench.ask(PING) == PONG
    assert [read(bench, 9, 1), read(bench, 84, 2), read(bench, 168, 2)] == [5, 400, 208]


@pytest.mark.parametrize(("what", "unit", "rate"), [(1, 3, 1), (2, 3, 3), (0xFF, 1, 1)])
def test_factory_reset_keeps_what_its_parameter_says(what, unit, rate):
    bench = Bench({"unit": 3})
    bench.ask(write(9, 1, 5, unit=3))
    assert bench.ask(hexed(packet(3, 6, bytes((what,))))) == hexed(status(3, 0))
    bench.run_ms(500)
    can_answer = rate == 3
    assert (bench.ask(hexed(packet(unit, 1))) != "") is can_answer  # the line has rate 3
    if can_answer:
        assert read(bench, 9, 1, unit=unit) == 250


def test_broadcast_factory_reset_of_all_is_refused():
    bench = Bench()
    bench.ask(write(9, 1, 5))
    bench.ask(hexed(packet(0xFE, 6, b"\xff")))
    assert read(bench, 9, 1) == 5


def test_backup_restores_the_eeprom_and_needs_torque_off():
    bench = Bench()
    store, restore = "FFFFFD0001080020014354524C16F5", "FFFFFD0001080020024354524C9EF5"
    assert error(bench, restore) == 1  # nothing is stored
    moved(bench, (9, 1, 5))
    assert error(bench, store) == 0
    assert read(bench, 147, 1) == 1
    moved(bench, (9, 1, 6), (64, 1, 1))
    assert error(bench, store) == 1
    moved(bench, (64, 1, 0))
    assert error(bench, restore) == 0
    bench.run_ms(500)
    assert (read(bench, 9, 1), read(bench, 147, 1)) == (5, 1)


def test_indirect_items_stand_for_their_targets():
    bench = Bench()
    for n in range(4):
        moved(bench, (168 + 2 * n, 2, 116 + n))
    moved(bench, (64, 1, 1))
    assert error(bench, write(208, 4, 3000)) == 0
    assert read(bench, 116, 4) == 3000
    assert error(bench, write(208, 4, 5000)) == 6  # they take over the range
    assert error(bench, write(208, 2, 100)) == 5


@pytest.mark.parametrize(
    ("servo", "data"),
    [
        ({"firmware": 52}, 208),
        ({"firmware": 53}, 224),
        ({"model": "xm430-w350"}, 224),
    ],
)
def test_indirect_data_begin_where_the_firmware_has_them(servo, data):
    assert read(Bench(servo), 168, 2) == data


# ---- groups ---------------------------------------------------------------------------------


def two(**own: object) -> Bench:
    bench = Bench({"unit": 1, **own}, {"unit": 2, **own})
    return bench


def test_sync_read_is_answered_in_turn_after_each_delay():
    bench = two()
    bench.sent.clear()
    bench.ask(SYNC_READ_132)
    request, first, second = bench.sent
    assert [one[2] for one in bench.sent] == ["host", "1", "2"]
    assert first[0] - request[1] == second[0] - first[1] == 500 * US
    assert second[3] == status(2, 0, (2048).to_bytes(4, "little"))


def test_absent_servo_silences_all_behind_it():
    bench = Bench({"unit": 2})
    assert bench.ask(SYNC_READ_132, 200) == ""
    reply = bench.ask("FFFFFD00FE0D0092019000020002920001001A05", 200)  # bulk read of 1 and 2
    assert reply == ""


def test_sync_write_starts_both_at_one_instant():
    bench = two()
    bench.ask(write(64, 1, 1, unit=0xFE))
    assert bench.ask("FFFFFD00FE11008374000400019600000002AA0000008287") == ""
    assert [read(bench, 116, 4, unit) for unit in (1, 2)] == [150, 170]
    assert bench.truth(1)["demand_inc"] < 0 > bench.truth(2)["demand_inc"]


def test_fast_sync_read_is_one_packet_with_a_crc_each():
    bench = Bench({"unit": 3}, {"unit": 7}, {"unit": 4})
    answer = bytes.fromhex(bench.ask("FFFFFD00FE0A008A8400040003070420F2"))
    assert answer[:8].hex().upper() == "FFFFFD00FE190055"
    for n, unit in enumerate((3, 7, 4)):
        at = 8 + 8 * n
        assert answer[at : at + 6] == bytes((0, unit)) + (2048).to_bytes(4, "little")
        assert answer[at + 6 : at + 8] == crc16(answer[: at + 6])
    starts = [one[0] for one in bench.sent[-3:]]
    ends = [one[1] for one in bench.sent[-3:]]
    assert starts[1:] == ends[:-1]  # without a pause


def at_counts(unit, counts):
    """Return the settings of a servo whose shaft stands at these counts."""
    return {"unit": unit, "initial_position_rad": (counts + 0.25 - 2048) / 4096 * 2 * pi}


def test_fast_sync_read_has_the_answer_of_the_manual():
    bench = Bench(at_counts(3, 166), at_counts(7, 2079), at_counts(4, 1023))
    assert bench.ask("FFFFFD00FE0A008A8400040003070420F2") == (
        "FFFFFD00FE190055" + "0003A60000008408" + "00071F08000016CA" + "0004FF030000D19E"
    )


def test_fast_sync_read_of_one_servo_has_its_golden_answer():
    query = hexed(packet(0xFE, 0x8A, bytes((132, 0, 4, 0, 1))))
    assert Bench().ask(query) == "FFFFFD00FE090055000100080000E496"


def test_fast_bulk_read_has_the_answer_of_the_manual():
    fine = {"unit": 7, "plant": {**PLANT, "encoder_increments_rev": 65_536}}
    bench = Bench(at_counts(3, 166), fine, {"unit": 4})
    bench.ask(write(64, 1, 1, unit=7))
    bench.stimulate("load_torque_n_m", 0.2178, 7)  # held with 47.6 % of the supply
    bench.stimulate("temperature_c", 31.0, 4)
    bench.run_ms(500)
    assert bench.ask("FFFFFD00FE12009A0384000400077C0002000492000100DA2D") == (
        "FFFFFD00FE140055" + "0003A600000067A4" + "0007A5012474" + "00041FD9C1"
    )


@pytest.mark.parametrize("code", [0x92, 0x9A, 0x93])
def test_bulk_packet_that_ends_within_an_item_is_ignored(code):
    bench = Bench()
    assert bench.ask(hexed(packet(0xFE, code, bytes((1, 64, 0, 1))))) == ""
    assert read(bench, 64, 1) == 0


def test_alert_is_in_the_block_of_its_servo():
    second = at_counts(2, -1) | {"registers": {"operating_mode": 4, "homing_offset": -4096}}
    second["initial_position_rad"] = (4095.25 - 2048) / 4096 * 2 * pi
    bench = Bench(at_counts(1, 1200), second)
    bench.stimulate("temperature_c", 90.0, 1)
    query = hexed(packet(0xFE, 0x8A, bytes((132, 0, 4, 0, 1, 2))))
    assert bench.ask(query) == "FFFFFD00FE1100558001B0040000AA030002FFFFFFFF8030"


def test_fast_read_without_fast_firmware_is_not_answered():
    bench = Bench({"unit": 3, "firmware": 45})
    assert bench.ask("FFFFFD00FE0A008A8400040003070420F2") == ""


def test_silent_servo_cuts_a_fast_read_short():
    bench = Bench({"unit": 3}, {"unit": 4})
    answer = bytes.fromhex(bench.ask("FFFFFD00FE0A008A8400040003070420F2", 100))
    assert len(answer) == 16
    assert bench.ask(hexed(packet(4, 1))) != ""


def test_broadcast_ping_costs_3_ms_for_each_missing_id():
    bench = Bench({"unit": 1}, {"unit": 2}, {"unit": 5})
    bench.sent.clear()
    bench.ask("FFFFFD00FE0300013142", 50)
    request, first, second, fifth = bench.sent
    assert first[0] - request[1] == 500 * US
    assert second[0] - first[1] == 50 * US
    assert fifth[0] - second[1] == 6 * MS + 50 * US


# ---- motor ----------------------------------------------------------------------------------


def test_position_is_the_encoder_with_its_centre_at_zero():
    assert position(Bench()) == 2048
    assert position(Bench({"initial_position_rad": pi / 2})) == 3072
    assert position(Bench({"initial_position_rad": 2 * pi + pi / 2})) == 3072  # turns are lost


def test_profile_takes_its_time_by_the_makers_formulas():
    bench = Bench()
    moved(bench, (11, 1, 4), (108, 4, 20), (112, 4, 100), (64, 1, 1))
    begun_ns = bench.now_ns
    moved(bench, (116, 4, 2048 + 4096))
    t1_ms, t2_ms = 64 * 100 / 20, 64 * 4096 / 100
    while read(bench, 123, 1) & 2:
        pass
    # at the end of an exchange of 20 ms
    assert 0 <= (bench.now_ns - begun_ns) / MS - (t1_ms + t2_ms) <= 45
    bench.run_ms(300)
    assert abs(position(bench) - (2048 + 4096)) <= 1
    assert read(bench, 123, 1) == 0x31


def test_time_based_profile_ends_in_the_given_time():
    bench = Bench({"registers": {"drive_mode": 4, "operating_mode": 4}})
    moved(bench, (108, 4, 500), (112, 4, 2000), (64, 1, 1))
    begun_ns = bench.now_ns
    moved(bench, (116, 4, 2048 - 3000))
    while read(bench, 122, 1):
        pass
    assert 2000 <= (bench.now_ns - begun_ns) / MS <= 2100
    bench.run_ms(300)
    assert abs(position(bench) + 952) <= 1


def test_velocity_mode_runs_at_its_unit():
    bench = Bench({"registers": {"operating_mode": 1}})
    moved(bench, (64, 1, 1), (104, 4, -100))
    bench.run_ms(1000)
    before = position(bench)
    bench.run_ms(980)
    assert abs((position(bench) - before) / -1562.5 - 1) < 0.01
    assert abs(read(bench, 128, 4, signed=True) + 100) <= 2


def test_reverse_mode_mirrors_goal_and_position():
    bench = Bench({"registers": {"drive_mode": 1, "operating_mode": 4}})
    moved(bench, (112, 4, 200), (64, 1, 1), (116, 4, 3072))
    bench.run_ms(2000)
    assert abs(position(bench) - 3072) <= 1
    assert abs(bench.truth()["position_rad"] + pi / 2) < 0.01


def test_homing_offset_is_added_and_bounded_in_position_mode():
    bench = Bench()
    for offset, expected in ((1024, 3072), (1025, 2048), (-1024, 1024)):
        moved(bench, (20, 4, offset))
        assert position(bench) == expected


def test_turns_are_lost_at_reboot_and_kept_by_torque():
    bench = Bench({"registers": {"operating_mode": 4}})
    moved(bench, (64, 1, 1), (116, 4, 10_000))
    bench.run_ms(4000)
    moved(bench, (64, 1, 0))
    assert abs(position(bench) - 10_000) <= 1
    bench.ask(REBOOT)
    bench.run_ms(500)
    assert abs(position(bench) - 10_000 % 4096) <= 1


def test_clear_forgets_turns_at_rest_only():
    bench = Bench({"registers": {"operating_mode": 4}})
    clear = "FFFFFD00010800100144584C22B1DC"
    moved(bench, (112, 4, 200), (64, 1, 1), (116, 4, 10_000))
    assert error(bench, clear) == 1
    bench.run_ms(4000)
    assert error(bench, clear) == 0
    assert abs(position(bench) - 10_000 % 4096) <= 1


def test_torque_on_makes_the_present_position_the_goal():
    bench = Bench()
    moved(bench, (116, 4, 100), (64, 1, 1))
    bench.run_ms(500)
    assert (read(bench, 116, 4), position(bench)) == (2048, 2048)


def test_goal_switches_torque_on_in_drive_mode_8():
    bench = Bench({"registers": {"drive_mode": 8}})
    moved(bench, (116, 4, 3000))
    bench.run_ms(1000)
    assert read(bench, 64, 1) == 1
    assert abs(position(bench) - 3000) <= 1


def test_mode_change_resets_profile_gains_and_goals():
    bench = Bench()
    moved(bench, (108, 4, 20), (112, 4, 100), (84, 2, 700), (38, 2, 900), (11, 1, 5))
    values = [read(bench, at, size) for at, size in ((108, 4), (112, 4), (84, 2), (102, 2))]
    assert values == [0, 0, 400, 900]


def test_current_based_mode_bounds_the_current():
    bench = Bench({"registers": {"operating_mode": 5}})
    moved(bench, (102, 2, 100), (64, 1, 1))
    bench.stimulate("load_torque_n_m", -0.01)
    bench.send(bytes.fromhex(write(116, 4, 9000)))
    currents = []
    for _ in range(30):
        bench.run_ms(1)
        currents.append(bench.truth()["current_a"])
    assert max(currents) == pytest.approx(0.1, abs=0.01)  # the loop's ripple


# ---- errors and watchdog --------------------------------------------------------------------


def test_hardware_error_shuts_down_until_reboot():
    bench = Bench()
    moved(bench, (64, 1, 1))
    bench.stimulate("temperature_c", 71)
    assert bench.ask("FFFFFD0001070002460001003CA3") == hexed(status(1, 0x80, b"\x04"))
    bench.stimulate("temperature_c", 40)
    assert error(bench, TORQUE_ON) == 0x80
    assert bench.truth()["torque_enable"] == 0
    bench.ask(REBOOT)
    bench.run_ms(500)
    assert error(bench, TORQUE_ON) == 0
    assert bench.truth()["torque_enable"] == 1


def test_error_outside_shutdown_only_raises_the_alert():
    bench = Bench({"model": "xm430-w350"})
    moved(bench, (64, 1, 1))
    bench.stimulate("input_voltage_v", 17.0)
    assert bench.ask(hexed(packet(1, 2, b"\x40\0\1\0"))) == hexed(status(1, 0x80, b"\x01"))


def test_overload_follows_5_s_at_the_limit():
    bench = Bench({"registers": {"current_limit": 200}})
    moved(bench, (64, 1, 1))
    bench.stimulate("load_torque_n_m", 0.5)
    bench.run_ms(4900)
    assert bench.truth()["hardware_error_status"] == 0
    bench.run_ms(300)
    assert bench.truth()["hardware_error_status"] == 0x20
    assert bench.truth()["torque_enable"] == 0


def test_bus_watchdog_stops_and_refuses_goals_until_cleared():
    bench = Bench({"unit": 1, "registers": {"operating_mode": 1}}, {"unit": 2})
    moved(bench, (98, 1, 5), (64, 1, 1), (104, 4, 100))
    for _ in range(10):  # instructions to another servo count too
        bench.ask(hexed(packet(2, 1)), 90)
    assert bench.truth()["velocity_rad_s"] > 1.0
    bench.run_ms(400)
    assert abs(bench.truth()["velocity_rad_s"]) < 0.1
    assert read(bench, 98, 1) == 0xFF
    assert read(bench, 64, 1) == 1
    assert error(bench, write(104, 4, 50)) == 4
    assert error(bench, write(98, 1, 0)) == 0
    assert error(bench, write(104, 4, 50)) == 0


# ---- settings -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("own", "told"),
    [
        ({"unit": 253}, "unit"),
        ({"model": "ax-12a"}, "model"),
        ({"registers": {"goal_positon": 1}}, "did you mean goal_position?"),
        ({"registers": {"moving": 1}}, "not a writable register"),
        ({"registers": {"return_delay_time": 255}}, "allowed: 0 to 254"),
    ],
)
def test_wrong_setting_is_refused_with_its_name(own, told):
    with pytest.raises(SettingError) as caught:
        Bench(own)
    assert told in str(caught.value)


def test_line_at_an_impossible_rate_is_refused():
    with pytest.raises(SettingError, match="bit rate is 19200"):
        Bench(baud=19_200)
    with pytest.raises(SettingError, match=r"4500000 bit/s; allowed: .*, 4000000$"):
        Bench(baud=4_500_000)  # the larger series has it
    Bench({"model": "xm430-w350"}, baud=4_500_000)


# ---- what slips of the emulator have shown --------------------------------------------------


def test_watchdog_measures_with_torque_only_and_needs_0():
    bench = Bench()
    moved(bench, (98, 1, 5))
    bench.run_ms(300)
    assert read(bench, 98, 1) == 5
    moved(bench, (64, 1, 1))
    bench.run_ms(300)
    assert read(bench, 98, 1) == 0xFF
    assert error(bench, write(98, 1, 7)) == 4
    assert error(bench, write(98, 1, 0)) == 0


def test_demand_ends_at_the_very_goal():
    for drive_mode in (0, 1):
        bench = Bench({"registers": {"operating_mode": 4, "drive_mode": drive_mode}})
        moved(bench, (64, 1, 1), (116, 4, 3001))
        bench.run_ms(100)
        assert read(bench, 140, 4, signed=True) == 3001


def test_torque_on_in_position_mode_forgets_turns():
    bench = Bench()
    bench.stimulate("load_torque_n_m", -0.1)
    bench.run_ms(2000)
    bench.stimulate("load_torque_n_m", 0.0)
    bench.run_ms(1000)
    turned = position(bench)
    assert turned > 4096
    moved(bench, (64, 1, 1))
    assert position(bench) == pytest.approx(turned % 4096, abs=2)


def test_time_based_ramp_is_half_of_the_time_at_most():
    bench = Bench({"registers": {"drive_mode": 4, "operating_mode": 4}})
    moved(bench, (108, 4, 1800), (112, 4, 2000), (64, 1, 1))
    begun_ns = bench.now_ns
    moved(bench, (116, 4, 2048 + 3000))
    while read(bench, 122, 1):
        pass
    assert 2000 <= (bench.now_ns - begun_ns) / MS <= 2100


def test_reboot_forgets_a_registered_write():
    bench = Bench()
    assert error(bench, "FFFFFD00010900046800C8000000AE8E") == 0
    bench.ask(REBOOT)
    bench.run_ms(500)
    assert error(bench, ACTION) == 2


@pytest.mark.parametrize(("pause_ms", "answers"), [(40, True), (60, False)])
def test_servo_in_turn_gives_up_after_50_ms(pause_ms, answers):
    bench = Bench({"unit": 2})
    assert bench.ask(SYNC_READ_132, pause_ms) == ""
    heard = bench.ask("FFFFFD000108005500A60000008CC0")  # the status of servo 1
    assert (heard == hexed(status(2, 0, (2048).to_bytes(4, "little")))) is answers
