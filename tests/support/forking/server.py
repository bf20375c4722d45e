"""The fork server: imports what programs import, then forks at each request.

python -m tests.support.forking.server FD

A request is JSON, with the program's files beside it; the answer is its process id, or 0 if it may
not be forked, because it would import another module than this process has.
"""

import array
import gc
import io
import json
import os
import runpy
import socket
import sys
import types
from collections.abc import Iterable
from contextlib import suppress
from importlib.machinery import PathFinder
from pathlib import Path

SITE = "sitecustomize"
IMPORTED = (
    "motorhil.harness.cli.main",
    "motorhil.harness.cli.run",
    "motorhil.harness.cli.serve",
    "motorhil.harness.cli.swarm",
    "motorhil.harness.rig.rig",
    "motorhil.harness.shared_time.programs",
    "motorhil.harness.shared_time.unmodified",
    "motorhil.harness.swarm.campaign",
    "motorhil.harness.swarm.child",
    "motorhil.harness.swarm.lanes",
    "motorhil.harness.swarm.trial",
    "motorhil.harness.python_can.bus",
    "motorhil.emulators.cia402.drive",
    "motorhil.motorapi.adaptations.cia402.motor",
    "motorhil.motorapi.adaptations.ideal.motor",
    "tests.support.programs.scripted.program",
)
REQUEST_MAX = 1 << 18


def imports_alike(places: Iterable[str]) -> bool:
    """Return whether these folders, in order, have the modules that were imported, or none."""
    sought = {name for name in sys.modules if "." not in name} - {SITE, "__main__"}
    for place in places:
        names = os.listdir(place or ".") if os.path.isdir(place or ".") else []
        for name in {one.partition(".")[0] for one in names} & sought:
            found = PathFinder.find_spec(name, [place])
            if found is None or found.origin is None:
                continue
            file = getattr(sys.modules[name], "__file__", None)
            if file is None or not os.path.samefile(found.origin, file):
                return False
            sought.remove(name)
    return True


def places_of(request: dict) -> list[str]:
    """Return what this program has before the folders of the environment on its path."""
    if "-P" in request["flags"]:
        return []
    if request["kind"]:
        return [request["cwd"] if request["kind"] == "-m" else ""]
    return [str(Path(request["cwd"], request["what"]).resolve().parent)]


def further(environment: dict) -> list[str]:
    """Return the folders that a program's environment puts on its path, each once."""
    places = environment.get("PYTHONPATH", "").split(os.pathsep)
    return list(dict.fromkeys(os.path.abspath(place) for place in places if place))


def serve(connection: socket.socket) -> tuple[dict, list[int]]:
    """Fork at each request; return the request and its files in the child."""
    while True:
        text, data, _, _ = connection.recvmsg(REQUEST_MAX, socket.CMSG_SPACE(64 * 4))
        if not text:
            os._exit(0)
        fds = array.array("i")
        for _, _, more in data:
            fds.frombytes(more[: len(more) - len(more) % fds.itemsize])
        request = json.loads(text)
        pid = 0
        if may_fork(request):
            pid = fork_of(connection, request)
            if pid < 0:
                return request, list(fds)
        connection.send(str(pid).encode())
        for fd in fds:
            os.close(fd)


def may_fork(request: dict) -> bool:
    """Return whether a fork of this process would do what the program would do."""
    if not os.path.isdir(request["cwd"]):
        return False
    os.chdir(request["cwd"])
    return imports_alike([*places_of(request), *further(request["env"])])


def fork_of(connection: socket.socket, request: dict) -> int:
    """Return the process id of an orphan, which the client adopts; -1 in that process."""
    reading, writing = os.pipe()
    waiting, letting = os.pipe()
    between = os.fork()
    if not between:
        if not os.fork():
            if request["session"]:
                os.setsid()
            if request["group"] >= 0:
                os.setpgid(0, request["group"])
            os.write(writing, str(os.getpid()).encode())
            os.close(letting)
            os.read(waiting, 1)  # until it has its parent
            for fd in (reading, writing, waiting, connection.detach()):
                os.close(fd)
            return -1
        os._exit(0)
    os.waitpid(between, 0)
    pid = int(os.read(reading, 64))
    for fd in (reading, writing, waiting, letting):
        os.close(fd)
    return pid


