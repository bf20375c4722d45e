"""Child processes in virtual time: Python programs that `subprocess` starts share the rig's clock.

A child joins the rig before its first line and has turns as its parent has. The parent waits for
its end and for its pipes in the rig's time. A child that cannot join (another language, Python
with -S, -E or -I) runs on the wall clock; the rig's time stands still while its parent waits.
"""

import asyncio
import io
import os
import re
import select
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial, wraps
from inspect import signature
from subprocess import PIPE, STDOUT, Popen, TimeoutExpired
from typing import Any, Final, final

from motorhil.harness.virtual_time.stdlib.refusals import is_meant, refuse
from motorhil.harness.virtual_time.stdlib.threads import (
    OUTSIDE,
    Program,
    has_children,
    party_here,
    program_here,
)

PIPES_VARIABLE: Final = "MOTORHIL_PIPES"
"""Environment variable of children: the standard streams that are pipes to the parent, as "12"."""
_PYTHON: Final = re.compile(r"python[0-9.]*")
_ALONE: Final = frozenset("SIE")  # options of Python with which it cannot join
_CHUNK: Final = 65_536
_LOOK: Final = os.WEXITED | os.WNOHANG | os.WNOWAIT
_WRITE_MAX: Final = select.PIPE_BUF  # a pipe that is ready takes as much at once
_HARMLESS: Final = frozenset(
    {signal.SIGCHLD, signal.SIGCONT, signal.SIGURG, signal.SIGWINCH}
    | {signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU}
)
_init, _wait, _poll = Popen.__init__, Popen.wait, Popen.poll
_communicate, _send_signal = Popen.communicate, Popen.send_signal
_select = select.select
_loop_exec = asyncio.BaseEventLoop.subprocess_exec
_loop_shell = asyncio.BaseEventLoop.subprocess_shell
_WATCHER: Final[Any] = getattr(asyncio, "ThreadedChildWatcher", None)
_watch = getattr(_WATCHER, "_do_waitpid", None)  # not in each version of Python
_CHILD: Final = "the new process runs on the wall clock, not on the rig's"
_RUN: Final = "use asyncio.to_thread(subprocess.run, ...)"
_SIGNATURE: Final = signature(_init)
_joined: Final[weakref.WeakSet[Popen[Any]]] = weakref.WeakSet()


def methods() -> list[tuple[type, str, object]]:
    """Return (class, name, stand-in) for the methods of Popen."""
    return [
        (Popen, "__init__", _started),
        (Popen, "wait", _waited),
        (Popen, "poll", _polled),
        (Popen, "communicate", _communicated),
        (Popen, "send_signal", _signalled),
        (asyncio.BaseEventLoop, "subprocess_exec", _started_by_loop),
        (asyncio.BaseEventLoop, "subprocess_shell", _shell_by_loop),
        *([] if _watch is None else [(_WATCHER, "_do_waitpid", _watched)]),
    ]


def take_parents_pipes() -> None:
    """Let this program's standard streams wait in virtual time, where they are pipes."""
    for name in os.environ.pop(PIPES_VARIABLE, ""):
        stream = ("stdin", "stdout", "stderr")[int(name)]
        own: Any = getattr(sys, stream)
        raw = _Pipe(int(name), is_written=stream != "stdin", keeps=True)
        buffer = io.BufferedReader(raw) if stream == "stdin" else io.BufferedWriter(raw)
        text = io.TextIOWrapper(
            buffer, own.encoding, own.errors, line_buffering=True, write_through=True
        )
        setattr(sys, stream, text)


@wraps(_init)
def _started(process: Popen[Any], *arguments: Any, **named: Any) -> None:
    """Stand in for Popen(...)."""
    program = _program()
    given = _SIGNATURE.bind(process, *arguments, **named)
    given.apply_defaults()
    facts = given.arguments
    if program is None or program.children is None or not _can_join(facts):
        _init(process, *arguments, **named)
        return
    environment = facts["env"]
    environment = program.children.invite(os.environ if environment is None else environment)
    kinds = [facts["stdin"], facts["stdout"], facts["stderr"]]
    kinds[2] = kinds[1] if kinds[2] == STDOUT else kinds[2]
    environment[PIPES_VARIABLE] = "".join(str(fd) for fd in range(3) if kinds[fd] == PIPE)
    facts["env"] = environment
    _init(*given.args, **given.kwargs)
    reason = program.children.admit(process.pid)
    if reason:
        print(f"motorhil: child {_shown(facts['args'])}: {reason}", file=sys.stderr)
        return
    _joined.add(process)
    for stream in ("stdin", "stdout", "stderr"):
        setattr(process, stream, _in_time(getattr(process, stream), facts["bufsize"]))


