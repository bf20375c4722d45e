"""Starts of this process's Python programs: by the fork server if it can, otherwise by Python.

`subprocess` stays as it is, down to the one function that starts a process. A forked program is a
child of this process, with its own arguments, environment, folder, files, signals and exit status.
Its hash seed is the server's.
"""

import ctypes
import json
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

_SET, _GET = 36, 37  # PR_SET_CHILD_SUBREAPER and PR_GET_CHILD_SUBREAPER of linux/prctl.h
_EARLY: Final = re.compile(r"PYTHON(?!PATH$|UNBUFFERED$)|LD_|LC_|LANG|MALLOC_|OMP_|TZ$")
"""Variables that act at the start of Python."""
_MODULES: Final = re.compile(r"motorhil|tests\.support\.programs\.\w+")
"""Not the worker of a swarm, whose rows name the places where a program is, up to its start."""
_COMMAND: Final = re.compile(
    r"import (signal, )?sys[;\n] ?(signal\.signal\(signal\.SIGINT, signal\.default_int_handler\)"
    r"[;\n]?.*[;\n]?)?from motorhil\.[\w.]+ import (main|start)[;\n] ?"
    r"sys\.exit\((main|start)\((sys\.argv\[1:\])?\)\)\n?"
)
_FLAGS: Final = ("-P", "-u")
_Popen: Final = subprocess.Popen  # also where a test has put another in its place
_execute: Final[Any] = _Popen._execute_child  # type: ignore[attr-defined]


def early(environment: Any) -> dict[str, str]:
    """Return what acts at the start of Python."""
    return {name: value for name, value in environment.items() if _EARLY.match(name)}


class ForkServer:
    """The server, a child of this process, which starts with the first program."""

    def __init__(self) -> None:
        self._owner = os.getpid()
        self._lock = threading.Lock()
        self._early = early(os.environ)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = _Popen(
                [sys.executable, "-m", "tests.support.forking.server", str(theirs.fileno())],
                cwd="/",
                pass_fds=[theirs.fileno()],
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )

    def suits(self, environment: Any) -> bool:
        """Return whether a program in this environment starts like the server."""
        return os.getpid() == self._owner and early(environment) == self._early

    def start(self, request: dict[str, Any], fds: Sequence[int]) -> int | None:
        """Return the process id of the program, or None if the server cannot start it."""
        with self._lock, _adopting():
            socket.send_fds(self._socket, [json.dumps(request).encode()], fds)
            return int(self._socket.recv(64)) or None

    def close(self) -> None:
        """End the server, but no program."""
        self._socket.close()
        self._process.wait()


@contextmanager
def _adopting() -> Iterator[None]:
    """Adopt orphans, such as the program that the server's child has started."""
    prctl = ctypes.CDLL(None).prctl
    before = ctypes.c_int()
    prctl(_GET, ctypes.byref(before))
    prctl(_SET, 1)
    try:
        yield
    finally:
        prctl(_SET, before.value)


def request_of(words: Sequence[str]) -> dict[str, Any] | None:
    """Return what to run, if these are the words of a Python program that may be forked."""
    if not words or words[0] != sys.executable:
        return None
    rest = list(words[1:])
    flags = []
    while rest and rest[0] in _FLAGS:
        flags.append(rest.pop(0))
    kind = rest[0] if rest and rest[0] in ("-m", "-c") else ""
    if kind:
        del rest[0]
    if not rest or rest[0].startswith("-"):
        return None
    may = {
        "-m": _MODULES.fullmatch(rest[0]) is not None,
        "-c": _COMMAND.fullmatch(rest[0]) is not None,
        "": rest[0].endswith(".py"),
    }
    if not may[kind]:
        return None
    return {"kind": kind, "what": rest[0], "words": rest[1:], "flags": flags, "all": list(words)}


@contextmanager
def executing() -> Iterator[None]:
    """Let Python start each program within the block."""
    before = subprocess.Popen._execute_child  # type: ignore[attr-defined]
    subprocess.Popen._execute_child = _execute  # type: ignore[attr-defined]
    try:
        yield
    finally:
        subprocess.Popen._execute_child = before  # type: ignore[attr-defined]


@contextmanager
def forking() -> Iterator[None]:
    """Let this process start its Python programs by fork within the block, if it does not yet."""
    if subprocess.Popen._execute_child is not _execute:  # type: ignore[attr-defined]
        yield
        return
    server: ForkServer | None = None

    def start(process: Any, args: Any, executable: Any, preexec: Any, *more: Any) -> None:
        nonlocal server
        (closes, passed, cwd, env, _, _, shell, *pipes) = more[:13]
        _, gid, gids, uid, umask, is_session, group = more[13:20]
        plain = (executable, preexec, shell or None, gid, gids, uid)
        words = [] if isinstance(args, str | bytes) else [os.fsdecode(one) for one in args]
        request = request_of(words)
        environment = os.environ if env is None else env
        if request is None or any(plain) or not closes or umask >= 0 or not _is_text(environment):
            return _execute(process, args, executable, preexec, *more)
        if server is None:
            server = ForkServer()
        reads, _, _, writes, _, errors = pipes
        standard = [fd if fd >= 0 else number for number, fd in enumerate((reads, writes, errors))]
        request |= {
            "cwd": os.path.abspath(os.fsdecode(cwd or ".")),
            "env": dict(environment),
            "fds": [0, 1, 2, *passed],
            "session": is_session,
            "group": group,
        }
        pid = None
        if server.suits(environment):
            pid = server.start(request, [*standard, *passed])
        if pid is None:
            return _execute(process, args, executable, preexec, *more)
        process.pid = pid
        process._child_created = True
        process._close_pipe_fds(*pipes)
        return None

    subprocess.Popen._execute_child = start  # type: ignore[attr-defined]
    try:
        yield
    finally:
        subprocess.Popen._execute_child = _execute  # type: ignore[attr-defined]
        if server is not None:
            server.close()


def _is_text(environment: Any) -> bool:
    return all(isinstance(one, str) for pair in environment.items() for one in pair)