def become(request: dict, fds: list[int], own: list[str]) -> None:
    """Make this process that of the program, as if Python had just started it."""
    place(fds, request["fds"])
    os.environ.clear()
    os.environ.update(request["env"])
    path = [one for one in sys.path if one not in own]
    sys.path[:] = [*places_of(request), *further(request["env"]), *path]
    sys.path_importer_cache.clear()
    sys.argv = [request["what"] if not request["kind"] else request["kind"], *request["words"]]
    sys.orig_argv = list(request["all"])
    is_unbuffered = "-u" in request["flags"] or bool(request["env"].get("PYTHONUNBUFFERED"))
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        stream = open_standard(number, name, mode, is_unbuffered)
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    main = types.ModuleType("__main__")
    main.__builtins__ = __builtins__  # type: ignore[attr-defined]
    sys.modules["__main__"] = main


def place(fds: list[int], numbers: list[int]) -> None:
    """Give the files these numbers, and close all others."""
    high = max([*fds, *numbers]) + 1
    for number, fd in enumerate(fds, high):
        os.dup2(fd, number)
    for number, fd in enumerate(numbers, high):
        os.dup2(number, fd)
    for fd in map(int, os.listdir("/proc/self/fd")):
        if fd not in numbers:
            with suppress(OSError):
                os.close(fd)


def open_standard(number: int, name: str, mode: str, is_unbuffered: bool) -> io.TextIOWrapper:
    """Return a standard stream as Python opens it."""
    old = getattr(sys, name)
    raw = io.FileIO(number, mode, closefd=False)
    buffer: io.BufferedIOBase | io.RawIOBase = raw
    if mode == "r":
        buffer = io.BufferedReader(raw)
    elif not is_unbuffered:
        buffer = io.BufferedWriter(raw)
    stream = io.TextIOWrapper(
        buffer,  # type: ignore[arg-type]
        encoding=old.encoding,
        errors=old.errors,
        line_buffering=not is_unbuffered and (number == 2 or raw.isatty()),
        write_through=is_unbuffered,
    )
    raw.name = f"<{name}>"  # type: ignore[misc]
    stream.mode = mode  # type: ignore[attr-defined]
    return stream


def run(request: dict) -> None:
    """Run the program to its end."""
    if any(Path(one, f"{SITE}.py").exists() for one in further(request["env"])):
        sys.modules.pop(SITE, None)
        __import__(SITE)
    if request["kind"] == "-m":
        runpy._run_module_as_main(request["what"])
    elif request["kind"] == "-c":
        names = sys.modules["__main__"].__dict__
        exec(compile(request["what"], "<string>", "exec"), names)
    else:
        file = os.path.abspath(request["what"])
        names = sys.modules["__main__"].__dict__
        names["__file__"] = file
        exec(compile(Path(file).read_bytes(), file, "exec"), names)


def main() -> None:
    """Serve; in a child, be the program."""
    for name in IMPORTED:
        __import__(name)
    del sys.path[0]  # its current folder
    own = further(dict(os.environ))
    gc.collect()
    gc.freeze()
    request, fds = serve(socket.socket(fileno=int(sys.argv[1])))
    become(request, fds, own)
    try:
        run(request)
    except SystemExit:
        raise
    except BaseException as error:
        trace = error.__traceback__
        names = sys.modules["__main__"].__dict__
        while trace is not None and trace.tb_frame.f_globals is not names:
            trace = trace.tb_next
        sys.excepthook(type(error), error.with_traceback(trace), trace)
        if isinstance(error, KeyboardInterrupt):
            sys.excepthook = lambda *_: None
            raise
        sys.exit(1)


if __name__ == "__main__":
    main()
