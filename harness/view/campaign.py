"""Server of a campaign's folder: its page as it is written, and the files of kept failures.

The token is the first part of each address, so that the page's own links work. Nothing but the page
is sent as a page: the files have names and text of programs under test.
"""

import os
import stat
from http import HTTPStatus
from pathlib import Path
from typing import Final, final
from urllib.parse import quote, unquote, urlsplit

from motorhil.harness.view.page_server import PageHandler, PageServer

_PAGE: Final = "index.html"
_TEXTS: Final = (".toml", ".py", ".json", ".jsonl")
_RECORDING: Final = ".mcap"
_CHUNK: Final = 1 << 16


@final
class CampaignServer(PageServer):
    """The server of one folder, which only reads it.

    Attributes:
        address: the address of the page, with the token.
    """

    def __init__(
        self, folder: Path, host: str = "127.0.0.1", port: int = 0, token: str | None = None
    ) -> None:
        """Open the port; arguments and errors as for `PageServer`."""
        self.folder: Path = folder.resolve()
        super().__init__(_Handler, host, port, token)
        self.address: str = f"{self.origin}/{quote(self.token, safe='')}/"

    def file(self, name: str) -> Path | None:
        """Return the file of this name below the folder, or None if it is not for pages."""
        path = self.folder / (name or _PAGE)
        try:
            path = path.resolve()  # the target of a link
            is_file = stat.S_ISREG(path.stat().st_mode)
        except (OSError, ValueError):
            return None
        is_known = path.name == _PAGE or path.suffix in (*_TEXTS, _RECORDING)
        return path if is_file and is_known and self.folder in path.parents else None


@final
class _Handler(PageHandler):
    server: CampaignServer

    def do_GET(self) -> None:  # noqa: N802 -- the name that http.server calls
        address = urlsplit(self.path)
        _, token, *names = address.path.split("/")
        if self.is_refused(self.server.access, unquote(token)):
            return
        path = self.server.file("/".join(unquote(name) for name in names))
        if path is None:
            text = b"no such file; motorhil swarm --show DIR writes the page of a campaign"
            self.answer(HTTPStatus.NOT_FOUND, "text/plain", text)
        elif path.suffix == _RECORDING:
            self._send(path)
        else:
            kind = "text/html" if path == self.server.folder / _PAGE else "text/plain"
            self.answer(HTTPStatus.OK, kind, path.read_bytes())

    def _send(self, path: Path) -> None:
        """Send a recording, which may be large."""
        with path.open("rb") as file:
            left = os.fstat(file.fileno()).st_size
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "application/octet-stream")
            self.send_header("Content-Disposition", "attachment")
            self.send_header("Content-Length", str(left))
            self.end_with_rules()
            while left > 0 and (data := file.read(min(left, _CHUNK))):
                self.wfile.write(data)
                left -= len(data)