@wraps(_wait)
def _waited(process: Popen[Any], timeout: float | None = None) -> int:
    """Stand in for Popen.wait."""
    if not _is_in_time(process):
        return _wait(process, timeout)
    if not await_here(lambda: _poll(process) is not None, timeout):
        raise TimeoutExpired(process.args, timeout or 0.0)
    return int(process.returncode)


@wraps(_poll)
def _polled(process: Popen[Any]) -> int | None:
    """Stand in for Popen.poll, which programs call in loops."""
    if not _is_in_time(process):
        return _poll(process)
    await_here(lambda: _poll(process) is not None, 0.0)
    return process.returncode


@wraps(_send_signal)
def _signalled(process: Popen[Any], sig: int) -> None:
    """Stand in for Popen.send_signal, terminate and kill; return once the child is dead by it."""
    if process not in _joined or process.returncode is not None:
        _send_signal(process, sig)
        return
    with death_awaited(process.pid, sig):
        _send_signal(process, sig)


@wraps(_communicate)
def _communicated(
    process: Popen[Any], input: Any = None, timeout: float | None = None
) -> tuple[Any, Any]:
    """Stand in for Popen.communicate."""
    if not _is_in_time(process):
        return _communicate(process, input, timeout)
    talk = _talks.get(process)
    if talk is None:
        talk = _talks[process] = _Talk(process, input)
    if not await_here(lambda: talk.is_over() and _poll(process) is not None, timeout):
        raise TimeoutExpired(process.args, timeout or 0.0)
    del _talks[process]
    return talk.result()


@wraps(_loop_exec)
def _started_by_loop(loop: Any, factory: Any, program: Any, *words: Any, **named: Any) -> Any:
    """Stand in for the function of event loops that starts a program."""
    facts = {"args": [program, *words], "shell": False, "executable": named.get("executable")}
    if is_meant() and not (has_children() and _can_join(facts)):
        refuse("asyncio.subprocess_exec", _CHILD, _RUN)
    return _loop_exec(loop, factory, program, *words, **named)


@wraps(_loop_shell)
def _shell_by_loop(*arguments: Any, **named: Any) -> Any:
    """Stand in for the function of event loops that starts a shell."""
    if is_meant():
        refuse("asyncio.subprocess_shell", _CHILD, _RUN)
    return _loop_shell(*arguments, **named)


def _watched(watcher: Any, loop: Any, pid: int, *others: Any) -> None:
    """Stand in for the thread that waits for the end of a child of an event loop."""
    await_here(lambda: os.waitid(os.P_PID, pid, _LOOK) is not None, None)
    assert _watch is not None
    _watch(watcher, loop, pid, *others)


@final
class _Talk:
    """A talk between a parent and its child, until all pipes are closed."""

    def __init__(self, process: Popen[Any], given: Any) -> None:
        self._read: dict[str, bytearray] = {}
        self._open = {}
        for name in ("stdout", "stderr"):
            stream = getattr(process, name)
            if stream is not None:
                self._read[name] = bytearray()
                self._open[name] = stream
        self._streams = dict(self._open)
        self._input, self._left = process.stdin, memoryview(b"")
        if self._input is not None:
            with suppress(BrokenPipeError):
                self._input.flush()
            if isinstance(given, str):
                text: Any = self._input
                given = given.encode(text.encoding, text.errors)
            self._left = memoryview(given or b"")

    def is_over(self) -> bool:
        """Read and write what can be; return whether all is done."""
        self._write()
        for name, stream in list(self._open.items()):
            while is_ready(stream.fileno(), False):
                read = os.read(stream.fileno(), _CHUNK)
                self._read[name] += read
                if not read:
                    self._open.pop(name).close()
                    break
        return not self._open and self._input is None

    def _write(self) -> None:
        if self._input is None:
            return
        try:
            while self._left and is_ready(self._input.fileno(), True):
                self._left = self._left[os.write(self._input.fileno(), self._left[:_WRITE_MAX]) :]
        except BrokenPipeError:
            self._left = memoryview(b"")
        if not self._left:
            self._input.close()
            self._input = None

    def result(self) -> tuple[Any, Any]:
        """Return what was read from both streams; None for one that is no pipe."""
        return self._said("stdout"), self._said("stderr")

    def _said(self, name: str) -> Any:
        if name not in self._read:
            return None
        data, stream = bytes(self._read[name]), self._streams[name]
        if not isinstance(stream, io.TextIOWrapper):
            return data
        return io.TextIOWrapper(io.BytesIO(data), stream.encoding, stream.errors).read()


_talks: Final[weakref.WeakKeyDictionary[Popen[Any], _Talk]] = weakref.WeakKeyDictionary()


