"""A small part of each attack; each finds a fault planted on purpose."""

import gc
import os
import re
from functools import partial
from random import Random
from unittest.mock import ANY

import pytest

from motorhil.emulators.cia401.node import build as build_io_node
from motorhil.emulators.cia402.power_drive import PowerDrive
from motorhil.emulators.controller import ControllerContext
from motorhil.emulators.dynamixel.packets import crc16
from motorhil.harness.shared_time import records
from motorhil.harness.shared_time.participant import Participant
from motorhil.harness.shared_time.programs import _Process
from motorhil.harness.shared_time.shared_clock import SharedClock
from motorhil.harness.sharing_tests import processes
from motorhil.motorapi import Motor
from motorhil.motorapi.adaptations.cia402.motor import Cia402Motor
from motorhil.motorapi.adaptations.dryve.telegrams import DryveCodec
from motorhil.motorapi.adaptations.dynamixel import packets
from motorhil.motorapi.adaptations.dynamixel.packets import DynamixelCodec
from motorhil.motorapi.adaptations.mit.frames import Frames
from motorhil.motorapi.adaptations.mit.robstride import RobstrideFrames
from motorhil.motorapi.adaptations.moteus import motor as moteus
from motorhil.motorapi.adaptations.rmd.motor import RmdHwMotor
from motorhil.motorapi.adaptations.vesc import motor as vesc
from motorhil.motorapi.adaptations.vesc.motor import VescHwMotor
from motorhil.motorapi.locking.lock_file import LockFile, write_epoch
from tests.attack import __main__ as program
from tests.attack import controllers, damaged_files, growth, lock_kills, lying_medium
from tests.attack import recorder_kills as recorders
from tests.attack.campaign import Attack, Campaign, Done

SEED = 1
PAIRS = 5
READS_AGAIN = 164
"""The schedule that meets a takeover just before it reads its epoch again."""
UNCOMPILED = pytest.mark.pure("compiled classes cannot be broken on purpose")


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch):
    monkeypatch.setattr(controllers, "EPISODE", 1_000)


def campaign(name, first=0, count=1):
    """Return the results of a few attempts; no finding is right."""
    done = Campaign(program.attack_named(name), SEED)
    done.run(0.0, count, first)
    assert not done.findings, done.summary()
    return done


# ------------------------------------------------------------------------------------ campaigns


def test_finding_is_printed_with_its_command(capsys):
    def begin(seed):
        def attempt(number):
            assert number % 3, f"{number} of seed {seed}"
            return Done(1, b"%d" % number)

        return attempt

    done = Campaign(Attack("threes", "numbers", begin), 7)
    done.run(0.0, 10)
    assert done.findings == {"AssertionError: N of seed N": 0}
    out = capsys.readouterr().out
    assert out.count("FAILED") == 1
    assert "again: python -m tests.attack threes --seed 7 --first 0 --count 1" in out
    assert "7: 10 numbers in 10 attempts" in done.summary()


@pytest.mark.parametrize("count", ["0", "1"])
def test_command_line_runs_named_attack(count, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["attack", "frames", "--count", count])
    assert program.main() == 0
    assert "frames: seed 1: " in capsys.readouterr().out


def test_unknown_attack_is_refused_with_known_names(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["attack", "fames"])
    with pytest.raises(SystemExit, match="2"):
        program.main()
    assert "expected drive, frames, lies" in capsys.readouterr().err


# --------------------------------------------------------------------------------------- frames


def test_every_kind_of_controller_survives_frames_twice_alike():
    kinds = len(controllers.KINDS)
    done = campaign("frames", count=kinds * controllers.EPISODE)
    assert sum("inputs" in name for name in done.reached) == kinds
    assert all(done.reached[name] for name in done.reached if "answers" in name)
    assert done.digest() == campaign("frames", count=kinds * controllers.EPISODE).digest()


