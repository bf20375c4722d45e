"""`motorhil serve` on Modbus: reported addresses, cleanup, refusals."""

import os
import socket
import sys

import pytest

from motorhil.harness.cli.main import main
from tests.support.modbus.served_plant import RIG, Server
from tests.system.wall.test_serve import motorhil, one_line

pytestmark = pytest.mark.wall


def test_serve_reports_addresses_and_cleans_up(tmp_path):
    there = Server(tmp_path)
    assert there.said == [
        f"plant: Modbus/TCP at 127.0.0.1:{there.port}, units 1, 2\n",
        f"rs485: Modbus RTU (as at 115200 bit/s 8N1) at {there.link}, units 1, 2\n",
    ]
    assert there.link.is_symlink()
    errors = there.stop()
    assert "Traceback" not in errors
    assert there.process.returncode == 0
    assert not there.link.is_symlink()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", there.port))


def test_stale_link_is_replaced_and_file_is_kept(tmp_path):
    link = tmp_path / "line"
    link.symlink_to("/dev/pts/no-such-terminal")
    (tmp_path / "rig.toml").write_text(RIG)
    words = ["serve", str(tmp_path / "rig.toml"), "--modbus-rtu", str(link), "--"]
    show = [sys.executable, "-c", "import os; print(os.readlink(os.environ[NAME]))"]
    show[2] = show[2].replace("NAME", "'MOTORHIL_CHANNEL_RS485'")
    done = motorhil(*words, *show)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("/dev/pts/")
    link.write_text("mine")
    done = motorhil(*words, *show)
    assert done.returncode == 2
    assert f"{link}: cannot create the link to the terminal" in one_line(done.stderr)
    assert link.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--modbus-tcp", "0.0.0.0:0"], "0.0.0.0:0: other machines can reach it"),
        (["--modbus-tcp", "[::]:0"], "[::]:0: other machines can reach it"),
        (["--modbus-tcp", "rs485=127.0.0.1:0"], "bus 'rs485': it is of kind modbus_rtu"),
        (["--modbus-tcp", "no=127.0.0.1:0"], "bus 'no': the rig has no such bus"),
        (["--modbus-rtu", "plant=/tmp/x"], "bus 'plant': it is of kind modbus_tcp"),
        (["--modbus-rtu", "rs485="], "names no place"),
        (["--modbus-tcp", "5020"], "no HOST:PORT"),
        (["--modbus-tcp", "127.0.0.1:65536"], "no HOST:PORT"),
        ([], "no address to serve them is given"),
        (["--socket", "/tmp/x", "--modbus-tcp", "127.0.0.1:0"], "no CAN bus for --on and --socket"),
    ],
)
def test_invalid_address_is_one_line_error(tmp_path, capsys, words, reason):
    (tmp_path / "rig.toml").write_text(RIG)
    assert main(["serve", str(tmp_path / "rig.toml"), *words, "--", "true"]) == 2
    assert reason in one_line(capsys.readouterr().err)


def test_any_address_option_admits_other_machines(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    done = motorhil(
        *("serve", str(tmp_path / "rig.toml"), "--modbus-tcp", "0.0.0.0:0", "--any-address"),
        *("--", "sh", "-c", "echo $MOTORHIL_CHANNEL_PLANT"),
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("0.0.0.0:")


def test_port_in_use_is_one_line_error(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        done = motorhil("serve", str(tmp_path / "rig.toml"), "--modbus-tcp", place, "--", "true")
    assert done.returncode == 2
    assert f"{place}: {os.strerror(98)}" in one_line(done.stderr)
