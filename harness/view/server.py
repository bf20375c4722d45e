"""HTTP server of the view: the page, its events, and the report.

One thread for each request; the events of a page are one long response (server-sent events). A page
that takes nothing for a while loses its connection, then reconnects with its last position.
"""

from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from socket import SO_SNDBUF, SOL_SOCKET
from threading import Semaphore
from typing import Final, Self, final
from urllib.parse import parse_qs, urlsplit

from motorhil.harness.view.desk import BODY_MAX, BUSY, Desk
from motorhil.harness.view.page_server import PageHandler, PageServer
from motorhil.harness.view.source import Source

PAGES_MAX: Final = 16
"""Limit of pages with events at a time."""
_QUIET_S: Final = 15.0  # after which a comment keeps the connection open
_RETRY_MS: Final = 500
_BUFFER_BYTES: Final = 65_536  # of events that wait for a slow page


@final
class ViewServer(PageServer):
    """The server of one view.

    Attributes:
        address: the address of the page, with the token.
    """

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
        super().__init__(_Handler, host, port, token)
        self.address: str = f"{self.origin}/?token={self.token}"

    def __enter__(self) -> Self:
        self.source.start()
        return super().__enter__()

    def __exit__(self, *_: object) -> None:
        """Stop serving; end the events of all pages."""
        self.source.stop()
        super().__exit__()


@final
class _Handler(PageHandler):
    server: ViewServer

    def do_GET(self) -> None:  # noqa: N802 -- the name that http.server calls
        address = urlsplit(self.path)
        desk = self.server.desk
        if self._is_refused(address.query):
            return
        if address.path == "/":
            self.answer(HTTPStatus.OK, "text/html", self.server.page)
        elif address.path == "/report":
            self.answer(HTTPStatus.OK, "text/html", self.server.report().encode())
        elif address.path == "/events":
            self._events(self.headers.get("Last-Event-ID"))
        elif address.path == "/stretch":
            self._stretch(parse_qs(address.query))
        elif address.path == "/hands" and desk is not None and desk.is_open:
            self.answer(HTTPStatus.OK, "application/json", desk.elements().encode())
        else:
            self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no such page")

    def do_POST(self) -> None:  # noqa: N802 -- the name that http.server calls
        address = urlsplit(self.path)
        desk = self.server.desk
        self.close_connection = True  # the body may not have been read
        if self._is_refused(address.query):
            return
        if address.path != "/hands" or desk is None or not desk.opens():
            self.answer(HTTPStatus.NOT_FOUND, "text/plain", b"no rig in virtual time is here")
            return
        if self.headers.get("Content-Type") != "application/json":  # no form of another site
            text = b"Content-Type: is not application/json"
            self.answer(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "text/plain", text)
            return
        size = self.headers.get("Content-Length", "")
        if not (size.isascii() and size.isdigit() and len(size) < 8 and int(size) <= BODY_MAX):
            text = f"request: has no length of up to {BODY_MAX} bytes".encode()
            self.answer(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "text/plain", text)
            return
        if not self.server.hands.acquire(blocking=False):
            self.answer(HTTPStatus(BUSY), "text/plain", b"rig: too many requests; try later")
            return
        try:
            status, answer = desk.post(self.rfile.read(int(size)))
        finally:
            self.server.hands.release()
        self.answer(HTTPStatus(status), "text/plain", answer.encode())

    def _stretch(self, query: dict[str, list[str]]) -> None:
        """Send all points between two times."""
        try:
            from_s, to_s = (float(query[key][0]) for key in ("from", "to"))
        except (KeyError, ValueError):
            from_s, to_s = 0.0, -1.0
        if not from_s <= to_s:
            text = b"stretch: has no times from and to [s], such as from=1.0&to=1.5"
            self.answer(HTTPStatus.BAD_REQUEST, "text/plain", text)
            return
        text = self.server.source.stretch(from_s, to_s).encode()
        self.answer(HTTPStatus.OK, "text/plain", text)

    def _is_refused(self, query: str) -> bool:
        return self.is_refused(self.server.access, parse_qs(query).get("token", [None])[0])

    def _events(self, position: str | None) -> None:
        if not self.server.places.acquire(blocking=False):
            text = f"events: {PAGES_MAX} pages are open already; close one"
            self.answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", text.encode())
            return
        try:
            self.close_connection = True
            self.connection.setsockopt(SOL_SOCKET, SO_SNDBUF, _BUFFER_BYTES)
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/event-stream; charset=utf-8")
            self.send_header("Connection", "close")
            self.end_with_rules()
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
