"""Damaged files of every format, through every verb of the command line that reads them.

Each use must end within 5 s of processor time and 300 MB, without a traceback, with a documented
exit status. A file is at most 1 MB large, since a long recording rightly takes longer.

An attempt has several files made from one original, each with a use, which its number draws.
One forked child makes them all, for a child costs more than most uses. If one of them may have done
wrong, each is repeated in a child of its own, and judged there. Most recordings are short, so that
damage meets every part of them; some are whole golden ones.
"""

import contextlib
import gc
import io
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Final, final

import zstandard

from motorhil import emulators
from motorhil.harness.cli.main import FAILED, NOT_JUDGED, PASSED, WRONG_USAGE, main
from motorhil.harness.recording.conversion import MODBUS_PCAPNG
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode
from motorhil.motorapi.locking.directory import VARIABLE, LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime
from motorhil.traces.formats.registry import WRITABLE
from motorhil.traces.mcap.records import MAGIC
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.checkout import CHECKOUT
from tests.support.golden import described
from tests.support.motors.kinds import BUS, EVERY, MODEL
from tests.support.recordings.formats import IS_THERE

SECONDS_MAX: Final = 5
MEGABYTES_MAX: Final = 300
DOCUMENTED: Final = (PASSED, FAILED, WRONG_USAGE, NOT_JUDGED)
GOLDEN: Final = CHECKOUT / "traces" / "golden"
EDS: Final = Path(emulators.__file__).parent / "eds" / "motorhil_cia402.eds"
_ADDRESS_SPACE: Final = 3 << 30
_PATIENCE_S: Final = 300
_BOMB: Final = 256 << 20
_TRACEBACK: Final = re.compile(r"Traceback \(most recent call last\)")
_BROKEN: Final = 99
AT_ONCE: Final = 40
"""Number of files of an attempt."""
_LONG: Final = 0.02
"""Share of the attempts with long recordings."""
AT_ONCE_LONG: Final = 5
_SIZE_MAX: Final = 1_000_000
RECORDINGS: Final = ("cia402", "leadshine_tcp")
_SCRIPT: Final = "import time\ntime.sleep(0.01)\n"

RECORDED: Final = (
    ("show", "{}"),
    ("show", "{}", "--json", "--last", "0.5"),
    ("diff", "{}", "whole"),
    ("diff", "whole", "{}", "--exact"),
    ("judge", "{}"),
    ("report", "{}", "-o", "page.html"),
    ("recover", "{}", "-o", "recovered.mcap", "--force"),
    ("analyse", "{}", "--bitrate", "can0=1M", "--queue", "priority"),
    ("run", "{}", "script.py"),
    ("replay", "{}", "script.py", "--as", "device"),
    ("replay", "{}", "--as", "host", "--rig", "rig.toml"),
    ("replay", "{}", "--as", "traffic", "--on", "can0", "--rig", "rig.toml"),
    *(("convert", "{}", "-o", f"to{one.ending}", "--to", one.name, "--force") for one in WRITABLE),
    ("convert", "{}", "-o", "to.mcap", "--force"),
    ("convert", "{}", "-o", "to.pcapng", "--to", MODBUS_PCAPNG, "--force"),
)
RIG: Final = (
    ("check", "rig.toml"),
    ("check", "rig.toml", "--json"),
    ("run", "rig.toml", "script.py"),
    ("run", "rig.toml", "script.py", "-o", "run.mcap"),
    ("analyse", "rig.toml"),
    ("judge", "whole", "--rig", "rig.toml"),
)


@final
@dataclass(frozen=True)
class Original:
    """A file that is damaged, and its uses.

    Attributes:
        data: the whole file.
        file: its name in the folder of a use; "{}" in a use stands for it.
        uses: command lines.
        is_text: damage it as text, too.
        is_long: it takes long; fewer attempts have it.
    """

    data: bytes
    file: str
    uses: tuple[tuple[str, ...], ...]
    is_text: bool = False
    is_long: bool = False

    def filled(self) -> list[tuple[str, ...]]:
        """Return the uses with the file's name."""
        return [tuple(word.format(self.file) for word in words) for words in self.uses]


