"""Access control of a scene's server: only browsers that know the printed address get answers.

Any web page that is open in the same browser can send requests to 127.0.0.1, and can read the
answers if its own host name resolves to that address (DNS rebinding). Requests must therefore name
this machine as their host, must not come from a page of another origin, and must hold the token of
the printed address.
"""

import hmac
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

_LOCAL = ("127.0.0.1", "localhost")
_HINT = "Forbidden: open the address that gsba view printed.\n"


@contextmanager
def guarded(token: str) -> Iterator[list[str]]:
    """Make servers that viser starts in this context answer only requests with the token.

    viser has no hook for requests, so that the handler of its web server is wrapped.

    Yields:
        hosts of the servers that were started, filled within the context.
    """
    from websockets.asyncio import server

    serve, started = server.serve, []

    def serve_guarded(
        handler: Any, host: str, *args: Any, process_request: Any = None, **options: Any
    ) -> Any:
        started.append(host)
        checked = _checked(token, process_request)
        return serve(handler, host, *args, process_request=checked, **options)

    server.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        yield started
    finally:
        server.serve = serve  # type: ignore[misc]


def allowed(hosts: list[str], origins: list[str], path: str, token: str) -> bool:
    """True if a request with these headers `Host` and `Origin` and this path may be answered."""
    if len(hosts) != 1 or len(origins) > 1 or _name(hosts[0]) not in _LOCAL:
        return False
    if origins and origins[0].lower() != f"http://{hosts[0].lower()}":
        return False
    return hmac.compare_digest(_parted(path)[0].encode(), token.encode())


def _checked(token: str, process_request: Callable[..., Any] | None) -> Callable[..., Any]:
    """Request handler of websockets that passes allowed requests on, without the token."""

    def process(connection: "ServerConnection", request: "Request") -> "Response | None":
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if not allowed(hosts, origins, request.path, token):
            return connection.respond(403, _HINT)
        if process_request is None:
            return None
        return process_request(connection, type(request)(_parted(request.path)[1], request.headers))

    return process


def _parted(path: str) -> tuple[str, str]:
    """First component of a path, and the rest from its slash on."""
    first, slash, rest = path.partition("?")[0].removeprefix("/").partition("/")
    return first, slash + rest or "/"


def _name(host: str) -> str | None:
    """Host name of a `Host` header with any port, as a tunnel may have another; None = invalid."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname if parts.netloc == host and parts.username is None else None
    except ValueError:
        return None
