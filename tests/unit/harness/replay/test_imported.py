"""Replay of imported recordings with any names of buses and numbers of units."""

import pytest

from motorhil.harness.cli.main import main
from motorhil.harness.replay.verdict import unanswered
from motorhil.harness.rig.rig import Rig


@pytest.fixture(scope="module")
def plant(shared, tmp_path_factory):
    """Import thirteen Modbus/TCP servers, each unit 255 of its own address."""
    path = tmp_path_factory.mktemp("plant") / "plant.mcap"
    source = shared / "data" / "traffic" / "modbus_plant1_tcp.pcap"
    assert main(["convert", str(source), "-o", str(path)]) == 0
    return path


def test_servers_named_by_addresses_answer(plant):
    """The first recorded request, with another transaction, gets the captured answer."""
    with Rig.open(plant) as rig:
        line = rig.line("line_141_81_0_24")
        assert line.framing == "tcp"
        heard = []
        line.listen(lambda data, _: heard.append(data))
        core = rig.controllers["line_141_81_0_24_unit_255"].core
        turn = next(step.turns[0] for step in core.player.log.steps if step.turns)
        line.send(b"\0\7\0\0" + len(turn.asked).to_bytes(2, "big") + turn.asked)
        rig.runtime.run_for(1.0)
        assert unanswered(rig) == []
    told = turn.answers[0].data
    assert told[0] == 255
    assert b"".join(heard) == b"\0\7\0\0" + len(told).to_bytes(2, "big") + told


def test_slow_units_answer_through_a_patient_gateway(shared, tmp_path):
    """The slowest answer took 5.1 s (traffic/INDEX.md); a gateway's default timeout is 1 s."""
    path = tmp_path / "plant.mcap"
    source = shared / "data" / "traffic" / "modbus_gateway_units1237_pipelined.pcap"
    assert main(["convert", str(source), "-o", str(path)]) == 0
    with Rig.open(path) as rig:
        line = rig.line("line_192_168_0_20")
        heard = []
        line.listen(lambda data, now_ns: heard.append((data[:2], data[7] & 0x80)))
        steps = rig.controllers["unit_1"].core.player.log.steps
        first = {step.key: step.turns[0] for step in reversed(steps) if step.turns}
        delays = {key: turn.answers[0].delay_ns for key, turn in first.items() if turn.answers}
        slow = first[max(delays, key=lambda key: delays[key])]
        assert slow.answers[0].delay_ns > 1_000_000_000
        line.send(bytes(4) + len(slow.asked).to_bytes(2, "big") + slow.asked)
        rig.runtime.run_for(10.0)
    assert heard == [(b"\0\0", 0)]