@final
@dataclass(frozen=True)
class Use:
    """A command line, and the folder in which it is obeyed."""

    folder: Path
    words: tuple[str, ...]


def _rig_text() -> str:
    one = EVERY["cia402"].rig().replace("[motor.left.model]\n" + MODEL, "", 1)
    drive = 'plant = { preset = "wheel_60w" }\n'
    one = one.replace(drive, f'eds = "drive.eds"\nobjects = {{ "6085h" = 1000 }}\n{drive}', 1)
    fault = '[[fault]]\nbus = "can0"\nname = "f"\nkind = "drop"\nfrom_s = 1.0\nuntil_s = 1.01\n'
    motor = 'controller = "left"\n'
    one = one.replace(BUS, BUS + fault)
    return one.replace(motor, f'{motor}model = "model.toml"\n', 1)


def _lock(folder: Path) -> bytes:
    """Return a lock file that two owners have used."""
    lock = ProcessLock("pan", "the pan", LockDirectory(folder))
    runtime = WallRuntime()
    with lock.acquire(runtime, "a"), lock.acquire(runtime, "b", owner=object(), take_over=True):
        (path,) = folder.iterdir()
        return path.read_bytes()


def _short(name: str, path: Path) -> Path:
    """Record the rig of a golden recording for a moment, and return the path."""
    with Rig(described(name), record=path) as rig:
        left = rig.motors["left"]
        left.set_control_mode(ControlMode.SETPOINT)
        left.set_setpoint(0.1)
        left.start()
        rig.runtime.run_for(0.01)
    return path


@final
class Folder:
    """The whole files, and a folder in which every use begins anew."""

    def __init__(self) -> None:
        self._keep = tempfile.TemporaryDirectory(prefix="motorhil-attack-")
        self.path = Path(self._keep.name)
        weakref.finalize(self, self._keep.cleanup)
        recordings = {name: _short(name, self.path / f"{name}.mcap") for name in RECORDINGS}
        self.whole = {
            "rig.toml": _rig_text().encode(),
            "model.toml": MODEL.encode(),
            "drive.eds": EDS.read_bytes(),
            "script.py": _SCRIPT.encode(),
            "whole": recordings["cia402"].read_bytes(),
        }
        self.originals = self._originals(recordings)

    def _originals(self, short: Mapping[str, Path]) -> dict[str, Original]:
        texts = self.whole
        found = {
            "rig": Original(texts["rig.toml"], "rig.toml", RIG, is_text=True),
            "model": Original(texts["model.toml"], "model.toml", RIG, is_text=True),
            "eds": Original(texts["drive.eds"], "drive.eds", RIG, is_text=True),
            "dcf": Original(_dcf(texts["drive.eds"]), "drive.eds", RIG, is_text=True),
            "limits": Original(
                b"[motor.left]\nposition_min_rad = -1.0\nvelocity_rad_s = 2.0\n",
                "limits.toml",
                (("judge", "whole", "--limits", "limits.toml"),),
                is_text=True,
            ),
        }
        locks = self.path / "locks-before"
        locks.mkdir(mode=0o700)
        found["lock"] = Original(
            _lock(locks), "locks/pan", (("list", "motors"), ("list", "motors", "--json"))
        )
        long = {name: GOLDEN / f"{name}.mcap" for name in RECORDINGS}
        found |= self._recorded("long ", long, is_long=True)
        return found | self._recorded("", short, is_long=False)

    def _recorded(self, long: str, of: Mapping[str, Path], is_long: bool) -> dict[str, Original]:
        """Return the recordings, and the first of them in all formats."""
        found = {}
        for name, path in of.items():
            found[f"{long}mcap of {name}"] = Original(
                path.read_bytes(), "it.mcap", RECORDED, is_long=is_long
            )
        forms = {one.name: one.ending for one in WRITABLE if IS_THERE[one.name]}
        for form, ending in (*forms.items(), (MODBUS_PCAPNG, ".pcapng")):
            path = self.path / f"{long}whole{ending}"
            source = of[RECORDINGS[form == MODBUS_PCAPNG]]
            _quietly("convert", str(source), "-o", str(path), "--to", form, "--force")
            is_text = form not in ("blf", "pcapng", "mf4", MODBUS_PCAPNG)
            data = path.read_bytes()
            found[long + form] = Original(data, f"it{ending}", RECORDED, is_text, is_long)
        return found

    def lay_out(self, original: Original, data: bytes, name: str = "use") -> Path:
        """Return a new folder of this name with the whole files and the damaged one."""
        folder = self.path / name
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "locks").mkdir(parents=True, mode=0o700)
        (folder / "locks").chmod(0o700)
        for name, whole in self.whole.items():
            (folder / name).write_bytes(whole)
        (folder / original.file).write_bytes(data)
        (folder / original.file).chmod(0o600)
        return folder


