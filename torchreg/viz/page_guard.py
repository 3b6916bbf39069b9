"""Who may use a page that is served to this machine: only who has its address, and no page of another origin.

Any page that the user has open, wherever it came from, may send requests to this machine. A request passes only if its
Host is this server's, its Origin, where a browser sends one, is the served page's own, and its address holds a secret;
browsers keep the secret as a cookie of this origin, which no other page can read or send.
"""

from __future__ import annotations

import http
import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

_NAMES = ("127.0.0.1", "localhost")
_PARAMETER = "token"
_REFUSAL = "Refused: open the whole address that was printed, token included.\n"
# Starting a server replaces a function of the library for a moment; two threads must not do that at once.
_starting = threading.Lock()


class PageGuard:
    """The check of every request to one server."""

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(16)
        self.engaged = False

    def url(self, host: str, port: int) -> str:
        """Return the address that lets in."""
        return f"http://{host}:{port}/?{_PARAMETER}={self.token}"

    def defect(self, request: Any, port: int) -> str | None:
        """Return the fault of a request (with ``path`` and ``headers``) to a port, None if it may pass."""
        own = {f"{name}:{port}" for name in _NAMES}
        if request.headers.get_all("Host") not in [[host] for host in own]:
            return "Host"
        origins = request.headers.get_all("Origin")
        if origins and (len(origins) > 1 or origins[0] not in {f"http://{host}" for host in own}):
            return "Origin"
        if self._needs_token(request) and not self._holds_token(request, port):
            return "token"
        return None

    def _needs_token(self, request: Any) -> bool:
        """Return whether a request is for the page or its data; the library's own files are no secret."""
        upgrade = request.headers.get("Upgrade", "").lower()
        return "websocket" in upgrade or urlsplit(request.path).path.strip("/") in ("", "index.html")

    def _holds_token(self, request: Any, port: int) -> bool:
        given = parse_qs(urlsplit(request.path).query).get(_PARAMETER, [])
        for header in request.headers.get_all("Cookie"):
            try:
                cookie = SimpleCookie(header).get(self._cookie(port))
            except CookieError:
                continue
            given += [cookie.value] if cookie else []
        return any(secrets.compare_digest(value.encode(), self.token.encode()) for value in given)

    def _cookie(self, port: int) -> str:
        # Ports share cookies.
        return f"torchreg_{port}"

    def check(self, inner: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
        """Return the handler of requests of websockets that refuses what may not pass, and asks ``inner`` otherwise."""

        def process_request(connection: Any, request: Any) -> Any:
            port = connection.local_address[1]
            if self.defect(request, port) is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, _REFUSAL)
            response = inner(connection, request)
            if response is not None:
                response.headers["Set-Cookie"] = f"{self._cookie(port)}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Referrer-Policy"] = "no-referrer"
                response.headers["X-Frame-Options"] = "DENY"
            return response

        return process_request

    @contextmanager
    def around_start(self) -> Iterator[None]:
        """Guard the server that is started in a ``with`` block; ``engaged`` says whether one was."""
        from websockets.asyncio import server

        plain = server.serve

        def serve(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
            self.engaged = True
            inner = process_request or (lambda connection, request: None)
            return plain(*arguments, process_request=self.check(inner), **options)

        with _starting:
            # viser hands no check of requests on.
            setattr(server, "serve", serve)  # noqa: B010
            try:
                yield
            finally:
                setattr(server, "serve", plain)  # noqa: B010
