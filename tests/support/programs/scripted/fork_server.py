"""Start of Python programs by fork, from a process that has imported motorhil already.

A program so started is a process as any other, a child of this one. Its start takes some
milliseconds, instead of most of a second.
"""

import ctypes
import os
import runpy
import signal
import socket
import subprocess
import sys
from pathlib import Path

PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_TESTS = Path(__file__).parents[4]  # the folder of the package of tests


class Forked:
    """A started program, with the part of subprocess.Popen that a rig uses."""

    def __init__(self, pid, stdout):
        self.pid = pid
        self.stdout = stdout
        self.returncode = None

    def poll(self):
        """Return its exit status, or None."""
        return self._wait(os.WNOHANG)

    def wait(self):
        """Wait for its end and return its exit status."""
        return self._wait(0)

    def _wait(self, options):
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode


class ForkServer:
    """The server; programs become children of this process, which adopts orphans meanwhile."""

    open_count = 0

    def __init__(self):
        self._count(1)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-u", "-m", __name__, str(theirs.fileno())],
                cwd=_TESTS,
                pass_fds=[theirs.fileno()],
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            )

    def start(self, command, *, cwd, env, stdout, **_):
        """Start `python SCRIPT ARGUMENTS`; stand in for subprocess.Popen."""
        assert stdout == subprocess.PIPE
        reading, writing = os.pipe()
        words = [str(cwd), *command[1:]]
        request = "\0".join([str(len(words)), *words, *(f"{k}={v}" for k, v in env.items())])
        socket.send_fds(self._socket, [request.encode()], [writing])
        os.close(writing)
        return Forked(int(self._socket.recv(64)), os.fdopen(reading, "rb", 0))

    def close(self):
        """End the server, but no program."""
        self._socket.close()
        self._process.wait()
        self._count(-1)

    @classmethod
    def _count(cls, change):
        """Adopt orphans while any server is open."""
        cls.open_count += change
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(cls.open_count > 0))


def _serve(connection):
    """Fork at each request; return the request in the child."""
    while True:
        request, fds, _, _ = socket.recv_fds(connection, 1 << 17, 1)
        if not request:
            sys.exit()
        reading, writing = os.pipe()
        between = os.fork()
        if not between:
            pid = os.fork()
            if not pid:
                for fd in (reading, writing, connection.detach()):
                    os.close(fd)
                return request.decode().split("\0"), fds[0]
            os.write(writing, str(pid).encode())
            os._exit(0)  # so that the program becomes a child of the adopting process
        os.waitpid(between, 0)
        connection.send(os.read(reading, 64))
        for fd in (reading, writing, fds[0]):
            os.close(fd)


def _become(words, output):
    """Make this process that of the program, as if it had been executed."""
    count = int(words[0])
    cwd, *sys.argv = words[1 : count + 1]
    os.setsid()
    for fd in (1, 2):
        os.dup2(output, fd)
    os.close(output)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(word.split("=", 1) for word in words[count + 1 :])
    sys.path[0] = str(Path(sys.argv[0]).parent)


if __name__ == "__main__":
    from motorhil.harness.shared_time import unmodified
    from tests.support.programs.scripted import program  # noqa: F401 -- imports for programs

    signal.signal(signal.SIGINT, signal.default_int_handler)
    _become(*_serve(socket.socket(fileno=int(sys.argv[1]))))
    unmodified.enter()
    runpy.run_path(sys.argv[0], run_name="__main__")