def _quietly(*words: str) -> None:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        status = main(words)
    assert status == PASSED, f"motorhil {' '.join(words)}: exit status {status}"


def _dcf(eds: bytes) -> bytes:
    """Return the EDS as a DCF: commissioned, with a parameter value for each object."""
    text = re.sub(r"(?m)^(DefaultValue=(.*))$", r"\1\nParameterValue=\2", eds.decode())
    return f"{text}\n[DeviceComissioning]\nNodeID=1\nBaudrate=1000\n".encode()


# ------------------------------------------------------------------------------------- damage


def _flips(data: bytearray, dice: Random) -> None:
    for _ in range(dice.choice((1, 1, 3, 20))):
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)


def _cut(data: bytearray, dice: Random) -> None:
    del data[dice.randrange(len(data)) :]


def _blown_up(data: bytearray, dice: Random) -> None:
    size = dice.choice((1, 2, 4, 8))
    place = dice.randrange(len(data))
    data[place : place + size] = dice.choice((b"\xff", b"\x7f", b"\x00")) * size


def _splice(data: bytearray, dice: Random) -> None:
    begin, end = sorted((dice.randrange(len(data)), dice.randrange(len(data))))
    place = dice.randrange(len(data))
    data[place : place + dice.choice((0, end - begin))] = data[begin:end]


def _numbers(data: bytearray, dice: Random) -> None:
    """Replace a number of a text by an extreme one."""
    places = [match.span() for match in re.finditer(rb"[0-9A-Fa-f.]+", data)]
    if places:
        begin, end = dice.choice(places)
        data[begin:end] = dice.choice(
            (b"9" * 20, b"-1", b"1e999", b"nan", b"0", b"", b"0x" + b"F" * 40, b"9" * 5000, b"\xe9")
        )


def _long_line(data: bytearray, dice: Random) -> None:
    place = dice.randrange(len(data))
    data[place:place] = dice.choice((b"9", b"[", b"a.", b'"', b"{a=", b" ", b"\n")) * 200_000


def _many_lines(data: bytearray, dice: Random) -> None:
    data += bytes(data[-2000:]) * dice.choice((50, 500))


def _bomb(data: bytearray, dice: Random) -> None:
    """Append an MCAP chunk that becomes 256 MB."""
    said = dice.choice((_BOMB, 1 << 31, 1000, (1 << 63) - 1))
    packed = zstandard.ZstdCompressor().compress(bytes(_BOMB if said <= _BOMB else 1 << 20))
    body = bytes(16) + said.to_bytes(8, "little") + bytes(4) + b"\4\0\0\0zstd"
    body += len(packed).to_bytes(8, "little") + packed
    data[-8:-8] = b"\x06" + len(body).to_bytes(8, "little") + body


