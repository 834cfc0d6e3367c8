"""State that all pages of a server share: the root, the commands, the jobs, the viewers."""

import secrets
import threading
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsba.app.forms import Form
from gsba.app.jobs import AppJob, Jobs
from gsba.app.previews import Previews
from gsba.app.progress import Progress, read_events
from gsba.app.worker import ensure_worker
from gsba.disk import write_text
from gsba.log import GsbaError
from gsba.store.store import fingerprint
from gsba.view import files_of_scene, load_scene
from gsba.view import serve as serve_view

if TYPE_CHECKING:
    from gsba.view.display import SceneView


class App:
    """The root, the commands, the jobs and the viewers behind a server.

    Args:
        root: folder below which files may be chosen; commands run in it.
        state: folder of jobs and of the token.
        choices: known values of fields, by their kind.
        check: refuses arguments that the command line would refuse, with a GsbaError.
    """

    def __init__(
        self,
        root: Path,
        state: Path,
        forms: Iterable[Form],
        choices: dict[str, Any],
        check: Callable[[Sequence[str]], None],
    ) -> None:
        if not root.is_dir():
            raise GsbaError(f"{root} is no folder: give the folder of your footage")
        self.root, self.jobs = root.resolve(), Jobs(state)
        self.forms = {form.command: form for form in forms}
        self.choices, self.check = choices, check
        # The secret of the address is kept: an open page finds a server that was restarted.
        path = state / "token"
        try:
            token = path.read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            token = ""
        if len(token) < 16 or not token.replace("-", "").replace("_", "").isalnum():
            token = secrets.token_urlsafe(16)
            write_text(path, token)
            path.chmod(0o600)
        self.token = token
        self.previews = Previews(self.root, state.resolve() / "previews")
        self._followed: dict[str, tuple[Progress, int]] = {}  # and bytes of events it holds
        self._views: dict[Path, tuple[object, SceneView]] = {}  # by run, with its files' state
        self._lock = threading.Lock()  # of viewers and of progress: requests come from threads
        ensure_worker(self.jobs)

    def progress(self, job: AppJob) -> Progress:
        """Progress of a job by its events so far."""
        with self._lock:
            progress, offset = self._followed.get(job.id, (Progress(), 0))
            events, offset = read_events(job.events, offset)
            for event in events:
                progress.add(event)
            self._followed[job.id] = progress, offset
            return progress

    def view(self, run: Path) -> str:
        """Address of the viewer of a run, started if it is not shown yet as it is now. Raises
        GsbaError: viser is missing, or the run is not finished."""
        with self._lock:
            state, known = fingerprint(files_of_scene(run)), self._views.get(run)
            if known is None or known[0] != state:
                self._views[run] = state, serve_view(load_scene(run), 0)
                if known is not None:
                    known[1].stop()
            return self._views[run][1].address

    def close(self) -> None:
        """Stop the viewers and the previews; jobs go on."""
        self.previews.close()
        for _, view in self._views.values():
            view.stop()
