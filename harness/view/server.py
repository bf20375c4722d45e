"""HTTP server of the view: the page, its events, and the report.

One thread for each request; the events of a page are one long response (server-sent events). A page
that takes nothing for a while loses its connection, then reconnects with its last position.
"""

from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from secrets import token_urlsafe
from socket import AF_INET, AF_INET6, SO_SNDBUF, SOL_SOCKET
from threading import Semaphore, Thread
from typing import Final, final
from urllib.parse import parse_qs, urlsplit

from motorhil.harness.view.access import LOOPBACK, Access
from motorhil.harness.view.desk import BODY_MAX, BUSY, Desk
from motorhil.harness.view.source import Source

PAGES_MAX: Final = 16
"""Limit of pages with events at a time."""
_QUIET_S: Final = 15.0  # after which a comment keeps the connection open
_STALLED_S: Final = 20.0  # after which a page that takes nothing loses its connection
_RETRY_MS: Final = 500
_BUFFER_BYTES: Final = 65_536  # of events that wait for a slow page


@final
class ViewServer(ThreadingHTTPServer):
    """The server of one view; a context manager that serves while it is open.

    Attributes:
        address: the address of the page, with the token.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self,
        source: Source,
        page: str,
        report: Callable[[], str],
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
        desk: Desk | None = None,
    ) -> None:
        """Open the port.

        Args:
            source: the events.
            page: the text of the page.
            report: returns the text of the report.
            host: IP address at which it listens.
            port: 0: any free one.
            token: the token in the address; None: a new one.
            desk: takes requests for the rig; None: there is none.

        Raises:
            OSError: the port cannot be opened.
        """
        self.source: Source = source
        self.desk: Desk | None = desk
        self.page: bytes = page.encode()
        self.report: Callable[[], str] = report
        self.places: Semaphore = Semaphore(PAGES_MAX)
        self.hands: Semaphore = Semaphore(2 * PAGES_MAX)  # requests that are read or wait
        self.address_family: int = AF_INET6 if ":" in host else AF_INET
        super().__init__((host, port), _Handler)
        self.port: int = self.server_address[1]
        name = f"[{host}]" if ":" in host else host
        token = token_urlsafe(16) if token is None else token
        self.access: Access = Access(token, self.port, {*LOOPBACK, name})
        self.address: str = f"http://{name}:{self.port}/?token={token}"
        self._thread = Thread(target=self.serve_forever, args=(0.1,), name="motorhil view server")
        self._thread.daemon = True

    def __enter__(self) -> "ViewServer":
        self.source.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving; end the events of all pages."""
        self.source.stop()
        self.shutdown()
        self._thread.join()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore pages that leave in the middle of a response."""


@final
class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    server_version = "motorhil"
    sys_version = ""
    timeout = _STALLED_S

    def do_GET(self) -> None:
        address = urlsplit(self.path)
        desk = self.server.desk
        if self._is_refused(address.query):
            return
        if address.path == "/":
            self._answer(HTTPStatus.OK, "text/html", self.server.page)
        elif address.path == "/report":
            self._answer(HTTPStatus.OK, "text/html", self.server.report().encode())
        elif address.path == "/events":
            self._events(self.headers.get("Last-Event-ID"))
        elif address.path == "/hands" and desk is not None and desk.is_open:
            self._answer(HTTPStatus.OK, "application/json", desk.elements().encode())
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page")

    def do_POST(self) -> None:
        address = urlsplit(self.path)
        desk = self.server.desk
        self.close_connection = True  # the body may not have been read
        if self._is_refused(address.query):
            return
        if address.path != "/hands" or desk is None or not desk.opens():
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"no rig in virtual time is here")
            return
        if self.headers.get("Content-Type") != "application/json":  # no form of another site
            text = b"Content-Type: is not application/json"
            self._answer(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "text/plain", text)
            return
        size = self.headers.get("Content-Length", "")
        if not (size.isascii() and size.isdigit() and len(size) < 8 and int(size) <= BODY_MAX):
            text = f"request: has no length of up to {BODY_MAX} bytes".encode()
            self._answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain", text)
            return
        if not self.server.hands.acquire(blocking=False):
            self._answer(HTTPStatus(BUSY), "text/plain", b"rig: too many requests; try later")
            return
        try:
            status, answer = desk.post(self.rfile.read(int(size)))
        finally:
            self.server.hands.release()
        self._answer(HTTPStatus(status), "text/plain", answer.encode())

    def _is_refused(self, query: str) -> bool:
        """Return True after a refusal: the request is of another site, or without the token."""
        tokens = parse_qs(query).get("token", [None])
        refusal = self.server.access.refusal(
            self.headers.get("Host"), self.headers.get("Origin"), tokens[0]
        )
        if refusal is not None:
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", refusal.encode())
        return refusal is not None

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: the address has the token in it."""

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self._end_headers()
        self.wfile.write(body)

    def _end_headers(self) -> None:
        for name, value in (
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        self.end_headers()

    def _events(self, position: str | None) -> None:
        if not self.server.places.acquire(blocking=False):
            text = f"events: {PAGES_MAX} pages are open already; close one"
            self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", text.encode())
            return
        try:
            self.close_connection = True
            self.connection.setsockopt(SOL_SOCKET, SO_SNDBUF, _BUFFER_BYTES)
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/event-stream; charset=utf-8")
            self.send_header("Connection", "close")
            self._end_headers()
            self.wfile.write(f"retry: {_RETRY_MS}\n\n".encode())
            self._stream(position)
        finally:
            self.server.places.release()

    def _stream(self, position: str | None) -> None:
        """Send events until the record is complete, or the page or the server leaves."""
        source, desk, seen = self.server.source, self.server.desk, 0
        while not source.is_stopped:
            if desk is not None and desk.has_news(seen):
                seen = desk.revision
                self.wfile.write(f"event: hands\ndata: {desk.state()}\n\n".encode())
            is_due = partial(desk.has_news, seen) if desk is not None else bool
            events = source.events(position, _QUIET_S, is_due)
            if events:
                self.wfile.write(b"".join(event.text() for event in events))
                position = events[-1].position
            elif source.problem:
                problem = source.problem.replace("\n", " ")
                self.wfile.write(f"event: problem\ndata: {problem}\n\n".encode())
                return
            elif source.is_over:
                self.wfile.write(b"event: over\ndata: \n\n")
                return
            elif not source.is_stopped and not is_due():
                self.wfile.write(b":\n\n")
