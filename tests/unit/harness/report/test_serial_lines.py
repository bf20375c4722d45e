"""Serial lines in a report: load by sender and message, and collisions."""

from motorhil.harness.cli.main import main
from motorhil.harness.rig.rig import Rig

RIG = """\
bus.line = {kind = "serial", baud_bit_s = 1_000_000}
controller.left = {kind = "dynamixel", bus = "line", unit = 1}
controller.right = {kind = "dynamixel", bus = "line", unit = 2}
"""
SYNC_READ = bytes.fromhex("FFFFFD00FE090082840004000102CEFA")
BROKEN = bytes.fromhex("FFFFFD00010300082F4F")


def test_serial_line_is_drawn_with_its_messages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.toml").write_text(RIG)
    with Rig.open("rig.toml", record="a.mcap") as rig:
        rig.runtime.wait_until(lambda: False, 0.5)
        for data in (SYNC_READ, BROKEN):
            rig.line("line").send(data)
            rig.runtime.wait_until(lambda: False, 0.01)
        second = rig.world.add_line_host("line", "second", lambda *_: None)
        rig.line("line").send(SYNC_READ)
        second.send(SYNC_READ)  # at once: the line garbles both
        rig.runtime.wait_until(lambda: False, 0.01)
    assert main(["report", "a.mcap", "-o", "page.html"]) == 0
    page = (tmp_path / "page.html").read_text()
    for text in ("serial line", "host Sync_Read", "left Status", "right Status", "a collision: "):
        assert text in page, text
    assert "Reboot: not decodable: wrong CRC" in page
