"""Common part of servers of pages: the port, the token, refusals, headers."""

from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from secrets import token_urlsafe
from socket import AF_INET, AF_INET6
from threading import Thread
from typing import ClassVar, Final, Self

from motorhil.harness.view.access import LOOPBACK, Access

STALLED_S: Final = 20.0
"""Time after which a page that takes nothing loses its connection [s]."""


class PageServer(ThreadingHTTPServer):
    """A server of pages; a context manager that serves while it is open.

    Attributes:
        origin: "http://", its name and its port.
        token: the token in the address.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self, handler: "type[PageHandler]", host: str, port: int, token: str | None
    ) -> None:
        """Open the port.

        Args:
            handler: the class that answers requests.
            host: IP address at which it listens.
            port: 0: any free one.
            token: the token in the address; None: a new one.

        Raises:
            OSError: the port cannot be opened.
        """
        self.address_family: int = AF_INET6 if ":" in host else AF_INET
        super().__init__((host, port), handler)
        self.port: int = self.server_address[1]
        name = f"[{host}]" if ":" in host else host
        self.token: str = token_urlsafe(16) if token is None else token
        self.access: Access = Access(self.token, self.port, {*LOOPBACK, name})
        self.origin: str = f"http://{name}:{self.port}"
        self._thread = Thread(target=self.serve_forever, args=(0.1,), name="motorhil view server")
        self._thread.daemon = True

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self.shutdown()
        self._thread.join()
        self.server_close()

    def handle_error(self, request: object, client_address: object) -> None:
        """Ignore pages that leave in the middle of a response."""


class PageHandler(BaseHTTPRequestHandler):
    """One request."""

    protocol_version = "HTTP/1.1"
    server_version = "motorhil"
    sys_version = ""
    timeout: ClassVar[float | None] = STALLED_S

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing: the address has the token in it."""

    def is_refused(self, access: Access, token: str | None) -> bool:
        """Return True after a refusal: the request is of another site, or without the token."""
        refusal = access.refusal(self.headers.get("Host"), self.headers.get("Origin"), token)
        if refusal is not None:
            self.answer(HTTPStatus.FORBIDDEN, "text/plain", refusal.encode())
        return refusal is not None

    def answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        """Send a whole response of this media type."""
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_with_rules()
        self.wfile.write(body)

    def end_with_rules(self) -> None:
        """End the headers with those that keep other sites out."""
        for name, value in (
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("X-Frame-Options", "DENY"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        self.end_headers()
