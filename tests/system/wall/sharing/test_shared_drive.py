"""One drive on a hub, commanded by several unrelated processes."""

import json
import os
import re
import subprocess

import pytest

from motorhil.harness.rig.config.scaffold import EXAMPLES
from motorhil.motorapi.locking.directory import VARIABLE, LockDirectory
from motorhil.motorapi.locking.lock_status import list_locks
from tests.support.line_programs import Program
from tests.support.served_hub import SERVE, served, wait_for

pytestmark = pytest.mark.wall

MODEL = EXAMPLES / "wheel_model.toml"


@pytest.fixture
def hub(tmp_path):
    """Return the path of a hub that serves two wheels."""
    with served(EXAMPLES / "two_wheels.toml", tmp_path / "hub") as path:
        yield path


@pytest.fixture
def programs(hub, folder):
    """Start programs on the hub; end all of them afterwards."""
    started = []

    def start(*names, channel=None):
        new = []
        for name in names:
            env = {**os.environ, VARIABLE: str(folder)}
            new.append(Program("shared_drive", channel or hub, MODEL, name, env=env))
            started.append(new[-1])
        for program in new:
            assert program.hear() == "ready"
        return new if len(new) > 1 else new[0]

    yield start
    for program in started:
        program.end()


@pytest.fixture
def views(folder):
    """Return the locks of the drive and of its SDO channel, as any process sees them."""
    return lambda: list_locks(LockDirectory(folder))


def waiters(views):
    return [one.record.pid for _, one in views()[0].waiters if one.record is not None]