Kind = Callable[[bytearray, Random], None]
BINARY: Final[tuple[Kind, ...]] = (_flips, _flips, _cut, _blown_up, _blown_up, _splice, _splice)
TEXT: Final = (*BINARY, _numbers, _numbers, _numbers)
RARE: Final = 0.01


def damage(original: Original, dice: Random) -> bytes:
    """Return the file with one or a few kinds of damage."""
    data = bytearray(original.data)
    kinds, rare = (TEXT, (_long_line, _many_lines)) if original.is_text else (BINARY, BINARY)
    if data.startswith(MAGIC):
        rare = (_bomb,)
    for _ in range(dice.choice((1, 1, 2, 3))):
        dice.choice(rare if dice.random() < RARE else kinds)(data, dice)
        if not data:
            break
    return bytes(data[: max(_SIZE_MAX, len(original.data))])


# ---------------------------------------------------------------------------------------- uses


@final
@dataclass(frozen=True)
class Ran:
    """The uses of a child.

    Attributes:
        statuses: exit status of each use that has ended.
        code: exit status of the child; negative: the signal that ended it.
        took_s: processor time of the child [s].
        megabytes: its most memory.
        text: all that it has printed.
    """

    statuses: tuple[int, ...]
    code: int
    took_s: float
    megabytes: float
    text: str

    def problems(self, seconds_max: float) -> list[str]:
        """Return what is wrong; `seconds_max` bounds the processor time of all uses."""
        found = []
        if _TRACEBACK.search(self.text):
            found.append(f"traceback: {self.text.strip().splitlines()[-1][:200]}")
        if self.took_s > seconds_max:
            found.append(f"took {self.took_s:.1f} s of processor time")
        if self.megabytes > MEGABYTES_MAX:
            found.append(f"took {self.megabytes:.0f} MB")
        if self.code:
            found.append(f"exit status {self.code}")
        found += [f"exit status {one}" for one in self.statuses if one not in DOCUMENTED]
        return found


def use(words: Sequence[str], folder: Path) -> int:
    """Run the command line in a child, and return its exit status.

    Raises:
        AssertionError: it took too long or too much, left a traceback, or another exit status.
    """
    ran = run_in_child((Use(folder, tuple(words)),))
    wrong = ran.problems(SECONDS_MAX)
    if wrong:
        raise AssertionError(f"{' '.join(words)}: {', '.join(wrong)}")
    (status,) = ran.statuses
    return status


def run_in_child(uses: Sequence[Use], run: Callable[[Sequence[str]], int] | None = None) -> Ran:
    """Make the uses one after another in a child; `run` obeys one, by default `main`."""
    folder = uses[0].folder
    heard, told = folder / "heard", folder / "told"
    for path in (heard, told):
        path.write_bytes(b"")
    pid = os.fork()
    if pid == 0:
        _be_child(uses, run or main)
    killer = _Killer(pid)
    try:
        _, status, used = os.wait4(pid, 0)
    finally:
        killer.cancel()
    return Ran(
        statuses=tuple(int(line) for line in told.read_text().split()),
        code=os.waitstatus_to_exitcode(status),
        took_s=used.ru_utime + used.ru_stime,
        megabytes=used.ru_maxrss / 1024,
        text=heard.read_text(errors="replace"),
    )


@final
class _Killer:
    """An alarm that kills a child which waits for ever."""

    def __init__(self, pid: int) -> None:
        self._before = signal.signal(signal.SIGALRM, lambda *_: os.kill(pid, signal.SIGKILL))
        signal.alarm(_PATIENCE_S)

    def cancel(self) -> None:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, self._before)


