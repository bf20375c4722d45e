"""Access to the page: its token, and the names by which a browser may call it.

A page of another site can let a browser send requests to loopback. DNS rebinding even lets it read
the answers, but the browser then sends the other site's name as Host. Requests with a foreign Host
or Origin, or without the token, are refused.
"""

from collections.abc import Iterable
from hmac import compare_digest
from typing import Final, final

LOOPBACK: Final = ("127.0.0.1", "localhost", "[::1]")


@final
class Access:
    """The rule for requests to one server."""

    def __init__(self, token: str, port: int, names: Iterable[str] = LOOPBACK) -> None:
        """Allow requests with this token to these hosts at this port."""
        self._token = token.encode()
        self._hosts = frozenset(f"{name}:{port}" for name in names)

    def refusal(self, host: str | None, origin: str | None, token: str | None) -> str | None:
        """Return why a request is refused, or None.

        Args:
            host: the header Host.
            origin: the header Origin; None: there is none, as in a plain request for a page.
            token: the token in the address.
        """
        if host is None or host.lower() not in self._hosts:
            return "Host: is not this server; open the address that motorhil printed"
        if origin is not None and origin.lower() != f"http://{host.lower()}":
            return "Origin: is another site; open the address that motorhil printed"
        if token is None or not compare_digest(token.encode(), self._token):
            return "token: is missing or wrong; open the address that motorhil printed"
        return None
