"""Packets of Dynamixel Protocol 2.0 in words.

Bytes of the maker's manual, or made with the maker's SDK (4.1.0).
"""

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig
from motorhil.traces.decoding.dynamixel import build

EXCHANGES = [
    (1, "FFFFFD0001030001194E", "Ping"),
    (1, "FFFFFD000107005500060426655D", "Status: Model_Number = 1030, Firmware_Version = 38"),
    (1, "FFFFFD0001070002840004001D15", "Read: From = Present_Position, Length = 4"),
    (1, "FFFFFD000108005580A60000008F7C", "Status: Alert = 1, Present_Position = 166 count"),
    (1, "FFFFFD0001090003740000020000CA89", "Write: Goal_Position = 512 count"),
    (1, "FFFFFD00010400550" + "4BA8C", "Status: Error = Data_Range"),
    (1, "FFFFFD00010A00037400FFFFFDFDFF23E5", "Write: Goal_Position = -131073 count"),
    (1, "FFFFFD00010D00036C000A000000640000004236",
     "Write: Profile_Acceleration = 10, Profile_Velocity = 100"),
    (1, "FFFFFD00010800100144584C22B1DC", "Clear: Data = 01 44 58 4C 22"),
    (2, "FFFFFD00FE090082840004000102CEFA", "Sync_Read: From = Present_Position, Length = 4"),
    (2, "FFFFFD0002080055001F080000BABE", "Status: Present_Position = 2079 count"),
    (2, "FFFFFD00FE11008374000400019600000002AA0000008287",
     "Sync_Write: Goal_Position = 170 count"),
    (2, "FFFFFD00FE0D0092019000020002920001001A05",
     "Bulk_Read: From = Present_Temperature, Length = 1"),
    (2, "FFFFFD000205005500248BA9", "Status: Present_Temperature = 36 deg C"),
    (1, "FFFFFD00FE1000930120000200A000021F00010050B768",
     "Bulk_Write: Max_Voltage_Limit = 16 V"),
    (7, "FFFFFD00FE0A008A8400040003070420F2",
     "Fast_Sync_Read: From = Present_Position, Length = 4"),
    (7, "00071F08000016CA", "Fast_Status: Present_Position = 2079 count"),
    (1, "FFFFFD00010300082F4F", "Reboot: not decodable: wrong CRC"),
    (1, "FFFFFD00010400082F4E", "Reboot: not decodable: 10 bytes; 11 are announced"),
]  # fmt: skip


@pytest.mark.parametrize("unit", [1, 2, 7])
def test_packets_are_told_in_words(unit):
    decode = build(unit)
    said = [str(decode(bytes.fromhex(data))) for who, data, _ in EXCHANGES if who == unit]
    assert said == [text for who, _, text in EXCHANGES if who == unit]


def test_packets_of_others_are_left_to_others():
    decode = build(3)
    for unit, data, _ in EXCHANGES:
        if unit != 7:
            assert decode(bytes.fromhex(data)) is None
    assert decode(b"") is None


RIG = """\
bus.line = {kind = "serial", baud_bit_s = 1_000_000}
controller.left = {kind = "dynamixel", bus = "line", unit = 1}
controller.right = {kind = "dynamixel", bus = "line", unit = 2}
"""


def test_recorded_line_is_shown_in_words(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(RIG)
    with Rig.open("rig.toml", record="a.mcap") as rig:
        rig.runtime.wait_until(lambda: False, 0.5)
        rig.line("line").send(bytes.fromhex("FFFFFD00FE090082840004000102CEFA"))
        rig.runtime.wait_until(lambda: False, 0.01)
    assert main(["show", "a.mcap"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "    0.500160000  line      Sync_Read: From = Present_Position, Length = 4",
        "    0.500810000  line      Status: Present_Position = 2048 count",
        "    0.501460000  line      Status: Present_Position = 2048 count",
    ]
    assert main(["show", "a.mcap", "--node", "2"]) == 0
    assert capsys.readouterr().out.endswith("2048 count\n")