def _be_child(uses: Sequence[Use], run: Callable[[Sequence[str]], int]) -> None:
    status = _BROKEN
    try:
        folder = uses[0].folder
        out = os.open(folder / "heard", os.O_WRONLY)
        null = os.open(os.devnull, os.O_RDONLY)
        for one, where in ((0, null), (1, out), (2, out)):
            os.dup2(where, one)
        sys.stdin, sys.stdout, sys.stderr = sys.__stdin__, sys.__stdout__, sys.__stderr__
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (2 * SECONDS_MAX, 2 * SECONDS_MAX))
        with (folder / "told").open("wb", buffering=0) as report:
            for one_use in uses:
                os.chdir(one_use.folder)
                os.environ[VARIABLE] = str(one_use.folder / "locks")
                report.write(b"%d\n" % run(one_use.words))
        status = 0
    except BaseException:
        traceback.print_exc(file=sys.__stderr__)
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _import_what_is_used(folder: Folder) -> None:
    """Import the modules of all uses, which children then need not import."""
    for name in ("rig", "lock", "mcap of cia402"):
        original = folder.originals[name]
        where = folder.lay_out(original, original.data)
        run_in_child([Use(where, words) for words in original.filled()], _list_modules)
        for module in (where / "modules").read_text().split():
            with contextlib.suppress(ImportError):
                import_module(module)


def _list_modules(words: Sequence[str]) -> int:
    status = main(words)
    Path("modules").write_text("\n".join(sys.modules))
    return status


def begin(seed: int, verb: str | None = None, files: int = AT_ONCE) -> Attempt:
    """Return the attempts: `files` damaged ones through a use each, or all of this verb."""
    folder = Folder()
    names = [name for name, one in folder.originals.items() if not one.is_long]
    names_long = [name for name, one in folder.originals.items() if one.is_long]
    _import_what_is_used(folder)
    gc.collect()
    gc.freeze()  # children would copy every page that their collector visits

    def drawn(original: Original, dice: Random) -> tuple[bytes, list[tuple[str, ...]]]:
        data, uses = damage(original, dice), original.filled()
        if verb is None:
            return data, [dice.choice(uses)]
        return data, [words for words in uses if words[0] == verb]

    def attempt(number: int) -> Done:
        dice = Random(f"{seed}:{number}")
        is_long = dice.random() < _LONG
        name = dice.choice(names_long) if is_long else names[number % len(names)]
        original = folder.originals[name]
        damaged = [
            drawn(original, dice) for _ in range(min(files, AT_ONCE_LONG) if is_long else files)
        ]
        uses = [
            Use(folder.lay_out(original, data, f"use {place}"), words)
            for place, (data, those) in enumerate(damaged)
            for words in those
        ]
        reached = Counter({name: len(damaged)})
        if uses:
            ran = run_in_child(uses)
            statuses = list(ran.statuses)
            if ran.problems(SECONDS_MAX):
                statuses = _one_by_one(name, folder, original, damaged)
            for one, status in zip(uses, statuses, strict=True):
                reached[f"{name}: {one.words[0]}"] += 1
                reached[f"{one.words[0]}: exit status {status}"] += 1
        return Done(len(damaged), repr(sorted(reached.items())).encode(), reached)

    return attempt


def _one_by_one(
    name: str,
    folder: Folder,
    original: Original,
    files: Iterable[tuple[bytes, Sequence[tuple[str, ...]]]],
) -> list[int]:
    """Return the exit statuses of the uses, each in a child and a folder of its own.

    Raises:
        AssertionError: one of them did wrong.
    """
    statuses, wrong = [], []
    for data, uses in files:
        for words in uses:
            try:
                statuses.append(use(words, folder.lay_out(original, data)))
            except AssertionError as error:
                wrong.append(f"{name}: {error}")
    if wrong:
        raise AssertionError("; ".join(wrong))
    return statuses


FILES: Final = Attack("files", "files", begin)


def files_through(verb: str) -> Attack:
    """Return the attack with this verb only; an attempt has the same file as without."""
    return Attack("files", "files", partial(begin, verb=verb), f"--verb {verb} ")
