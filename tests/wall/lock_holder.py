"""A program of its own that takes a lock: it does what it reads line by line, and prints an answer.

python -m tests.wall.lock_holder FOLDER NAME

    take PURPOSE [TIMEOUT_S]    "has TOKEN CHANGED_HANDS", or "busy WHY"
    release                     "released"
    fork                        "forked PID": a child that lives until it is killed
    child                       "child PID": a program that inherits all it can, likewise
    fork_take PURPOSE           "forked PID ANSWER": what `take PURPOSE` answers the child
"""

import contextlib
import os
import signal
import subprocess
import sys

from motorapi.errors import MotorBusyError
from motorapi.lock_directory import LockDirectory
from motorapi.process_lock import ProcessLock
from motorapi.wall_runtime import WallRuntime


def fork() -> int:
    pid = os.fork()
    if pid == 0:
        signal.pause()
    return pid


def main() -> None:
    folder, name = sys.argv[1:]
    lock = ProcessLock(name, f"the {name}", LockDirectory(folder))
    hold = None
    runtime = WallRuntime()
    for line in sys.stdin:
        word, *rest = line.split()
        if word == "take":
            timeout_s = float(rest[1]) if len(rest) > 1 else 0.0
            try:
                hold = lock.acquire(runtime, rest[0], timeout_s)
            except MotorBusyError as error:
                answer = f"busy {error}"
            else:
                answer = f"has {hold.token} {hold.changed_hands}"
        elif word == "release" and hold is not None:
            hold.release()
            answer = "released"
        elif word == "fork":
            answer = f"forked {fork()}"
        elif word == "fork_take":
            ours, theirs = os.pipe()
            child = os.fork()
            if child == 0:
                try:
                    taken = lock.acquire(WallRuntime(), rest[0])
                    told = f"has {taken.token} {taken.changed_hands}"
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