class Faulty:
    """An I/O node with a fault after 50 frames."""

    def __init__(self, fault):
        context = ControllerContext("it", controllers.GOLDEN, 1)
        self._node = build_io_node({"node_id": controllers.NODE}, context)
        self._fault = fault
        self._count = 0
        self.od = self._node.od

    def __getattr__(self, name):
        return getattr(self._node, name)

    def receive(self, data, now_ns):
        self._count += 1
        if self._count > 50 and self._fault == "raises":
            raise IndexError("a node that cannot count")
        self._node.receive(data, now_ns)

    def next_deadline_ns(self):
        is_past = self._count > 50 and self._fault == "asks for the past"
        return 1 if is_past else self._node.next_deadline_ns()

    def take_output(self):
        frames = self._node.take_output()
        if self._count > 50 and self._fault == "floods":
            return [bytes(16)]
        return [] if self._count > 50 and self._fault == "falls silent" else frames


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        ("raises", "cannot count"),
        ("asks for the past", "is before now"),
        ("floods", "more than 300 frames"),
        ("falls silent", "0 answers"),
    ],
)
def test_faulty_controller_is_found(fault, told):
    with pytest.raises((IndexError, AssertionError), match=told):
        controllers.attack_node(partial(Faulty, fault), "1:0")


@UNCOMPILED
def test_forbidden_state_of_a_drive_is_found_and_reduced(monkeypatch, tmp_path, capsys):
    assert campaign("drive").reached["transition 4"]
    good = PowerDrive._write_controlword

    def enables_by_a_reset_word(drive, word, now_ns):
        good(drive, word, now_ns)
        if word == 0x80:
            good(drive, 0x06, now_ns)

    monkeypatch.setattr(PowerDrive, "_write_controlword", enables_by_a_reset_word)
    monkeypatch.setattr(controllers, "OUT", tmp_path)
    done = Campaign(program.attack_named("drive"), SEED)
    done.run(0.0, 1)
    assert any("forbidden" in finding for finding in done.findings)
    assert "--again" in capsys.readouterr().out
    (kept,) = tmp_path.iterdir()
    assert len(kept.read_text().splitlines()) <= 12


# ----------------------------------------------------------------------------------------- lies


def test_hosts_of_every_kind_are_never_silently_wrong(monkeypatch):
    monkeypatch.setattr(lying_medium, "RUNS", 2)
    done = campaign("lies", count=2 * len(lying_medium.kinds()))
    assert all(done.reached[name] for name in lying_medium.kinds())
    assert done.reached["position returned"]


def of_any_motor(answer):
    """Return an answer that checks the number of no motor."""

    def checked(self, can_id, data):
        number = bytes(one & 0xF0 | self.node_id for one in data[:1])
        return answer(self, can_id, number + data[1:])

    return checked


def of_any_length(answer):
    """Return a function of data that are filled up to eight bytes."""
    return lambda self, *more: answer(
        self, *(one.ljust(8, b"\0") if isinstance(one, bytes) else one for one in more)
    )


def of_any_host(answers):
    return lambda self: (*answers(self), *(can_id ^ 3 for can_id in answers(self)))


def of_any_command(on_answer):
    """Return a reader that takes unknown commands for an angle."""
    known = b"\x42\x43\x70\x92\x9a\x9c\x80\x81\xa1\xa2\xa4\xf1"
    return lambda self, data, time_ns: on_answer(
        self, data if data[:1] in known else b"\x92" + data[1:], time_ns
    )


def of_any_node(on_answer):
    return lambda self, data, time_ns: on_answer(self, bytes((self.node_id,)) + data[1:], time_ns)


def with_any_crc(status_in):
    def repaired(packet, unit):
        end = 5 + int.from_bytes(packet[5:7], "little")
        return status_in(packet[:end] + crc16(packet[:end]) + packet[end + 2 :], unit)

    return repaired


def of_one_header(answers):
    """Return a check that knows no answer of another header."""

    def checked(self, answer, request):
        if not answers(self, answer, request):
            raise KeyError("another header")
        return True

    return checked


