"""Who may talk to the server of a scene: the browser that was given its address, nobody else.

Any web page that is open in the same browser can send requests to 127.0.0.1, and a name of its own
that it lets point there makes it read the answers (DNS rebinding). So requests must name this
machine as their host, must not come from a page of another origin, and must know the token that is
part of the printed address.
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
    """Servers that viser starts meanwhile answer only requests that know the token.

    viser offers no handler of requests, so that of its web server is wrapped.

    Yields:
        the hosts of the servers that were started.
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
    """Whether a request may be answered, by its headers `Host` and `Origin` and its path."""
    if len(hosts) != 1 or len(origins) > 1 or _name(hosts[0]) not in _LOCAL:
        return False
    if origins and origins[0].lower() != f"http://{hosts[0].lower()}":
        return False
    return hmac.compare_digest(_parted(path)[0].encode(), token.encode())


def _checked(token: str, process_request: Callable[..., Any] | None) -> Callable[..., Any]:
    """A request handler of websockets that passes on what is allowed, without the token."""

    def process(connection: "ServerConnection", request: "Request") -> "Response | None":
        hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
        if not allowed(hosts, origins, request.path, token):
            return connection.respond(403, _HINT)
        if process_request is None:
            return None
        return process_request(connection, type(request)(_parted(request.path)[1], request.headers))

    return process


def _parted(path: str) -> tuple[str, str]:
    """First part of a path, and the rest from its slash on."""
    first, slash, rest = path.partition("?")[0].removeprefix("/").partition("/")
    return first, slash + rest or "/"


def _name(host: str) -> str | None:
    """Name of a `Host`, with any port: a tunnel may have another."""
    try:
        parts = urlsplit(f"//{host}")
        return parts.hostname if parts.netloc == host and parts.username is None else None
    except ValueError:
        return None