@final
class _Pipe(io.RawIOBase):
    """An end of a pipe to another program of the rig, which waits in virtual time."""

    def __init__(self, fd: int, *, is_written: bool, keeps: bool = False) -> None:
        self._fd = fd
        self._is_written = is_written
        self._keeps = keeps

    def fileno(self) -> int:
        """Return the descriptor."""
        if self.closed:
            raise ValueError("I/O operation on closed file")
        return self._fd

    def readable(self) -> bool:
        """Return whether it is the end to read."""
        return not self._is_written

    def writable(self) -> bool:
        """Return whether it is the end to write."""
        return self._is_written

    def readinto(self, buffer: Any) -> int:
        """Wait for data; return how many bytes there were, 0 at the end."""
        await_here(partial(is_ready, self.fileno(), False), None)
        data = os.read(self._fd, len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: Any) -> int:
        """Wait for room; return how many bytes were written."""
        await_here(partial(is_ready, self.fileno(), True), None)
        return os.write(self._fd, bytes(memoryview(data)[:_WRITE_MAX]))

    def close(self) -> None:
        """Close the descriptor."""
        if not self.closed:
            super().close()
            if not self._keeps:
                os.close(self._fd)


def _in_time(stream: Any, bufsize: int) -> Any:
    """Return a stream of a child as one that waits in virtual time."""
    if stream is None:
        return None
    fd = os.dup(stream.fileno())
    os.set_inheritable(fd, False)
    is_written = stream.writable()
    stream.close()
    raw = _Pipe(fd, is_written=is_written)
    size = io.DEFAULT_BUFFER_SIZE if bufsize <= 1 else bufsize
    kind: Callable[..., Any] = io.BufferedWriter if is_written else io.BufferedReader
    if not isinstance(stream, io.TextIOWrapper):
        return raw if bufsize == 0 else kind(raw, size)
    return io.TextIOWrapper(
        *(kind(raw, size), stream.encoding, stream.errors),
        line_buffering=stream.line_buffering,
        write_through=is_written,
    )


def await_here(look: Callable[[], bool], timeout_s: float | None) -> bool:
    """Wait in the rig's time until `look` finds something; return whether it does."""
    program, party = program_here(), party_here()
    if program is None or party is None or program.children is None or look():
        return True
    if timeout_s is not None and timeout_s <= 0:
        program.look(party)
        return look()
    left_s = None if timeout_s is None else program.from_now_s(party, timeout_s)
    with program.children.watching():
        return program.runtime.wait_for_parties(look, left_s)


@contextmanager
def death_awaited(pid: int, number: int) -> Iterator[None]:
    """Wait, after the block, for the end of a child that this signal kills.

    It dies at once, but on the wall clock: without this, at a random time of the rig.
    """
    is_end = _ends(pid, number)
    yield
    if is_end:
        with suppress(ChildProcessError):
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def is_ready(fd: int, is_written: bool) -> bool:
    """Return whether a read or write would not wait."""
    return any(_select(() if is_written else (fd,), (fd,) if is_written else (), (), 0))


def _is_in_time(process: Popen[Any]) -> bool:
    return process in _joined and party_here() is not None


def _program() -> Program | None:
    """Return the program if it has started this process, not a package that runs or tests it."""
    frame = sys._getframe(2)  # noqa: SLF001 -- as in caller_is_outside
    while frame.f_globals.get("__name__") == "subprocess" and frame.f_back is not None:
        frame = frame.f_back
    package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
    return None if package in OUTSIDE else program_here()


def _can_join(facts: Mapping[str, Any]) -> bool:
    """Return whether these arguments of Popen start a Python that can join the rig."""
    words = facts["args"]
    words = [words] if isinstance(words, str | bytes | os.PathLike) else list(words)
    if facts["shell"] or not words:
        return False
    command = os.fsdecode(facts["executable"] or words[0])
    if command != sys.executable and not _PYTHON.fullmatch(os.path.basename(command)):
        return False
    for word in map(os.fsdecode, words[1:]):
        if not word.startswith("-") or word in ("-c", "-m", "-"):
            break
        if _ALONE & set(word[1:]) and not word.startswith(("--", "-X", "-W")):
            return False
    return True


def _shown(words: Any) -> str:
    if isinstance(words, str | bytes | os.PathLike):
        return os.fsdecode(words)
    return subprocess.list2cmdline([os.fsdecode(word) for word in words])


def _ends(pid: int, number: int) -> bool:
    """Return whether this signal kills the process, which has no handler for it."""
    if number == signal.SIGKILL:
        return True
    if number == 0 or number in _HARMLESS:
        return False
    held = 0
    with suppress(OSError), open(f"/proc/{pid}/status") as file:
        for line in file:
            if line.startswith(("SigBlk:", "SigIgn:", "SigCgt:")):
                held |= int(line.split()[1], 16)
    return not held >> (number - 1) & 1
