"""The server of the page: only browsers of this machine that know its address get answers."""

import os
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

from gsba.app.hub import App
from gsba.log import GsbaError
from gsba.view.server import HOST, bound_socket


def state_folder(root: Path) -> Path:
    """Folder of the jobs of a root, in the user's folder of states (XDG)."""
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local/state"
    digest = sha256(str(root.resolve()).encode()).hexdigest()[:12]
    return Path(base) / "gsba" / "app" / digest


def serve(app: App, port: int, started: Callable[[str], None]) -> None:
    """Answer browsers of this machine until the process is interrupted.

    Args:
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
    listener = bound_socket(port)
    address = f"http://{HOST}:{listener.getsockname()[1]}/{app.token}/"
    config = uvicorn.Config(
        application(app),
        lifespan="off",
        ws="none",
        log_level="warning",
        access_log=False,
        timeout_graceful_shutdown=2,
    )
    try:
        listener.listen()  # from here on connections wait for the server
        started(address)
        uvicorn.Server(config).run(sockets=[listener])
    finally:
        listener.close()
        app.close()