def instead(value):
    return lambda _: value


@UNCOMPILED
@pytest.mark.parametrize(
    ("kind", "attempt", "owner", "name", "plant", "told"),
    [
        ("cia402", 0, Cia402Motor, "_read_position", instead(lambda motor: 0.5), "position N"),
        ("cia402", 1, Cia402Motor, "_read_velocity", instead(lambda motor: 1.5), "velocity N"),
        ("cia402", 0, Motor, "wait_until_done", instead(lambda *_: None), "done at N"),
        ("cia402", 0, Motor, "fault", instead(lambda motor: {}["a bug"]), "a bug"),
        ("mit", 1, Frames, "answer", of_any_motor, "latest position"),
        ("mit", 2, Frames, "answer", of_any_length, "latest position"),
        ("robstride", 0, RobstrideFrames, "answers", of_any_host, "latest position"),
        ("robstride", 0, RobstrideFrames, "answer", of_any_length, "latest position"),
        ("moteus", 1, moteus, "_HEADS", instead(ANY), "position"),
        ("rmd", 3, RmdHwMotor, "_on_answer", of_any_length, "latest position"),
        ("rmd", 1, RmdHwMotor, "_on_answer", of_any_command, "position"),
        ("vesc", 3, vesc, "_VERSION_BYTES", instead(0), "index out of range"),
        ("vesc", 3, VescHwMotor, "_on_answer", of_any_node, "fault Nh"),
        ("vesc", 5, VescHwMotor, "_on_status", of_any_length, "latest velocity"),
        ("dynamixel", 53, packets, "_status_in", with_any_crc, "position"),
        ("dynamixel", 36, DynamixelCodec, "answers", instead(lambda *_: True), "IndexError"),
        ("dryve", 277, DryveCodec, "answers", of_one_header, "another header"),
    ],
)
def test_wrong_host_is_found(kind, attempt, owner, name, plant, told, monkeypatch):
    monkeypatch.setattr(lying_medium, "RUNS", 1)
    monkeypatch.setattr(owner, name, plant(getattr(owner, name)))
    one = lambda seed: lambda number: lying_medium.attack(kind, f"{seed}:{number}")  # noqa: E731
    done = Campaign(Attack("lies", "runs", one), SEED)
    done.run(0.0, 1, attempt)
    assert any(told in finding for finding in done.findings), done.findings


def _made(name):
    """Return a controller of this kind."""
    attack = controllers.KINDS[name]
    build = attack.args[0]
    if isinstance(build, controllers.Kind):
        return build.build(Random(SEED))
    return build(Random(SEED)) if attack.func is controllers.attack_gateway else build()


@pytest.mark.parametrize("name", sorted(controllers.KINDS))
def test_controller_that_starts_late_asks_for_no_call_in_the_past(name):
    bare = controllers.Bare(_made(name))
    bare.now_ns = 5 * 10**9
    bare.replace(_made(name))
    bare.run(2 * 10**9)


# ---------------------------------------------------------------------------------------- files


@pytest.mark.wall
def test_damaged_files_are_read_or_refused_in_time():
    done = Campaign(Attack("files", "files", partial(damaged_files.begin, files=1)), SEED)
    done.run(0.0, 20)
    assert not done.findings, done.findings
    assert {"rig", "eds", "limits", "lock", "mcap of cia402", "candump", "blf"} <= set(done.reached)
    assert sum(done.reached[name] for name in done.reached if "exit status" in name) == 20


@pytest.mark.parametrize(("is_text", "large"), [(False, False), (True, True)])
def test_only_texts_grow_large(is_text, large):
    whole = damaged_files.Original(bytes(range(250)) * 4, "it.blf", (), is_text)
    sizes = [len(damaged_files.damage(whole, Random(number))) for number in range(300)]
    assert (max(sizes) > 30_000) == large
    assert max(sizes) <= 1_000_000


