"""Server of a scene by viser, for browsers of this machine that know its address."""

import hmac
import io
import logging
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gsba.log import GsbaError
from gsba.view.display import SceneView
from gsba.view.scene import RunScene

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

logger = logging.getLogger(__name__)

HOST = "127.0.0.1"  # not reachable from other machines


def serve(scene: RunScene, port: int) -> SceneView:
    """Show a scene at an address of this machine until the view is stopped; returns at once.

    Only browsers that know `view.address` get answers: see `gsba.view.server`.

    Args:
        port: 1 to 65535, or 0 for any free one (`view.server.get_port()`).

    Raises:
        GsbaError: viser is missing, or the port is in use or reserved.
    """
    open_server = _server_class()
    bound_socket(port).close()  # refuses a port that is not free
    token = secrets.token_urlsafe(16)
    with redirect_stdout(io.StringIO()), guarded(token) as started:  # viser prints a banner
        server = open_server(host=HOST, port=port, label=f"gsba: {scene.name}", verbose=False)
    if not started:
        server.stop()
        raise GsbaError(
            "this version of viser cannot be protected from other web pages: "
            "pip install 'viser<1.2'"
        )
    if port and server.get_port() != port:  # viser takes the next free port without an error
        with redirect_stdout(io.StringIO()):
            server.stop()
        raise GsbaError(_IN_USE.format(port=port))
    return SceneView(server, scene, f"http://{HOST}:{server.get_port()}/{token}/")


_IN_USE = "port {port} of 127.0.0.1 is in use: pass another --port, or 0 for any free one"


def _server_class() -> "Callable[..., viser.ViserServer]":
    """Class of viser's server without public addresses."""
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise GsbaError(
            f"gsba view needs {error.name or 'viser'}: pip install 'gsba[view]'"
        ) from None

    class LocalServer(viser.ViserServer):
        """Server that refuses requests of the browser for a public address."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            logger.warning("a request for a public address was refused")
            return None

    return LocalServer


def bound_socket(port: int) -> socket.socket:
    """A socket of this machine's loopback interface, bound to a port.

    Args:
        port: 1 to 65535, or 0 for any free one.

    Raises:
        GsbaError: the port is out of range, reserved, or in use.
    """
    if not 0 <= port <= 65535:
        raise GsbaError(f"--port {port} is out of range: use 1 to 65535, or 0 for any")
    bound = socket.socket()
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((HOST, port))
    except OSError as error:
        bound.close()
        if isinstance(error, PermissionError):
            raise GsbaError(f"port {port} is reserved by the system: pass another --port") from None
        raise GsbaError(_IN_USE.format(port=port)) from None
    return bound


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
