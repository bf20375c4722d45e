"""An application's port on a line."""

import pytest

from motorhil.harness.rig.rig import Rig
from motorhil.motorapi.errors import LinkError


@pytest.mark.parametrize("kind", ["modbus_rtu", "modbus_tcp", "serial"])
def test_characters_that_wait_without_end_are_refused(tmp_path, monkeypatch, kind):
    monkeypatch.setattr("motorhil.harness.python_can.send_limit._WAITING_MAX", 3_000)
    (tmp_path / "rig.toml").write_text(f'[bus.line]\nkind = "{kind}"\n')
    with Rig.open(tmp_path / "rig.toml") as rig:
        line = rig.line("line")
        for _ in range(2):
            for _ in range(1_023):
                line.send(b"abc")
            with pytest.raises(LinkError, match=r"line: 3072 characters wait; .* at most 3000"):
                line.send(b"abc")
            rig.runtime.run_for(10.0)
            if kind == "modbus_tcp":  # disconnected: it is not Modbus
                line.reconnect()
