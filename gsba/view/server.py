"""Server of a scene by viser, for browsers of this machine that know its address."""

import io
import logging
import secrets
import socket
from collections.abc import Callable
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

from gsba.log import GsbaError
from gsba.view.display import View
from gsba.view.guard import guarded
from gsba.view.scene import Scene

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

logger = logging.getLogger(__name__)

HOST = "127.0.0.1"  # not reachable from other machines


def serve(scene: Scene, port: int) -> View:
    """Show a scene at an address of this machine until the view is stopped; returns at once.

    Only browsers that know `view.address` get answers: see `gsba.view.guard`.

    Args:
        scene: see `load_scene`.
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
    return View(server, scene, f"http://{HOST}:{server.get_port()}/{token}/")


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