def test_motion_excludes_others_until_it_is_over(programs, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("move 3") == "started"
    refused = drive.ask("move -1")
    assert re.match(
        rf"busy drive is held by pid {mast.pid} \(shared_drive.py\)"
        r" for start\(\) of mast since 20..-.*UTC \(\d+\.\d s ago\)",
        refused,
    )
    assert drive.ask("position").startswith("at ")  # reading needs no ownership
    assert mast.ask("wait") == "done"
    assert views()[0].holder is None  # released by the event that ended it
    assert drive.ask("move -1") == "started"
    assert drive.ask("wait") == "done"
    assert drive.ask("position") == "at 2.000"


def test_reading_and_stopping_wait_for_the_owner_to_set_up(programs):
    owner, reader, stopper = programs("owner", "reader", "stopper")
    assert owner.ask("reserve survey") == "reserved"  # nobody has set the drive up yet
    reader.say("position")
    stopper.say("stop")
    assert not owner.ask("run 1.0").startswith("busy ")  # the stop may come during the start
    assert reader.hear().startswith("at ")
    assert stopper.hear() == "stopped"


def test_unawaited_homing_is_released_at_its_end(programs, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("move 0.2") == "started"
    assert mast.ask("wait") == "done"
    assert mast.ask("home") == "begun"
    wait_for(lambda: views()[0].holder is None)
    assert drive.ask("position") == "at 0.000"
    assert drive.ask("move 0.1") == "started"


def test_unawaited_motion_is_released_at_its_end(programs, views):
    mast = programs("mast")
    assert mast.ask("move 0.2") == "started"
    wait_for(lambda: views()[0].holder is None)
    assert mast.ask("position") == "at 0.200"


def test_waiting_programs_are_served_in_order(programs, views):
    first, second, third = programs("first", "second", "third")
    assert first.ask("reserve survey") == "reserved"
    second.say("move 0.1 60")
    wait_for(lambda: waiters(views) == [second.pid])
    third.say("move 0.1 60")
    wait_for(lambda: waiters(views) == [second.pid, third.pid])
    for _ in range(2):  # several motions in one reservation
        assert first.ask("move 0.5") == "started"
        assert first.ask("wait") == "done"
    assert first.ask("position") == "at 1.000"
    assert first.ask("release") == "released"
    assert second.hear() == "started"
    assert second.ask("wait") == "done"
    assert third.hear() == "started"
    assert third.ask("wait") == "done"
    assert third.ask("position") == "at 1.200"


def test_list_motors_shows_owners_and_waiting_programs(programs, hub, folder, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("reserve survey") == "reserved"
    drive.say("move 0.5 60")
    wait_for(lambda: waiters(views) == [drive.pid])

    def listed(*words):
        env = {**os.environ, VARIABLE: str(folder)}
        command = [*SERVE, "list", "motors", *words]
        return subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout

    first, second = listed().splitlines()
    name, _, holder = first.partition(" pid ")
    assert name.strip() == f"{hub} node 1"
    assert holder.startswith(
        f"{mast.pid} (shared_drive.py) for survey (reserve() of mast), since 20"
    )
    assert second.strip().startswith(f"waits (1): pid {drive.pid} (shared_drive.py) for start() of")
    (motor,) = json.loads(listed("--json"))
    assert motor["holder"]["pid"] == mast.pid
    assert [one["pid"] for one in motor["waiters"]] == [drive.pid]
    mast.kill()
    drive.kill()
    assert listed().split(None, 3)[3].strip() == "free; its last owner died while it had it"


def test_reservation_shows_its_purpose_and_ends_with_process(programs, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("reserve survey") == "reserved"
    assert "for survey (reserve() of mast) since" in drive.ask("move 1")
    assert "for survey (reserve() of mast) since" in drive.ask("reserve lunch")
    assert "for survey (reserve() of mast) since" in drive.ask("low_level")
    assert drive.ask("reserve lunch 0.05").startswith("busy drive is held by pid ")
    drive.say("move 0.5 60")
    wait_for(lambda: waiters(views) == [drive.pid])
    mast.kill()
    assert drive.hear() == "started"
    assert drive.ask("wait") == "done"


def test_velocity_is_kept_until_stopped_by_any_program(programs, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("run 1.0") == "started"
    assert mast.ask("wait") == "done"  # reached
    assert drive.ask("move 1").startswith("busy drive is held by pid ")
    assert drive.ask("stop") == "stopped"
    assert drive.ask("wait") == "done"
    mast.ask("stop")  # its own: it has noticed the stop by now, or does so here
    mast.ask("wait")
    wait_for(lambda: views()[0].holder is None)
    assert drive.ask("move 0.1") == "started"
    assert drive.ask("wait") == "done"


@pytest.mark.parametrize("motion", ["move 20", "run 3"])
def test_motion_stopped_by_another_is_reported_and_resumable(programs, views, motion):
    mast, drive = programs("mast", "drive")
    assert drive.ask("position").startswith("at ")
    assert mast.ask(motion) == "started"
    assert drive.ask("stop") == "stopped"
    told = "failed mast: the motion was ended by another program, which told the drive to stop"
    assert mast.ask("wait").startswith(f"{told} (controlword 010Fh) at ")
    assert drive.ask("wait") == "done"
    wait_for(lambda: views()[0].holder is None)  # it does not move
    assert mast.ask("move 0.1") == "started"
    assert mast.ask("wait") == "done"


def test_own_stop_beside_a_foreign_one_is_no_interruption(programs):
    mast, drive = programs("mast", "drive")
    assert drive.ask("position").startswith("at ")
    assert mast.ask("run 3") == "started"
    mast.say("stop")
    drive.say("stop")
    assert (mast.hear(), drive.hear()) == ("stopped", "stopped")
    assert (mast.ask("wait"), drive.ask("wait")) == ("done", "done")


def test_drive_moving_for_a_killed_process_is_halted(programs, views):
    mast, drive = programs("mast", "drive")
    assert drive.ask("position") == "at 0.000"
    assert mast.ask("run 1.0") == "started"
    assert mast.ask("wait") == "done"
    mast.kill()
    positions = []

    def stands():  # checked every 10 ms, or less often
        positions.append(drive.ask("position"))
        return len(positions) > 50 and len(set(positions[-50:])) == 1

    wait_for(stands)
    assert views()[0].holder is None
    assert views()[0].abandoned
    assert drive.ask("run 0.5") == "started"
    assert drive.ask("wait") == "done"
    assert drive.ask("stop") == "stopped"
    assert drive.ask("wait") == "done"
    assert not views()[0].abandoned


def test_drive_left_moving_is_stopped_before_its_next_command(programs):
    mast, drive = programs("mast", "drive")
    assert mast.ask("run 2.0") == "started"
    assert mast.ask("wait") == "done"
    drive.say("move 0.5 60")
    mast.kill()
    assert drive.hear() == "started"
    assert drive.ask("began").startswith("began at rest"), "it was planned while it moved"
    assert drive.ask("wait") == "done"


def test_low_level_access_keeps_other_processes_out(programs):
    mast, drive = programs("mast", "drive")
    assert mast.ask("low_level") == "alone"
    assert "for low-level access (low_level() of mast) since" in drive.ask("move 1")
    assert mast.ask("release") == "released"
    assert drive.ask("move 0.1") == "started"
    assert drive.ask("wait") == "done"


def test_written_values_of_another_process_are_not_believed(programs):
    soft, hard = programs("soft", "hard")
    assert soft.ask("gain 60000") == "set"
    assert hard.ask("gain 50000") == "set"
    for _ in range(3):
        for program, gain in ((soft, 60000), (hard, 50000)):
            assert program.ask("move 0.1") == "started"
            assert program.ask("read 60FB 1") == f"read {gain}"
            assert program.ask("wait") == "done"


def test_own_written_values_are_believed_while_owned(programs):
    alone = programs("alone")
    alone.ask("gain 60000")
    for _ in range(2):
        assert alone.ask("move 0.1") == "started"
        assert alone.ask("wait") == "done"
    before = alone.ask("downloads")
    assert alone.ask("move 0.1") == "started"
    assert alone.ask("wait") == "done"
    after = alone.ask("downloads")
    # the target and the edge of its controlword: no profile, mode or gains
    assert int(after.split()[1]) - int(before.split()[1]) <= 3


def test_sdo_transfers_of_processes_do_not_mix(programs):
    both = programs("one", "two")
    for program in both:
        program.say("read_many 300")
    assert [program.hear() for program in both] == ["same"] * 2


def test_late_sdo_answer_blocks_requests_of_others(programs, views):
    mast, drive = programs("mast", "drive")
    assert mast.ask("read 1018 1").startswith("read ")
    assert mast.ask("impatient").startswith("failed node 1 on ")
    (channel,) = [view for view in views() if view.name.endswith("-sdo")]
    assert channel.holder.record.pid == mast.pid  # for HwOptions.sdo_quarantine_s
    assert drive.ask("read 1018 2") == mast.ask("read 1018 2")
    wait_for(lambda: all(view.holder is None for view in views()))


def test_process_killed_within_a_transfer_blocks_no_other(programs, views):
    dies, lives = programs("dies", "lives")
    dies.say("read_many 1000000")
    wait_for(lambda: any(view.holder for view in views() if view.name.endswith("-sdo")))
    dies.kill()
    assert lives.ask("read_many 50").startswith("same")
    assert lives.ask("move 0.1") == "started"


def test_drive_is_the_same_by_any_path_to_the_hub(programs, hub, tmp_path):
    (tmp_path / "link").symlink_to(hub)
    mast = programs("mast")
    drive = programs("drive", channel=f"{tmp_path}/link#can0")
    assert mast.ask("reserve survey") == "reserved"
    assert drive.ask("move 1").startswith(f"busy drive is held by pid {mast.pid} ")


def test_reading_does_not_disturb_a_moving_drive(programs, views, tmp_path):
    mast = programs("mast")
    assert mast.ask("run 0.5") == "started"
    other = programs("other:50")  # it would make the drive send its status less often
    refused = other.ask("position")
    assert refused.startswith(f"busy {tmp_path}/hub node 1 is held by pid {mast.pid} "), refused
    late = programs("late")  # it joins while the other moves
    assert late.ask("position").startswith("at ")
    assert late.ask("downloads") == "wrote 0"
    assert late.ask("read 1018 1").startswith("read ")
    assert mast.ask("read 1800 5") == "read 20"
    assert mast.ask("wait") == "done"
    assert mast.ask("stop") == "stopped"
    assert mast.ask("wait") == "done"
    wait_for(lambda: views()[0].holder is None)
    assert other.ask("position").startswith("at ")  # now it may set the drive up
    assert mast.ask("read 1800 5") == "read 50"
    assert mast.ask("move 0.1") == "started"  # and so may this one, which reads them
    assert mast.ask("read 1800 5") == "read 20"
