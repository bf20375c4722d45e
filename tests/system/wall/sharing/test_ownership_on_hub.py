"""Ownership of a shared drive, reconstructed from the hub's record alone."""

import os

import pytest

from motorhil.motorapi.locking.directory import VARIABLE, LockDirectory
from motorhil.motorapi.locking.lock_status import list_locks
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.protobuf import decode
from motorhil.traces.schema import CAN_FRAME, LockAction
from motorhil.traces.semantics.ownership import Ended, read_ownership
from tests.support.line_programs import Program
from tests.support.served_hub import served, wait_for
from tests.system.wall.sharing.test_shared_drive import MODEL

pytestmark = pytest.mark.wall

RIG = MODEL.parent / "two_wheels.toml"


@pytest.fixture
def recorded(tmp_path, folder):
    """Call a function with a starter of programs; return their record and pids."""

    def run(story):
        path, record = tmp_path / "hub", tmp_path / "run.mcap"
        started = []

        def start():
            env = {**os.environ, VARIABLE: str(folder)}
            started.append(Program("shared_drive", path, MODEL, f"p{len(started)}", env=env))
            assert started[-1].hear() == "ready"
            return started[-1]

        with served(RIG, path, "-o", record):
            try:
                story(start)
            finally:
                for program in started:
                    program.end()
        return record, [program.pid for program in started]

    return run


def commands(record):
    """Return (time, sender) of every RPDO, and of every SDO download request, to node 1."""
    with read_trace(record) as trace:
        for _, time_ns, data in trace.messages(["/can/can0"]):
            frame = decode(CAN_FRAME, data)
            first = frame["data"][0] >> 5 if frame.get("data") else -1
            if frame.get("id") in (0x201, 0x301, 0x401, 0x501) or (
                frame.get("id") == 0x601 and first in (0, 1)  # CiA 301: download segment, initiate
            ):
                yield time_ns, frame["sender"]


def told(record, pids):
    """Return (process, purpose, end) of each tenure of the left wheel."""
    tenures = record.tenures["left"]
    return [(pids.index(one.pid), one.purpose or one.owner, one.ended) for one in tenures]


def test_record_has_death_takeover_and_owner_of_commands(recorded, folder):
    def story(start):
        dies, loses, takes = start(), start(), start()
        assert dies.ask("position") == "at 0.000"  # it sets the drive up
        assert dies.ask("reserve survey") == "reserved"
        assert dies.ask("run 1.0") == "started"
        assert loses.ask("move 0.5").startswith("busy ")
        loses.say("move 0.5 60")
        wait_for(lambda: list_locks(LockDirectory(folder))[0].waiters)
        dies.kill()
        assert loses.hear() == "started"
        assert loses.ask("wait") == "done"
        assert loses.ask("reserve slow") == "reserved"
        assert takes.ask("seize rescue") == "reserved"
        assert takes.ask("move 0.25") == "started"
        assert takes.ask("wait") == "done"
        assert loses.ask("move 0.25").startswith("busy ")  # it notices
        assert takes.ask("release") == "released"
        assert loses.ask("release") == "released"

    path, pids = recorded(story)
    record = read_ownership(path)
    assert record.contradictions == ()
    tenures = record.tenures["left"]
    assert told(record, pids) == [
        (0, f"set-up of {path.parent}/hub node 1", Ended.RELEASED),
        (0, "survey", Ended.DIED),
        (1, "start() of p1", Ended.RELEASED),
        (1, "slow", Ended.TAKEN_OVER),
        (2, "rescue", Ended.RELEASED),
    ]
    assert [one.skipped for one in tenures] == [0] * 5  # every owner has sent a notice
    assert tenures[3].noticed_ns > tenures[3].to_ns
    others = [
        (pids.index(one.pid), one.action, one.holder.partition(" (")[0])
        for one in record.events
        if one.action not in (LockAction.TAKEN, LockAction.RELEASED)
    ]
    assert others == [
        (1, LockAction.REFUSED, f"pid {pids[0]}"),
        (1, LockAction.WAITING, f"pid {pids[0]}" if others[1][2] else ""),  # killed just then
        (1, LockAction.BROKEN, ""),  # a dead process does not say its name
        (2, LockAction.TAKEN_OVER, f"pid {pids[1]}"),
        (1, LockAction.LOST, f"pid {pids[2]}"),
        (1, LockAction.REFUSED, f"pid {pids[2]}"),
    ]
    waiting = next(one for one in record.events if one.action is LockAction.WAITING)
    assert waiting.time_ns <= tenures[1].to_ns
    sent = list(commands(path))
    assert len(sent) > 20
    for time_ns, sender in sent:
        owner = record.owner_at("left", time_ns)
        assert owner is not None, (time_ns, sender)
        assert owner.sender == sender, (time_ns, sender)
