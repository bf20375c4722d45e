"""Recorders killed at any instant, and recorders whose disk is full at any byte.

`recover` must get all that was recorded up to 1.01 s before the end: in the recorder's own time,
which runs as fast as the machine allows. Frames must be whole, in order, and without gaps.
"""

import mmap
import os
import resource
import select
import signal
import struct
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from typing import Final

from motorhil.harness.recording.writer import Pump, Series, opener
from motorhil.harness.rig.config.rig_file import RigDescription, parse_rig
from motorhil.harness.rig.config.toml import Source
from motorhil.harness.rig.reading import installed_plugins
from motorhil.harness.rig.rig import Rig
from motorhil.motorapi import ControlMode, ControlVariable
from motorhil.traces.can_frame import classic
from motorhil.traces.errors import TraceError
from motorhil.traces.formats.frames import Findings
from motorhil.traces.formats.registry import recorded_frames
from motorhil.traces.mcap.reader import read_trace
from motorhil.traces.mcap.recovery import recover
from tests.attack.campaign import Attack, Attempt, Done
from tests.support.motors.kinds import EVERY

LOST_MAX_NS: Final = 1_010_000_000
MS: Final = 1_000_000
_FRAME_NS: Final = 1 * MS
_ROUND_NS: Final = 5 * MS
_END_S: Final = 60
_TIME: Final = struct.Struct("<q")
_PATIENCE_S: Final = 60.0

Recorder = Callable[[Path, Callable[[int], None]], None]
"""Record to the path, and report each time [ns] up to which all was passed to the recorder."""


def record_bus(path: Path, reached: Callable[[int], None]) -> None:
    """Record numbered frames of a bus, as `motorhil record` does."""
    dice = Random(0)
    pump = Pump(["can0"], Series(str(path), opener(["can0"], {}, compact=False)))
    number = 0
    for now_ns in range(0, _END_S * 1_000 * MS, _ROUND_NS):
        entries = []
        for time_ns in range(now_ns, now_ns + _ROUND_NS, _FRAME_NS):
            data = number.to_bytes(4, "little") + dice.randbytes(4)
            entries.append((0, time_ns, classic(0x123, data)))
            number += 1
        pump.take([entries], now_ns + _ROUND_NS)
        pump.tick(now_ns + _ROUND_NS)
        reached(now_ns + _ROUND_NS)


@cache
def _description() -> RigDescription:
    return parse_rig(Source(Path("it.toml"), EVERY["cia402"].rig()), installed_plugins())


def record_rig(path: Path, reached: Callable[[int], None]) -> None:
    """Record a rig with a turning motor, as `motorhil run` does."""
    with Rig(_description(), record=path) as rig:
        rig.runtime.every(0.01, lambda: reached(rig.runtime.now_ns()))
        motor = rig.motors["left"]
        motor.enable()
        motor.set_control_mode(ControlMode.SETPOINT, ControlVariable.VELOCITY)
        motor.set_setpoint(0.5)
        motor.start()
        rig.runtime.run_for(_END_S)


def ended(record: Recorder, path: Path, kill_after_s: float | None, bytes_max: int | None) -> int:
    """Record in a child until it is killed or its disk is full; return the time reached [ns]."""
    page = mmap.mmap(-1, mmap.PAGESIZE)
    pid = os.fork()
    if pid == 0:
        try:
            if bytes_max is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_max, bytes_max))
            record(path, lambda time_ns: _TIME.pack_into(page, 0, time_ns))
        except TraceError:
            pass
        finally:
            os._exit(0)
    watch = os.pidfd_open(pid)
    try:
        if kill_after_s is not None:
            until = _PATIENCE_S
            while until > 0 and not _TIME.unpack_from(page)[0]:
                until -= 0.001
                if select.select([watch], [], [], 0.001)[0]:
                    break
            select.select([watch], [], [], kill_after_s)
            os.kill(pid, signal.SIGKILL)
        elif not select.select([watch], [], [], _PATIENCE_S)[0]:
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    finally:
        os.close(watch)
    reached_ns: int = _TIME.unpack_from(page)[0]
    return reached_ns


def require_recovered(path: Path, reached_ns: int, is_numbered: bool) -> Counter[str]:
    """Recover the recording and compare it with the time reached.

    Raises:
        AssertionError: too much is lost, or the frames are not those recorded.
    """
    whole = path.with_suffix(".whole")
    try:
        recover(str(path), str(whole), overwrite=True)
    except (TraceError, OSError):
        assert reached_ns <= LOST_MAX_NS, f"nothing recovered of {reached_ns / 1e9:.3f} s"
        return Counter({"nothing yet": 1})
    with read_trace(str(whole)) as trace:
        frames = list(recorded_frames(trace, Findings()))
        last_ns = max((time_ns for _, time_ns, _ in trace.messages()), default=0)
    lost_ns = reached_ns - last_ns
    assert lost_ns <= LOST_MAX_NS, f"{lost_ns / 1e9:.3f} s lost of {reached_ns / 1e9:.3f} s"
    if is_numbered:
        numbers = [int.from_bytes(one.frame[8:12], "little") for one in frames]
        assert numbers == list(range(len(numbers))), "frames are missing or out of order"
        assert all(one.time_ns == k * _FRAME_NS for k, one in enumerate(frames)), "wrong times"
    else:
        times = [one.time_ns for one in frames]
        assert times == sorted(times), "frames are out of order"
    return Counter({"recovered": 1, "frames": len(frames), "seconds": last_ns // 1_000_000_000})


def attack(seed: str, folder: Path) -> Done:
    """Kill a recorder, or fill its disk; then recover."""
    dice = Random(seed)
    is_rig = dice.random() < 0.3
    path = folder / "it.mcap"
    path.unlink(missing_ok=True)
    is_killed = dice.random() < 0.5
    record = record_rig if is_rig else record_bus
    if is_killed:
        reached_ns = ended(record, path, dice.uniform(0.0, 0.3), None)
    else:
        reached_ns = ended(record, path, None, dice.randrange(100, 60_000 if is_rig else 400_000))
    reached = require_recovered(path, reached_ns, not is_rig)
    reached["killed" if is_killed else "full disk"] += 1
    reached["rig" if is_rig else "bus"] += 1
    return Done(1, b"", reached)


def begin(seed: int) -> Attempt:
    """Return the attempts: one recorder each."""
    keep = tempfile.TemporaryDirectory(prefix="motorhil-attack-")
    folder = Path(keep.name)

    def attempt(number: int) -> Done:
        return attack(f"{seed}:{number}", folder)

    weakref.finalize(attempt, keep.cleanup)
    return attempt


RECORDINGS: Final = Attack("recordings", "recorders", begin)
