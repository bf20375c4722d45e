"""The rover's mast on Modbus: the same application on other hardware."""

import re

from motorhil.harness.cli.main import main
from motorhil.traces.mcap.reader import read_trace


def test_same_application_drives_a_mast_on_a_serial_line(capsys, tmp_path):
    record = tmp_path / "demo.mcap"
    assert main(["demo", "--mast", "modbus", "-o", str(record)]) == 0
    out = capsys.readouterr().out
    for name in ("pan", "tilt", "drive_fl"):
        (error,) = re.findall(rf"^{name} +\S+ +\S+ +(\S+)", out, re.MULTILINE)
        assert abs(float(error)) < 2.0
    assert re.search(r"^mast +\d+ +SEQUENTIAL +no bound", out, re.MULTILINE)
    assert re.search(r"^rs485 +\d+ +\d+\.\d%", out, re.MULTILINE)
    with read_trace(record) as trace:
        topics = {channel.topic for channel, _, _ in trace.messages()}
    assert {"/modbus/rs485", "/can/can0", "/motor/pan/state", "/motor/pan/lock"} <= topics


def test_mast_option_for_a_rover_without_drives_is_refused(capsys, tmp_path):
    record = str(tmp_path / "demo.mcap")
    assert main(["demo", "--rig", "fido", "--mast", "modbus", "-o", record]) == 2
    assert "use --mast with --rig rover" in capsys.readouterr().err
