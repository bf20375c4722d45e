"""Files that grow, and the live view of one, in this process."""

import json
import socket
from contextlib import contextmanager
from http.client import HTTPConnection

from motorhil.harness.view.page import live_page
from motorhil.harness.view.server import ViewServer
from motorhil.harness.view.session import Session, Subject
from motorhil.harness.view.source import Source
from motorhil.traces.mcap.reader import read_trace

TOKEN = "t0ken"


class Growing:
    """A file that grows chunk by chunk into a copy of a recording.

    Attributes:
        path: the file, with everything before the first chunk at first.
        left: number of chunks that are not in it yet.
    """

    def __init__(self, path, recording):
        self.path = path
        self._data = recording.read_bytes()
        with read_trace(recording) as trace:
            ends = [chunk.data_offset + chunk.data_size for chunk in trace._chunks]
            self._ends = [trace._chunks[0].offset, *ends]
        self._at = 0
        path.write_bytes(b"")
        self._append(self._ends.pop(0))

    @property
    def left(self):
        return len(self._ends)

    def grow(self, chunks=1):
        """Append chunks."""
        for _ in range(chunks):
            self._append(self._ends.pop(0))

    def complete(self):
        """Append all the rest."""
        self._append(len(self._data))

    def _append(self, end):
        with self.path.open("ab") as file:
            file.write(self._data[self._at : end])
        self._at = end


def session(trace):
    """Return the session of a recording that has begun."""
    return Session(Subject("live", trace.attachments, trace.span_ns()[0]))


@contextmanager
def served(path, port=0, report=lambda: "the report"):
    """Serve the live view of a file; the context is its server."""
    with read_trace(path) as trace:
        source = Source(trace, session)
        with ViewServer(source, live_page("live"), report, port=port, token=TOKEN) as one:
            yield one


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def get(port, path, **headers):
    """Return status, headers and body of a request."""
    return _asked(port, "GET", path, None, headers)


def post(port, path, body, **headers):
    """Return status, headers and body of a request with a body, as a page sends it."""
    data = body if isinstance(body, bytes) else json.dumps(body).encode()
    return _asked(port, "POST", path, data, {"Content_Type": "application/json"} | headers)


def _asked(port, method, path, data, headers):
    connection = HTTPConnection("127.0.0.1", port, timeout=60)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body=data, headers=named)
    answer = connection.getresponse()
    found = answer.status, dict(answer.getheaders()), answer.read()
    connection.close()
    return found


class Events:
    """The events of a page, as a browser reads them; a context manager that leaves."""

    def __init__(self, port, position=None, room=None, token=TOKEN):
        """Ask for the events after a position; `room` limits what waits in this process [bytes]."""
        self._socket = socket.socket()
        self._socket.settimeout(60)
        if room is not None:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
        self._socket.connect(("127.0.0.1", port))
        again = f"Last-Event-ID: {position}\r\n" if position else ""
        head = f"GET /events?token={token} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{again}\r\n"
        self._socket.sendall(head.encode())
        self._file = self._socket.makefile("rb")
        self.status = int(self._file.readline().split()[1])
        while self._file.readline().strip():
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()
        self._socket.close()

    def next(self):
        """Return the next event as its fields, without comments; None: the server has left."""
        fields = {}
        for line in self._file:
            name, _, value = line.decode().rstrip("\n").partition(": ")
            if name:
                fields[name] = value
            elif "event" in fields or "event:" in fields:
                return fields
            else:
                fields = {}
        return None
