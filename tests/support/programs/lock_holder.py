"""A program that takes a lock, commanded line by line.

python -m tests.support.programs.lock_holder FOLDER NAME [BASE]

    take PURPOSE [TIMEOUT_S]    "has TOKEN-BASE CHANGED_HANDS", or "busy WHY"
    lease PURPOSE LEASE_S [TIMEOUT_S]    the same, with a lease
    over PURPOSE                the same, taken over from its holder
    release                     "released"
    write                       "wrote TOKEN-BASE", or "busy WHY"
    begin                       "began", in the middle of a write until "end"
    renew                       "renewed", or "busy WHY"
    held                        "held True", or "held False, lost to WHOM"
    fork                        "forked PID": a child that lives until it is killed
    child                       "child PID": a program that inherits all it can, likewise
    dies N                      "died", or "survived": a child that takes the lock over from this
                                process, and is killed just before its N-th system call for it
    fork_take PURPOSE           "forked PID ANSWER": the child's answer to `take PURPOSE`
"""

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
from types import SimpleNamespace

from motorhil.motorapi.errors import MotorBusyError
from motorhil.motorapi.locking import takeover as lock_takeover
from motorhil.motorapi.locking.directory import LockDirectory
from motorhil.motorapi.locking.lock_file import LockFile
from motorhil.motorapi.locking.process_lock import LockHandle, ProcessLock
from motorhil.motorapi.runtime.wall import WallRuntime


def fork() -> int:
    pid = os.fork()
    if pid == 0:
        signal.pause()
    return pid


class Holder:
    """The commands for the lock."""

    def __init__(self, lock: ProcessLock, base: int) -> None:
        self.runtime = WallRuntime()
        self.hold: LockHandle | None = None
        self._lock, self._base = lock, base

    def told(self, hold: LockHandle) -> str:
        return f"has {hold.token - self._base} {hold.changed_hands}"

    def take(self, purpose: str, timeout_s: str = "0.0") -> str:
        self.hold = self._lock.acquire(self.runtime, purpose, float(timeout_s))
        return self.told(self.hold)

    def lease(self, purpose: str, lease_s: str, timeout_s: str = "0.0") -> str:
        self.hold = self._lock.acquire(
            self.runtime, purpose, float(timeout_s), lease_s=float(lease_s)
        )
        return self.told(self.hold)

    def over(self, purpose: str) -> str:
        self.hold = self._lock.acquire(self.runtime, purpose, take_over=True)
        return self.told(self.hold)

    def write(self) -> str:
        token = self._lock.begin_write()
        self._lock.end_write()
        return f"wrote {token - self._base}"

    def begin(self) -> str:
        self._lock.begin_write()
        return "began"

    def end(self) -> str:
        self._lock.end_write()
        return "ended"

    def renew(self) -> str:
        assert self.hold is not None
        self.hold.renew()
        return "renewed"

    def held(self) -> str:
        assert self.hold is not None
        lost = "" if self.hold.lost_to is None else f", lost to {self.hold.lost_to}"
        return f"held {self.hold.is_held}{lost}"

    def release(self) -> str:
        assert self.hold is not None
        self.hold.release()
        return "released"

    def answer(self, word: str, *rest: str) -> str:
        try:
            text: str = getattr(self, word)(*rest)
        except MotorBusyError as error:
            return f"busy {error}"
        return text


def die_before(number: int) -> None:
    """Kill this process before the number-th step of its next takeover."""
    left = [number]

    def counted(action):
        def step(*words):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return action(*words)

        return step

    lock_takeover.os = SimpleNamespace(pwrite=counted(os.pwrite), pread=os.pread, SEEK_SET=0)
    lock_takeover.fcntl = SimpleNamespace(**vars(fcntl) | {"fcntl": counted(fcntl.fcntl)})
    LockFile.try_write_alone = counted(LockFile.try_write_alone)


def main() -> None:
    folder, name, *base = sys.argv[1:]
    lock = ProcessLock(name, f"the {name}", LockDirectory(folder))
    holder = Holder(lock, int(base[0]) if base else 0)
    for line in sys.stdin:
        word, *rest = line.split()
        if hasattr(Holder, word):
            answer = holder.answer(word, *rest)
        elif word == "dies":
            child = os.fork()
            if child == 0:
                die_before(int(rest[0]))
                lock.acquire(WallRuntime(), "dying", take_over=True)
                os._exit(0)
            killed = os.WIFSIGNALED(os.waitpid(child, 0)[1])
            answer = "died" if killed else "survived"
        elif word == "fork":
            answer = f"forked {fork()}"
        elif word == "fork_take":
            ours, theirs = os.pipe()
            child = os.fork()
            if child == 0:
                try:
                    told = holder.told(lock.acquire(WallRuntime(), rest[0]))
                except MotorBusyError as error:
                    told = f"busy {error}"
                os.write(theirs, told.encode())
                signal.pause()
            answer = f"forked {child} {os.read(ours, 1000).decode()}"
        elif word == "child":
            program = [sys.executable, "-c", "import signal; signal.pause()"]
            answer = f"child {subprocess.Popen(program, close_fds=False).pid}"
        else:
            answer = f"what is {line!r}?"
        with contextlib.suppress(BrokenPipeError):
            print(answer, flush=True)


if __name__ == "__main__":
    main()
