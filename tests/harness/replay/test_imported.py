"""Imported recordings stand in, whatever their buses are called and their units numbered."""

import pytest

from harness.cli import main
from harness.replay.verdict import unanswered
from harness.rig import Rig


@pytest.fixture(scope="module")
def plant(shared, tmp_path_factory):
    """Thirteen Modbus/TCP servers, each unit 255 of an address of its own."""
    path = tmp_path_factory.mktemp("plant") / "plant.mcap"
    source = shared / "data" / "traffic" / "modbus_plant1_tcp.pcap"
    assert main(["convert", str(source), "-o", str(path)]) == 0
    return path


def test_servers_that_are_addresses_answer_behind_lines_of_their_own(plant):
    """What it was asked first, with another transaction, is answered as in the capture."""
    with Rig.open(plant) as rig:
        line = rig.line("line_141_81_0_24")
        assert line.framing == "tcp"
        heard = []
        line.listen(lambda data, _: heard.append(data))
        core = rig.controllers["line_141_81_0_24_unit_255"].core
        turn = next(step.turns[0] for step in core.player.tape.steps if step.turns)
        line.send(b"\0\7\0\0" + len(turn.asked).to_bytes(2, "big") + turn.asked)
        rig.runtime.run_for(1.0)
        assert unanswered(rig) == []
    told = turn.answers[0].data
    assert told[0] == 255
    assert b"".join(heard) == b"\0\7\0\0" + len(told).to_bytes(2, "big") + told
