"""Damaged files of every format, through every verb of the command line that reads them.

Each use runs in a forked child: it must end within 5 s of processor time and 300 MB, without a
traceback, with a documented exit status.
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
from collections.abc import Callable
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
from motorhil.motorapi.locking.directory import VARIABLE, LockDirectory
from motorhil.motorapi.locking.process_lock import ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime
from motorhil.traces.formats.registry import WRITABLE
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.checkout import CHECKOUT
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
    """

    data: bytes
    file: str
    uses: tuple[tuple[str, ...], ...]
    is_text: bool = False


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


@final
class Folder:
    """The whole files, and a folder in which every use begins anew."""

    def __init__(self) -> None:
        self._keep = tempfile.TemporaryDirectory(prefix="motorhil-attack-")
        self.path = Path(self._keep.name)
        weakref.finalize(self, self._keep.cleanup)
        self.whole = {
            "rig.toml": _rig_text().encode(),
            "model.toml": MODEL.encode(),
            "drive.eds": EDS.read_bytes(),
            "script.py": _SCRIPT.encode(),
            "whole": (GOLDEN / "cia402.mcap").read_bytes(),
        }
        self.originals = self._originals()

    def _originals(self) -> dict[str, Original]:
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
        for name in ("cia402", "leadshine_tcp"):
            data = (GOLDEN / f"{name}.mcap").read_bytes()
            found[f"mcap of {name}"] = Original(data, "it.mcap", RECORDED)
        for form in (one for one in WRITABLE if IS_THERE[one.name]):
            path = self.path / f"whole{form.ending}"
            _quietly("convert", str(GOLDEN / "cia402.mcap"), "-o", str(path), "--to", form.name)
            is_text = form.name not in ("blf", "pcapng", "mf4")
            found[form.name] = Original(path.read_bytes(), f"it{form.ending}", RECORDED, is_text)
        path = self.path / "modbus.pcapng"
        source = str(GOLDEN / "leadshine_tcp.mcap")
        _quietly("convert", source, "-o", str(path), "--to", MODBUS_PCAPNG)
        found[MODBUS_PCAPNG] = Original(path.read_bytes(), "it.pcapng", RECORDED)
        return found

    def lay_out(self, original: Original, data: bytes) -> Path:
        """Return a new folder with the whole files and the damaged one."""
        folder = self.path / "use"
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


def _bomb(data: bytearray, dice: Random) -> None:
    """Append an MCAP chunk that becomes 256 MB, or make a text long."""
    if not data.startswith(b"\x89MCAP"):
        data += bytes(data[-2000:]) * 1000
        return
    said = dice.choice((_BOMB, 1 << 31, 1000, (1 << 63) - 1))
    packed = zstandard.ZstdCompressor().compress(bytes(_BOMB if said <= _BOMB else 1 << 20))
    body = bytes(16) + said.to_bytes(8, "little") + bytes(4) + b"\4\0\0\0zstd"
    body += len(packed).to_bytes(8, "little") + packed
    data[-8:-8] = b"\x06" + len(body).to_bytes(8, "little") + body


BINARY: Final[tuple[Callable[[bytearray, Random], None], ...]] = (
    *(_flips, _flips, _cut, _blown_up, _blown_up, _splice, _splice),
)
TEXT: Final = (*BINARY, _numbers, _numbers, _numbers)
RARE: Final = (_bomb, _long_line)


def damage(original: Original, dice: Random) -> bytes:
    """Return the file with one or a few kinds of damage."""
    data = bytearray(original.data)
    for _ in range(dice.choice((1, 1, 2, 3))):
        kinds = TEXT if original.is_text else BINARY
        (dice.choice(RARE) if dice.random() < 0.05 else dice.choice(kinds))(data, dice)
        if not data:
            break
    return bytes(data)


# ---------------------------------------------------------------------------------------- uses


def use(words: tuple[str, ...], folder: Path) -> int:
    """Run the command line in a child, and return its exit status.

    Raises:
        AssertionError: it took too long or too much, left a traceback, or another exit status.
    """
    heard = folder / "heard"
    pid = os.fork()
    if pid == 0:
        _be_child(words, folder, heard)
    killer = _Killer(pid)
    try:
        _, status, used = os.wait4(pid, 0)
    finally:
        killer.cancel()
    text = heard.read_text(errors="replace")
    command = " ".join(words[:1] + words[-2:])
    if _TRACEBACK.search(text):
        last = text.strip().splitlines()[-1][:200]
        raise AssertionError(f"{words[0]}: traceback: {last}")
    took_s = used.ru_utime + used.ru_stime
    assert took_s <= SECONDS_MAX, f"{command}: took {took_s:.1f} s of processor time"
    megabytes = used.ru_maxrss / 1024
    assert megabytes <= MEGABYTES_MAX, f"{command}: took {megabytes:.0f} MB"
    code = os.waitstatus_to_exitcode(status)
    assert code in DOCUMENTED, f"{command}: exit status {code}"
    return code


@final
class _Killer:
    """An alarm that kills a child which waits for ever."""

    def __init__(self, pid: int) -> None:
        self._before = signal.signal(signal.SIGALRM, lambda *_: os.kill(pid, signal.SIGKILL))
        signal.alarm(_PATIENCE_S)

    def cancel(self) -> None:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, self._before)


def _be_child(words: tuple[str, ...], folder: Path, heard: Path) -> None:
    status = _BROKEN
    try:
        os.chdir(folder)
        os.environ[VARIABLE] = str(folder / "locks")
        out = os.open(heard, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        null = os.open(os.devnull, os.O_RDONLY)
        for one, where in ((0, null), (1, out), (2, out)):
            os.dup2(where, one)
        sys.stdin, sys.stdout, sys.stderr = sys.__stdin__, sys.__stdout__, sys.__stderr__
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CPU, (4 * SECONDS_MAX, 4 * SECONDS_MAX))
        status = main(words)
    except BaseException:
        traceback.print_exc(file=sys.__stderr__)
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def begin(seed: int, verb: str | None = None) -> Attempt:
    """Return the attempts: one damaged file each, through all its verbs, or this one only."""
    folder = Folder()
    names = list(folder.originals)
    for words in (("judge",), ("report", "-o", str(folder.path / "p.html")), ("show",)):
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            main([*words, str(GOLDEN / "cia402.mcap")])  # imports, which children then have
    for module in ("analyse", "check", "convert", "diff", "list", "recover", "replay", "run"):
        import_module(f"motorhil.harness.cli.{module}")
    gc.collect()
    gc.freeze()  # children would copy every page that their collector visits

    def attempt(number: int) -> Done:
        name = names[number % len(names)]
        original = folder.originals[name]
        data = damage(original, Random(f"{seed}:{number}"))
        reached = Counter({name: 1})
        wrong = []
        for words in original.uses:
            if verb not in (None, words[0]):
                continue
            where = folder.lay_out(original, data)
            filled = tuple(word.format(original.file) for word in words)
            try:
                reached[f"{words[0]}: exit status {use(filled, where)}"] += 1
            except AssertionError as error:
                wrong.append(f"{name}: {error}")
        if wrong:
            raise AssertionError("; ".join(dict.fromkeys(wrong)))
        return Done(1, repr(sorted(reached.items())).encode(), reached)

    return attempt


FILES: Final = Attack("files", "files", begin)


def files_through(verb: str) -> Attack:
    """Return the attack with this verb only; an attempt has the same file as without."""
    return Attack("files", "files", partial(begin, verb=verb), f"--verb {verb} ")