def _takes_memory(words):
    return len(bytearray(400 << 20)) and 0


def _takes_time(words):
    while True:
        pass


def _raises(words):
    raise LookupError("a bug of the verb")


def _raises_late(words):
    while sum(os.times()[:2]) < 1.3:
        pass
    _raises(words)


@pytest.mark.wall
@pytest.mark.parametrize(
    ("verb", "told"),
    [
        (_raises, "traceback: LookupError: a bug of the verb"),
        (_raises_late, "traceback: LookupError: a bug of the verb, took"),
        (_takes_memory, "MB"),
        (_takes_time, "of processor time"),
        (lambda words: 9, "exit status 9"),
    ],
)
def test_faulty_verb_is_found(verb, told, monkeypatch, tmp_path):
    monkeypatch.setattr(damaged_files, "main", verb)
    monkeypatch.setattr(damaged_files, "SECONDS_MAX", 1)
    with pytest.raises(AssertionError, match=told):
        damaged_files.use(("check", "rig.toml"), tmp_path)


# ------------------------------------------------------------------------- locks and recordings


@pytest.mark.wall
def test_lock_survives_kills_of_its_holders(tmp_path):
    done = lock_kills.attack(lock_kills.plan_of(f"{SEED}:0", seconds=0.5), tmp_path / "history")
    assert not list(tmp_path.iterdir())
    assert done.reached["killed"] + done.reached["paused"] == done.count
    assert done.reached["take: done"]


@pytest.mark.wall
def test_lock_open_to_everybody_is_found(monkeypatch, tmp_path, capsys):
    opened = partial(lock_kills.plan_of, seconds=0.5, plant=f"{__name__}:open_locks")
    monkeypatch.setattr(lock_kills, "plan_of", opened)
    monkeypatch.setattr("sys.argv", ["attack", "locks", "--count", "1", "--keep", str(tmp_path)])
    assert program.main() == 1
    (kept,) = tmp_path.iterdir()
    out = capsys.readouterr().out
    assert f"sharing_tests.processes {kept}" in out
    monkeypatch.setattr("sys.argv", ["processes", str(kept)])
    assert processes.main() == 1
    again = capsys.readouterr().out
    assert out.partition("FAILED: ")[2].splitlines()[0].rpartition("SharingViolated: ")[2] in again


@pytest.mark.wall
def test_sound_history_of_kills_stays_sound_in_its_file(monkeypatch, tmp_path, capsys):
    outcome = processes.run(lock_kills.plan_of("82:4", seconds=0.5))
    outcome.save(tmp_path / "history")
    assert processes.Outcome.load(tmp_path / "history") == outcome
    monkeypatch.setattr("sys.argv", ["processes", str(tmp_path / "history")])
    assert processes.main() == 0


def open_locks(folder):
    """Give each worker of the arena its own lock folder."""

    from motorhil.harness.sharing_tests import workers

    own = folder / f"locks-{os.getpid()}"
    own.mkdir(mode=0o700)
    directory = workers.LockDirectory
    workers.LockDirectory = lambda path: directory(own)


def test_lock_survives_schedules_of_system_calls_twice_alike():
    done = campaign("schedules", count=60)
    events = (
        "killed",
        "stopped",
        "file removed",
        "command: lost",
        "take: done from a living owner",
    )
    assert all(done.reached[name] for name in events)
    assert done.digest() == campaign("schedules", count=60).digest()


@UNCOMPILED
def test_takeover_that_reads_its_epoch_again_is_found(monkeypatch):
    """Two takeovers, the second from the first one before it has read: both own the lock."""

    def advance(file, epoch, base):
        write_epoch(file.fd, epoch, base)
        file.look_up()

    monkeypatch.setattr(LockFile, "advance", advance)
    done = Campaign(program.attack_named("schedules"), SEED)
    done.run(0.0, 1, first=READS_AGAIN)
    assert any("SharingViolated" in finding for finding in done.findings), done.findings


