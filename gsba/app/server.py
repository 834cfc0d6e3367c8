"""The server of the page: only browsers of this machine that know its address get answers."""

import os
import socket
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

from gsba.app.hub import App
from gsba.log import GsbaError

HOST = "127.0.0.1"  # not reachable from other machines


def state_folder(root: Path) -> Path:
    """Folder of the jobs of a root, in the user's folder of states (XDG)."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state"
    digest = sha256(str(root.resolve()).encode()).hexdigest()[:12]
    return Path(base) / "gsba" / "app" / digest


def serve(app: App, port: int, started: Callable[[str], None]) -> None:
    """Answer browsers of this machine until the process is interrupted.

    Args:
        app: what pages show.
        port: 1 to 65535, or 0 for any free one.
        started: called with the address when browsers get answers.

    Raises:
        GsbaError: a package is missing, or the port is in use.
    """
    try:
        import uvicorn

        from gsba.app.routes import application
    except ImportError as error:
        raise GsbaError(f"gsba app needs {error.name}: pip install 'gsba[app]'") from None
    listener = _listener(port)
    address = f"http://{HOST}:{listener.getsockname()[1]}/{app.token}/"
    config = uvicorn.Config(
        application(app),
        lifespan="off",
        ws="none",
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=2,
    )
    started(address)
    try:
        uvicorn.Server(config).run(sockets=[listener])
    finally:
        listener.close()
        app.close()


def _listener(port: int) -> socket.socket:
    if not 0 <= port <= 65535:
        raise GsbaError(f"--port {port} is out of range: use 1 to 65535, or 0 for any")
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((HOST, port))
    except PermissionError:
        raise GsbaError(f"port {port} is reserved by the system: pass another --port") from None
    except OSError:
        raise GsbaError(
            f"port {port} of {HOST} is in use: pass another --port, or 0 for any free one"
        ) from None
    return listener