@pytest.mark.wall
def test_killed_and_full_recorders_lose_one_second():
    done = campaign("recordings", count=6)
    assert done.reached["killed"]
    assert done.reached["full disk"]
    assert done.reached["recovered"] >= 4


@pytest.mark.wall
def test_recorder_that_holds_back_or_loses_frames_is_found(tmp_path, monkeypatch):
    path = tmp_path / "it.mcap"
    monkeypatch.setattr(recorders, "_END_S", 2)
    recorders.ended(recorders.record_bus, path, None, 1 << 30)
    assert recorders.require_recovered(path, 2_000_000_000, True)["frames"]
    with pytest.raises(AssertionError, match="s lost of 3"):
        recorders.require_recovered(path, 3_100_000_000, True)
    monkeypatch.setattr(recorders, "_FRAME_NS", 5_000_000)
    with pytest.raises(AssertionError, match="wrong times"):
        recorders.require_recovered(path, 2_000_000_000, True)


# ---------------------------------------------------------------------------------------- pairs


@pytest.mark.wall
def test_pairs_of_programs_make_the_record_of_parties():
    done = campaign("pairs", count=PAIRS)
    assert done.reached["forked"]
    assert done.reached["died by SIGKILL"] + done.reached["died by SIGTERM"]
    assert done.reached["step moved"]


def with_names_reversed(await_programs):
    return lambda clock, names, is_alive: await_programs(clock, names[::-1], is_alive)


def without_a_reason(departed):
    return lambda clock, participant, reason: departed(clock, participant, "")


def with_late_deadlines(wait):
    def late(participant, record):
        *facts, deadline_ns = records.WAITING.unpack(record)
        later_ns = deadline_ns + (deadline_ns >= 0)
        wait(participant, records.WAITING.pack(*facts, later_ns))

    return late


def without_a_choice(wait):
    return lambda participant, number, asks, is_deaf: wait(participant, number, False, is_deaf)


@pytest.mark.wall
@pytest.mark.parametrize(
    ("attempt", "owner", "name", "plant", "told"),
    [
        (2, SharedClock, "await_programs", with_names_reversed, "the model has"),
        (5, SharedClock, "departed", without_a_reason, "expected"),
        (2, Participant, "_wait", with_late_deadlines, "the model has"),
        (3, Participant, "_holds", without_a_choice, "the model has"),
        (14, _Process, "await_end", instead(lambda process: None), "expected|the model has"),
    ],
    ids=["ties", "not told", "1 ns late", "no look", "lock kept"],
)
def test_fault_of_the_shared_clock_is_found(attempt, owner, name, plant, told, monkeypatch):
    monkeypatch.setattr(owner, name, plant(getattr(owner, name)))
    done = Campaign(program.attack_named("pairs"), SEED)
    done.run(0.0, 1, attempt)
    assert any(re.search(told, finding) for finding in done.findings), done.findings


# --------------------------------------------------------------------------------------- growth


def objects():
    """Return the number of objects in thousands, without garbage."""
    gc.collect()
    return len(gc.get_objects()) / 1000


def test_recorded_minutes_leave_no_objects():
    attempt = growth.begin_hours(SEED)
    seen = growth.Growth("steps", 1.0, objects)
    for number in range(4):
        attempt(number)
        if number:
            seen.note(number)


def test_closed_rigs_leave_no_objects():
    seen = growth.Growth("rigs", 1.0, objects)
    for number in range(30):
        growth.open_and_close(number, SEED)
        if number % 10 == 9:
            seen.note(number)


def test_growth_beyond_the_bound_is_found(capsys):
    kept = []
    seen = growth.Growth("steps", 10.0, lambda: 100.0 + len(kept))
    for number in range(11):
        kept.append(number)
        seen.note(number)
    kept.append(11)
    with pytest.raises(AssertionError, match="grew by more than 10 MB"):
        seen.note(11)
    assert "+10.0" in capsys.readouterr().out
